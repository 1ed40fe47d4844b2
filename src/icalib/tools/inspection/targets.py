"""The target that a user gives: in icalib's words, in a rig file, or in Kalibr's target file."""

from __future__ import annotations

from pathlib import Path

from icalib.errors import RigError
from icalib.inspection.facts import GivenTarget
from icalib.inspection.kalibr import kalibr_target, yaml_mapping
from icalib.rig_file import load_rig, load_target
from icalib.yaml_nodes import read_yaml


def read_target(path: Path) -> GivenTarget:
    """The target in `path`. Raises RigError, one sentence naming file, line and field."""
    if not path.exists():
        raise RigError(f"{path} does not exist; check the path of the target.")
    root = read_yaml(path)
    fields = root.entries()
    if "target_type" in yaml_mapping(path):
        return GivenTarget(kalibr_target(yaml_mapping(path), str(path)), str(path), {})
    if "sensors" in fields:
        rig = load_rig(path)
        return GivenTarget(rig.target, str(path), {c.name: c.resolution for c in rig.cameras})
    return GivenTarget(load_target(path), str(path), {})
