"""A new kind of sensor is a folder: hardly any other module names a kind, so that few have to change for a new one.

`python tests/test_sensor_kinds.py` prints what the modules that still do name.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import icalib
from icalib.sensors import SENSOR_KINDS

SOURCE = Path(icalib.__file__).parent
KINDS = SENSOR_KINDS
SHORT = {"cameras", "lidars", "wheels"}  # shorthand of rigs, measurements, results for all sensors of a kind
POSES = {"rig", "measurements", "m", "scenario", "asked"}  # what is called so and has `poses`, too
FREE = ("sensors/", "export/")  # exporters write the files of programs for certain sensors
# Modules that still name one; the list only shrinks.
NAMING = {
    "data/arrays.py",  # streams from arrays, for users
    "data/measurements.py",  # shorthand, for users
    "detection/decoding.py",  # the stream of the corners of images, for users
    "initialize/assumed_motion.py",  # they are an IMU and a pose sensor
    "initialize/rig_guess.py",  # wheels that show the motion in place of the IMU
    "motion/imu_data.py",  # readings of the IMU, which link keyframes
    "kinds.py",  # the list of all kinds
    "result/calibration.py",  # shorthand, for users
    "rig/__init__.py",  # the names of sensors, for users
    "rig/rig.py",  # shorthand, for users
    "result/saving.py",  # records of residuals that it saves
    "tools/inspection/follow.py",  # the target in images, and rotation by the IMU
    "tools/allan/analysis.py",  # the noise of IMUs
    "tools/simulation/filming.py",
    "tools/simulation/rigs.py",
    "tools/simulation/scenario.py",
    "tools/simulation/stops.py",  # cameras and LiDARs at rest
    "tools/simulation/writing.py",
    "tools/view.py",  # shows what cameras, IMUs and LiDARs recorded
    "tools/simulation/corners.py",
    "tools/simulation/motion.py",
    "tools/simulation/recording.py",
    "validation/causes.py",  # checks that were made for the sensors of the rig
}


def kind_classes() -> set[str]:
    """Names of the public classes that folders of `KINDS` define."""
    files = (file for kind in KINDS for file in SOURCE.joinpath("sensors", kind).rglob("*.py"))
    trees = (ast.parse(file.read_text(encoding="utf-8")) for file in files)
    return {n.name for tree in trees for n in tree.body if isinstance(n, ast.ClassDef) and not n.name.startswith("_")}


CLASSES = kind_classes()


def named_kinds(source: str) -> set[str]:
    """What a module names of a kind: its folder in an import, a class of it, or the shorthand for its sensors."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            parts = {p for alias in node.names for p in f"{node.module or ''}.{alias.name}".split(".")}
            found |= {alias.name for alias in node.names} & CLASSES
            found |= parts & set(KINDS) if "sensors" in parts else set()
        elif isinstance(node, ast.Attribute):
            base = node.value
            owner = base.id if isinstance(base, ast.Name) else base.attr if isinstance(base, ast.Attribute) else ""
            if node.attr in SHORT or (node.attr == "poses" and owner in POSES):
                found.add(f"{owner}.{node.attr}")
    return found


def naming() -> dict[str, set[str]]:
    """What each module outside of `FREE` names."""
    files = {file.relative_to(SOURCE).as_posix(): file for file in sorted(SOURCE.rglob("*.py"))}
    own = {name: file for name, file in files.items() if not name.startswith(FREE)}
    found = {name: named_kinds(file.read_text(encoding="utf-8")) for name, file in own.items()}
    return {name: kinds for name, kinds in found.items() if kinds}


def test_no_module_outside_of_the_folders_of_sensors_names_a_kind():
    found = naming()
    assert {name: kinds for name, kinds in found.items() if name not in NAMING} == {}
    assert set(found) >= NAMING, "take modules that name no kind any more off the list"


@pytest.mark.parametrize(
    ("source", "named"),
    [
        ("from icalib.rig import Lidar, Rig", {"Lidar"}),
        ("from icalib.sensors.wheels.residual import UNITS", {"wheels"}),
        ("from icalib.sensors import pose", {"pose"}),
        ("names = [w.name for w in inputs.rig.wheels]", {"rig.wheels"}),
        ("poses = poses_at(m.poses, found.poses)", {"m.poses"}),
        ("from icalib.kinds import readers\nfrom icalib.geometry import pose", set()),
        (
            "Rays = tuple[float, float]  # its own, though a kind has a class Rays\ndef f(r: Rays): ...",
            set(),
        ),
    ],
)
def test_the_check_finds_what_is_named(source: str, named: set[str]):
    assert named_kinds(source) == named


if __name__ == "__main__":
    for name, kinds in naming().items():
        print(name, *sorted(kinds))
