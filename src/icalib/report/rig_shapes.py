"""Shapes of sensors and targets as polylines, for the report and the 3D view."""

from __future__ import annotations

import numpy as np

from icalib.geometry.targets import Target
from icalib.result import Calibration
from icalib.sensors import SENSOR_KINDS, call_kind, facet

PEN_UP = np.full((1, 3), np.nan)  # separates two polylines: a row of NaN
_ROUND = np.linspace(0.0, 2.0 * np.pi, 41)
CIRCLE = np.stack([np.cos(_ROUND), np.sin(_ROUND)], axis=1)
_LEAST_SPREAD_M = 0.02


def frames_of(c: Calibration) -> dict[str, np.ndarray]:
    """T_imu_sensor (4, 4) of the reference (identity) and of each mounted sensor, by name."""
    return {c.reference: np.eye(4)} | {name: c.T_imu_sensor(name) for name in c.mounted}


def spread_of(c: Calibration) -> float:
    """Size of the rig [m], which scales the drawn shapes: largest extent of the sensor origins along an axis of the imu
    frame."""
    origins = np.array([T[:3, 3] for T in frames_of(c).values()])
    return max(float(np.ptp(np.vstack([origins, np.zeros(3)]), axis=0).max()), _LEAST_SPREAD_M)


def shape_of(c: Calibration, name: str) -> np.ndarray | None:
    """(n, 3) polylines of a sensor's shape in the sensor frame [m]; None if its kind has no shape."""
    return call_kind(c.rig["sensors"][name]["type"], "show", "shape", c, name, spread_of(c))


def legends(c: Calibration) -> list[str]:
    """Explanations of the shapes of all kinds of sensors in the rig."""
    texts = (getattr(facet(kind, "show"), "LEGEND", "") for kind in SENSOR_KINDS if c.of_type(kind))
    return [legend for legend in texts if legend]


def body_outline(target: Target, body: int) -> np.ndarray:
    """(6, 3) bounding rectangle of a body of the target [m], closed, in the plane z = 0 of its frame. The last row is
    NaN."""
    (x0, y0, _), (x, y, _) = (f(target.points[target.body == body], axis=0) for f in (np.min, np.max))
    corners = np.array([(x0, y0, 0.0), (x, y0, 0.0), (x, y, 0.0), (x0, y, 0.0), (x0, y0, 0.0)])
    return np.vstack([corners, PEN_UP])


def scene_in_worlds(c: Calibration) -> list[tuple[str, np.ndarray]]:
    """Name of the target's scene and R_world_scene (3, 3), by recording. Without an IMU scene and world frame are
    equal. Empty if there is an IMU and the target was never observed."""
    tilts = [(g.sensor, g.value) for g in c.groups if g.name == "tilt"]
    return tilts or ([("board0", np.eye(3))] if c.imu is None else [])
