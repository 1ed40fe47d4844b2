"""Shapes of sensors and targets as polylines, for the report and the 3D view."""

from __future__ import annotations

import numpy as np

from icalib.geometry.targets import Target
from icalib.result import Calibration
from icalib.sensors import SENSOR_KINDS, answer, facet

PEN_UP = np.full((1, 3), np.nan)  # a row between two lines
_ROUND = np.linspace(0.0, 2.0 * np.pi, 41)
CIRCLE = np.stack([np.cos(_ROUND), np.sin(_ROUND)], axis=1)
_LEAST_SPREAD_M = 0.02


def frames(c: Calibration) -> dict[str, np.ndarray]:
    """T_imu_sensor (4, 4) of the body and of all that is mounted on it."""
    return {c.reference: np.eye(4)} | {name: c.T_imu_sensor(name) for name in c.mounted}


def spread(c: Calibration) -> float:
    """Largest distance of sensors along an axis of the imu frame [m], the scale of their shapes."""
    origins = np.array([T[:3, 3] for T in frames(c).values()])
    return max(float(np.ptp(np.vstack([origins, np.zeros(3)]), axis=0).max()), _LEAST_SPREAD_M)


def shape(c: Calibration, name: str) -> np.ndarray | None:
    """(n, 3) lines of a sensor in its own frame [m]; None where its kind has no shape."""
    return answer(c.rig["sensors"][name]["type"], "show", "shape", c, name, spread(c))


def legends(c: Calibration) -> list[str]:
    """Explanations of the shapes of the kinds in the rig."""
    own = (getattr(facet(kind, "show"), "LEGEND", "") for kind in SENSOR_KINDS if c.of_type(kind))
    return [legend for legend in own if legend]


def body_outline(target: Target, body: int) -> np.ndarray:
    """(6, 3) the rectangle about a body of the target in its own frame, the pen lifted behind it."""
    (x0, y0, _), (x, y, _) = (f(target.points[target.body == body], axis=0) for f in (np.min, np.max))
    corners = np.array([(x0, y0, 0.0), (x, y0, 0.0), (x, y, 0.0), (x0, y, 0.0), (x0, y0, 0.0)])
    return np.vstack([corners, PEN_UP])


def scene_in_worlds(c: Calibration) -> list[tuple[str, np.ndarray]]:
    """Name and R_world_scene (3, 3) of the target's scene in the world of each recording. Without an IMU the scene's
    frame is the world's; none where the target was not seen."""
    tilts = [(g.sensor, g.value) for g in c.groups if g.name == "tilt"]
    return tilts or ([("board0", np.eye(3))] if c.imu is None else [])
