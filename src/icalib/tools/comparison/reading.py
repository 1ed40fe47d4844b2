"""Reads the two sides of a comparison from files, whose kind follows from their content."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TypeGuard

from icalib.base.input_files import regular
from icalib.base.suggestion import suggestion
from icalib.base.yaml_nodes import read_yaml
from icalib.errors import CalibrationError, RigError
from icalib.result import Calibration, load_calibration
from icalib.tools.comparison.compare import Comparison, ComparisonTolerances, compare_sides
from icalib.tools.comparison.other_files import is_kalibr, side_of_kalibr, side_of_urdf, side_of_urdf_alone
from icalib.tools.comparison.results import side_of_result, side_of_rig
from icalib.tools.comparison.sides import Side

_XML = b"<"


def compare_files(
    a: str | Path | Calibration,
    b: str | Path | Calibration,
    frames: Mapping[str, str] | None = None,
    tolerances: ComparisonTolerances | None = None,
    limit: float = 3.0,
) -> Comparison:
    """Compares two files. a, b: each a calibration, the folder of a result, a Kalibr camchain or imu file, a URDF, or a
    rig file. frames: sensor of A -> its name in B, or sensor of one side -> its link in the URDF of the other, if names
    differ.

    Raises CalibrationError, one sentence, if a file cannot be read or the two have nothing in common.
    """
    frames = frames or {}
    a, b = (x if isinstance(x, Calibration) else Path(x) for x in (a, b))
    if _is_urdf(a) and _is_urdf(b):
        one, other = side_of_urdf_alone(a, b, frames), side_of_urdf_alone(b, a, frames)
    elif _is_urdf(a):
        other = _side(b)
        one = _beside(a, other, frames)
    elif _is_urdf(b):
        one = _side(a)
        other = _beside(b, one, frames)
    else:
        one, other = _renamed(_side(a), _side(b), frames)
    return compare_sides(one, other, tolerances, limit)


def _beside(urdf: Path, side: Side, frames: Mapping[str, str]) -> Side:
    for name in frames:
        _check_known(name, side)
    sensors = [name for name in side.poses if name != side.body]
    return side_of_urdf(urdf, side.body, side.has_imu, sensors, frames)


def _renamed(a: Side, b: Side, frames: Mapping[str, str]) -> tuple[Side, Side]:
    """a unchanged, and b with its sensors renamed as in a. frames: name in a -> name in b."""
    for name, theirs in frames.items():
        _check_known(name, a)
        _check_known(theirs, b)
        b = b.renamed(theirs, name)
    return a, b


def _check_known(name: str, side: Side) -> None:
    if name not in side.sensors:
        near = suggestion(name, side.sensors)
        raise CalibrationError(f"there is no sensor {name} in {side.path}{near}; it has {', '.join(side.sensors)}.")


def _side(path: Path | Calibration) -> Side:
    if isinstance(path, Calibration):
        return side_of_result(path, "a calibration")
    if path.is_dir():
        return side_of_result(load_calibration(path), str(path))
    if path.name == "calibration.yaml":
        return side_of_result(load_calibration(path.parent), str(path))
    root = read_yaml(path, "result's folder, Kalibr file, URDF or rig file")
    entries = root.entries()
    if "sensors" in entries:
        return side_of_rig(path)
    if is_kalibr(entries):
        return side_of_kalibr(root)
    raise RigError(
        f"{path} is neither a Kalibr file nor a rig file; give a result's folder, a Kalibr camchain or imu file, a "
        "URDF or a rig file."
    )


def _is_urdf(path: Path | Calibration) -> TypeGuard[Path]:
    if isinstance(path, Calibration):
        return False
    if path.suffix in (".urdf", ".xacro"):
        return True
    try:
        with regular(path).open("rb") as file:
            return file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(_XML)
    except OSError:
        return False
