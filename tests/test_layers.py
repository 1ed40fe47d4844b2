"""A module imports only from lower levels (docs/architecture.md), so that each stage can be read and run alone."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import icalib

SOURCE = Path(icalib.__file__).parent

# Units are the modules and packages right below icalib; inside a package imports are free.
LEVELS = {
    "errors": 0,
    "compiled": 0,
    "extras": 0,
    "geometry": 0,
    "parameter": 0,
    "file_hashes": 0,
    "imu_classes": 0,
    "file_names": 0,
    "own_files": 0,
    "staging": 0,
    "unpacking": 1,
    "measurements": 1,
    "rig": 1,
    "arrays": 2,
    "joining": 2,
    "rig_streams": 2,
    "rig_complete": 2,
    "yaml_nodes": 1,
    "result_files": 1,
    "provenance": 2,
    "rig_parameters": 2,
    "rig_targets": 2,
    "rig_file": 3,
    "recordings": 2,
    "detection": 3,
    "inspection": 4,
    "simulation": 2,
    "printing": 2,
    "estimation": 3,
    "first_guess": 4,
    "observability": 6,
    "calibration": 5,
    "assessment": 7,
    "timeline": 6,
    "result_rig": 6,
    "report": 7,
    "export": 7,
    "text_files": 1,
    "allan": 8,
    "comparison": 8,
    "outputs": 8,
    "pipeline": 8,
    "view": 8,
    "console": 8,
    "batch": 1,
    "montecarlo": 9,
    "fleet": 9,
    "check": 9,
    "progress": 9,
    "command_parser": 2,
    "target_command": 10,
    "result_commands": 10,
    "cli": 11,
    "__main__": 12,
    "__init__": 12,
}
EVERYWHERE = {
    "compiled",
    "errors",
    "extras",
}  # so geometry, on the same level, may raise errors, and ask OpenCV for tags
NEVER = {("estimation", "simulation")}  # a lower level, but a wrong sign must not cancel against itself
ROOT_NAMES = {"__version__"}  # of icalib/__init__.py, which any module may ask for


def unit_of(module: str) -> str:
    """The unit of a dotted module name below icalib: 'icalib.geometry.so3' -> 'geometry'."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else "__init__"


def imported_units(tree: ast.AST, package: str) -> set[str]:
    """Units that a module of `package` (dotted) imports, wherever in the file."""
    units = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            units |= {unit_of(alias.name) for alias in node.names if alias.name.split(".")[0] == "icalib"}
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join(base + ([node.module] if node.module else []))
            if module == "icalib":
                names = {alias.name for alias in node.names} - ROOT_NAMES
                units |= {name if name in LEVELS else "__init__" for name in names}
            elif module.startswith("icalib."):
                units.add(unit_of(module))
    return units


def violations(source: str, module: str, package: str) -> list[str]:
    """Sentences, one for each import of `module` that its level forbids."""
    unit = unit_of(module)
    return [
        f"{module} (level {LEVELS[unit]}) imports {other} (level {LEVELS.get(other)})"
        for other in sorted(imported_units(ast.parse(source), package))
        if other != unit
        and other not in EVERYWHERE
        and (LEVELS.get(other, LEVELS[unit]) >= LEVELS[unit] or (unit, other) in NEVER)
    ]


def modules() -> list[tuple[str, str, Path]]:
    """(module, package, file) of every file in the source."""
    found = []
    for file in sorted(SOURCE.rglob("*.py")):
        parts = ("icalib", *file.relative_to(SOURCE).with_suffix("").parts)
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found.append((module, ".".join(parts[:-1]), file))
    return found


@pytest.mark.parametrize(("module", "package", "file"), modules(), ids=lambda value: value if value else None)
def test_module_imports_only_from_lower_levels(module: str, package: str, file: Path):
    assert unit_of(module) in LEVELS, f"{module} has no level; give it one in tests/test_layers.py"
    assert violations(file.read_text(encoding="utf-8"), module, package) == []


@pytest.mark.parametrize(
    ("source", "module", "forbidden"),
    [
        ("from icalib.pipeline import calibrate", "icalib.rig", ["pipeline"]),
        ("import icalib.cli", "icalib.pipeline", ["cli"]),
        ("from icalib import report, __version__", "icalib.estimation.solver", ["report"]),
        ("from icalib import calibrate", "icalib.pipeline", ["__init__"]),
        ("from ..estimation import solver", "icalib.simulation.imu", ["estimation"]),
        ("from .. import simulation", "icalib.estimation.solver", ["simulation"]),
        ("from icalib.rig import Rig", "icalib.measurements", ["rig"]),
        ("def f():\n    from icalib.unheard_of import g", "icalib.cli", ["unheard_of"]),
        ("from icalib.errors import RigError\nfrom . import so3", "icalib.geometry.targets", []),
        ("from icalib import __version__\nimport numpy", "icalib.pipeline", []),
        ("from icalib.estimation import solver\nfrom icalib.calibration import Calibration", "icalib.pipeline", []),
    ],
)
def test_the_check_finds_what_is_forbidden(source: str, module: str, forbidden: list[str]):
    found = violations(source, module, module.rpartition(".")[0])
    assert [sentence.split(" imports ")[1].split(" ")[0] for sentence in found] == forbidden


def test_the_page_about_the_architecture_has_every_unit_at_its_level():
    page = (Path(__file__).parents[1] / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = [line.split("|") for line in page.splitlines() if re.match(r"\| \d+ ", line)]
    listed = {unit: int(row[1]) for row in rows for unit in re.findall(r"`(\w+)`", row[2])}
    assert listed == {unit: level for unit, level in LEVELS.items() if not unit.startswith("__")}
