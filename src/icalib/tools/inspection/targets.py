"""Reads the target that a user gives: a target or rig file of icalib, or Kalibr's target file."""

from __future__ import annotations

from pathlib import Path

from icalib.base.yaml_nodes import read_yaml
from icalib.errors import RigError
from icalib.rig.file import load_rig, load_target
from icalib.tools.inspection.facts import GivenTarget
from icalib.tools.inspection.kalibr import kalibr_target, yaml_mapping


def read_target(path: Path) -> GivenTarget:
    """The target in `path`. Raises RigError, one sentence naming file, line and field."""
    if not path.exists():
        raise RigError(f"{path} does not exist; check the path of the target.")
    root = read_yaml(path)
    fields = root.entries()
    if "target_type" in yaml_mapping(path):
        return GivenTarget(kalibr_target(yaml_mapping(path), str(path)), str(path))
    if "sensors" in fields:
        rig = load_rig(path)
        return GivenTarget(rig.target, str(path), rig.sensors)
    return GivenTarget(load_target(path), str(path))
