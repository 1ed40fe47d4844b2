"""A module imports only from lower levels (docs/architecture.md), so that each stage can be read and run alone.

Every folder of the package has a level; within a top folder imports are free, but not in a circle. In the folder of a
sensor each facet (`FACETS`) has a level as well, the same for all sensors.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import icalib
from icalib.sensors import SENSOR_KINDS

SOURCE = Path(icalib.__file__).parent
PAGE = Path(__file__).parents[1] / "docs" / "architecture.md"
MOST_MODULES = 20  # of a folder: more cannot be taken in at a glance
MOST_LINES = 700  # of a file
AT_THE_ROOT = {"__init__", "errors", "kinds", "pipeline"}  # `calibrate` is the name of the function

# Folders below icalib. Those of one line do not import one another, unless they are parts of one folder or one sensor.
# `sensors.*.spec`: the facet of every sensor.
ORDER = (
    ("base",),
    ("geometry", "geometry.cameras", "geometry.targets", "sensors"),
    ("sensors.*.spec", "sensors.*.stream", "optim"),
    ("rig",),
    ("data",),
    ("detection", "motion", "tools.simulation"),
    ("model", "result", "sensors.*.read", "sensors.*.simulate"),
    ("estimate", "report", "sensors.camera", "sensors.imu", "sensors.lidar", "sensors.pose", "sensors.position",
     "sensors.wheels"),
    ("export", "observability", "sensors.*.model", "sensors.*.show"),
    ("initialize",),
    ("sensors.*.assess", "sensors.*.initialize"),
    ("validation",),
    ("pipeline",),
    ("tools", "tools.allan", "tools.comparison", "tools.fleet", "tools.inspection", "tools.montecarlo"),
    ("cli", "sensors.*.inspect"),
    ("",),
)  # fmt: skip
LEVELS = {folder: level for level, folders in enumerate(ORDER, 1) for folder in folders} | {"errors": 0, "kinds": 0}
EVERYWHERE = {"errors", "kinds"}  # `kinds` lists what the sensors do in each stage, and imports it when asked
# Methods of a result, for users, that call a higher level when they are called.
UPWARDS = {("result", "export"), ("result", "report")}
ROOT_NAMES = {"__version__"}  # of icalib/__init__.py, which any module may ask for
# Modules or packages of fixed names in the folder of a sensor, each for one stage.
FACETS = ("spec", "stream", "read", "model", "initialize", "assess", "show", "simulate", "inspect")
TOOL_FACETS = ("simulate", "inspect")
DATA_FACETS = ("spec", "stream", "read", "simulate")
ESTIMATOR = ("optim", "motion", "model", "sensors", "estimate", "initialize", "observability", "validation", "pipeline")


def folder_of(module: str) -> str:
    """The folder, or the loose module, of a dotted name below icalib: 'icalib.geometry.so3' and
    'icalib.geometry.so3.exp' -> 'geometry'. The root itself is ''."""
    parts = module.split(".")[1:]
    if parts[:1] and parts[0] in LEVELS and SOURCE.joinpath(parts[0]).with_suffix(".py").is_file():
        return parts[0]
    if len(parts) > 2 and parts[0] == "sensors" and parts[2] in FACETS:
        return f"sensors.{parts[1]}.{parts[2]}"
    while not SOURCE.joinpath(*parts).is_dir():
        parts.pop()
    return ".".join(parts)


def level_of(folder: str) -> int | None:
    """The level of a folder, or of a facet of a sensor; None where it has none."""
    parts = folder.split(".")
    if len(parts) == 3 and parts[0] == "sensors" and parts[2] in FACETS:
        folder = f"sensors.*.{parts[2]}"
    return LEVELS.get(folder)


def imported_folders(tree: ast.AST, package: str) -> set[str]:
    """Folders that a module of `package` (dotted) imports, wherever in the file."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {folder_of(alias.name) for alias in node.names if alias.name.split(".")[0] == "icalib"}
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) - node.level + 1] if node.level else []
            module = ".".join(base + ([node.module] if node.module else []))
            if module.split(".")[0] != "icalib":
                continue
            names = [alias.name for alias in node.names if module != "icalib" or alias.name not in ROOT_NAMES]
            found |= {folder_of(f"{module}.{name}") for name in names}
    return found


def is_within(folder: str, packages: tuple[str, ...]) -> bool:
    return any(folder == p or folder.startswith(f"{p}.") for p in packages)


def sensor_of(folder: str) -> str:
    """The sensor that a folder is of: 'sensors.camera.features' -> 'camera'; '' where it is no sensor's."""
    parts = folder.split(".")
    return parts[1] if parts[0] == "sensors" and len(parts) > 1 else ""


def is_simulator(folder: str) -> bool:
    return is_within(folder, ("tools.simulation",)) or folder.endswith(".simulate")


def is_estimator(folder: str) -> bool:
    """Whether it belongs to the estimator; definitions and streams of sensors do not."""
    return is_within(folder, ESTIMATOR) and folder != "sensors" and folder.split(".")[-1] not in DATA_FACETS


def _top(folder: str) -> list[str]:
    """The top folder, or the sensor, that a folder is a part of: 'geometry.cameras' -> ['geometry']."""
    return folder.split(".")[: 2 if sensor_of(folder) else 1]


def is_forbidden(own: str, other: str) -> bool:
    """Whether a module of the folder `own` must not import from `other`."""
    if other == own or other in EVERYWHERE or (own, other) in UPWARDS:
        return False
    levels = level_of(own), level_of(other)
    if levels[0] is None or levels[1] is None or levels[1] > levels[0]:
        return True
    if levels[1] == levels[0] and _top(own) != _top(other):
        return True
    # A wrong sign of the estimator must not cancel against itself.
    if is_simulator(own) and is_estimator(other):
        return True
    if sensor_of(own) and sensor_of(other):  # a sensor is a folder, and knows no other
        return sensor_of(own) != sensor_of(other)
    if is_within(other, ("tools",)):  # the library does without them
        return not (is_within(own, ("tools", "cli", "")) or own.split(".")[-1] in TOOL_FACETS)
    return False


def violations(source: str, module: str, package: str) -> list[str]:
    """Sentences, one for each import of `module` that its level forbids."""
    own = folder_of(module)
    if own == "kinds":
        return []
    return [
        f"{module} (level {level_of(own)}) imports {other or 'icalib'} (level {level_of(other)})"
        for other in sorted(imported_folders(ast.parse(source), package))
        if is_forbidden(own, other)
    ]


def modules() -> list[tuple[str, str, Path]]:
    """(module, package, file) of every file in the source."""
    found = []
    for file in sorted(SOURCE.rglob("*.py")):
        parts = ("icalib", *file.relative_to(SOURCE).with_suffix("").parts)
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found.append((module, ".".join(parts[:-1]), file))
    return found


def test_modules_import_only_from_lower_levels():
    without = [module for module, _, _ in modules() if level_of(folder_of(module)) is None]
    assert without == [], "give their folders a level in ORDER"
    assert [v for m, package, file in modules() for v in violations(file.read_text(encoding="utf-8"), m, package)] == []


def imported_modules(tree: ast.Module, known: set[str]) -> set[str]:
    """Those of the modules `known` that a module imports when it is imported itself."""
    names = {
        f"{node.module}.{alias.name}" if f"{node.module}.{alias.name}" in known else node.module or ""
        for node in tree.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    return names & known


def cycle(imports: dict[str, set[str]]) -> list[str]:
    """Modules that import one another in a circle, by what each of them imports; empty if there is none."""
    while free := [module for module, others in imports.items() if not others & imports.keys()]:
        imports = {module: others for module, others in imports.items() if module not in free}
    return sorted(imports)


def test_no_modules_import_one_another_in_a_circle():
    known = {module for module, _, _ in modules()} - {"icalib"}
    trees = {m: ast.parse(file.read_text(encoding="utf-8")) for m, _, file in modules() if m in known}
    assert cycle({module: imported_modules(tree, known) - {module} for module, tree in trees.items()}) == []
    assert cycle({"a": {"b"}, "b": {"c"}, "c": {"b"}}) == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("source", "module", "forbidden"),
    [
        ("from icalib.pipeline import calibrate", "icalib.rig.rig", ["pipeline"]),
        ("import icalib.cli", "icalib.pipeline", ["cli"]),
        ("from icalib import report, __version__", "icalib.estimate.solver", ["report"]),
        ("from icalib import calibrate", "icalib.pipeline", ["icalib"]),
        ("from icalib.tools.simulation import simulate", "icalib.pipeline", ["tools.simulation"]),
        ("from icalib.estimate import estimate", "icalib.estimate.solver", []),
        ("from icalib.estimate import estimate", "icalib.model.bodies", ["estimate"]),
        ("from icalib.report import page", "icalib.estimate.solver", ["report"]),
        ("from icalib.tools.fleet import run", "icalib.tools.batch", []),
        ("from ...optim import state", "icalib.tools.simulation.motion", ["optim"]),
        ("from icalib.rig import Rig", "icalib.geometry.so3", ["rig"]),
        ("from icalib.sensors.lidar import residual", "icalib.sensors.camera.track_surfaces", ["sensors.lidar"]),
        ("from icalib.sensors.camera import board", "icalib.sensors.pose.residual", ["sensors.camera"]),
        ("from icalib.sensors.camera import board", "icalib.sensors.camera.track_surfaces", []),
        ("from icalib.sensors.lidar import residual", "icalib.sensors.lidar.initialize", []),
        ("from icalib.sensors.lidar import initialize", "icalib.sensors.lidar.residual", ["sensors.lidar.initialize"]),
        ("from icalib.sensors.lidar import spec", "icalib.sensors.wheels.residual", ["sensors.lidar.spec"]),
        ("from icalib.sensors.lidar import spec", "icalib.sensors.lidar.simulate", []),
        ("from icalib.sensors.lidar import residual", "icalib.sensors.lidar.simulate", ["sensors.lidar"]),
        ("from icalib.kinds import readers", "icalib.data.tables", []),
        ("from icalib.tools.simulation.motion import motion", "icalib.sensors.lidar.simulate", []),
        ("from icalib.tools.simulation.motion import motion", "icalib.sensors.lidar.show", ["tools.simulation"]),
        ("def f():\n    from icalib.unheard_of import g", "icalib.cli.commands", ["icalib"]),
        ("from icalib.errors import RigError\nfrom . import base", "icalib.geometry.targets.boards", []),
        ("from icalib import __version__\nimport numpy", "icalib.pipeline", []),
        ("from icalib.estimate.problem import solver\nfrom icalib.result import Calibration", "icalib.pipeline", []),
    ],
)
def test_the_check_finds_what_is_forbidden(source: str, module: str, forbidden: list[str]):
    found = violations(source, module, module.rpartition(".")[0])
    assert [sentence.split(" imports ")[1].split(" ")[0] for sentence in found] == forbidden


def test_the_page_about_the_architecture_has_every_folder_at_its_level():
    rows = [line.split("|") for line in PAGE.read_text(encoding="utf-8").splitlines() if re.match(r"\| \d+ ", line)]
    listed = {name.replace("/", "."): int(row[1]) for row in rows for name in re.findall(r"`([\w/*]+)`", row[2])}
    assert listed == {folder: level for folder, level in LEVELS.items() if folder}


def test_no_folder_and_no_file_is_too_large_to_be_taken_in():
    folders = [f for f in LEVELS if f and "*" not in f]
    counts = {folder: len(list(SOURCE.joinpath(*folder.split(".")).glob("*.py"))) - 1 for folder in folders}
    assert {folder: n for folder, n in counts.items() if n > MOST_MODULES} == {}
    lines = {module: file.read_text(encoding="utf-8").count("\n") for module, _, file in modules()}
    assert {module: n for module, n in lines.items() if n > MOST_LINES} == {}
    assert {file.stem for file in SOURCE.glob("*.py")} == AT_THE_ROOT


def test_every_kind_of_sensor_is_a_folder_and_every_folder_is_listed():
    assert {p.name for p in SOURCE.joinpath("sensors").iterdir() if p.joinpath("__init__.py").is_file()} == set(
        SENSOR_KINDS
    )
