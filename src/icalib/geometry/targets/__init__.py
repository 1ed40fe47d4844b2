"""Calibration targets: positions of their points in the board frame, and identification of the points."""

from __future__ import annotations

from typing import Any

from icalib.geometry.targets.base import Target
from icalib.geometry.targets.boards import AprilGrid, Charuco, Checkerboard, Circles, Markers, Tag
from icalib.geometry.targets.scene import NoTarget, Scene

__all__ = [
    "TARGETS",
    "AprilGrid",
    "Charuco",
    "Checkerboard",
    "Circles",
    "Markers",
    "NoTarget",
    "Scene",
    "Tag",
    "Target",
    "target_from_plain",
]

TARGETS: dict[str, type[Target]] = {
    kind.type: kind for kind in (AprilGrid, Charuco, Checkerboard, Circles, Markers, Tag)
}


def target_from_plain(rig: dict[str, Any]) -> Target | None:
    """The target of a rig as plain data, the inverse of `Target.plain`; None if the rig has no target."""
    if "targets" in rig:
        return Scene(tuple(rig["targets"]), tuple(_target(fields) for fields in rig["targets"].values()))
    return _target(rig["target"]) if rig.get("target") else None


def _target(fields: dict[str, Any]) -> Target:
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in fields.items() if k != "type"}
    return TARGETS[fields["type"]](**values)
