"""Calibration targets: where their points are, in the board frame, and what identifies a point."""

from __future__ import annotations

from icalib.geometry.targets.aprilgrid import AprilGrid
from icalib.geometry.targets.base import Target
from icalib.geometry.targets.charuco import Charuco
from icalib.geometry.targets.checkerboard import Checkerboard
from icalib.geometry.targets.markers import Markers
from icalib.geometry.targets.nothing import NoTarget
from icalib.geometry.targets.scene import Scene
from icalib.geometry.targets.tag import Tag

__all__ = ["TARGETS", "AprilGrid", "Charuco", "Checkerboard", "Markers", "NoTarget", "Scene", "Tag", "Target"]

TARGETS: dict[str, type[Target]] = {kind.type: kind for kind in (AprilGrid, Charuco, Checkerboard, Tag)}
