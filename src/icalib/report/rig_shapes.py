"""How the parts of a rig and of its target look, as polylines: what the report and the 3D view draw alike."""

from __future__ import annotations

import numpy as np

from icalib.geometry.targets import Target
from icalib.result import Calibration

PEN_UP = np.full((1, 3), np.nan)  # a row between two lines
_ROUND = np.linspace(0.0, 2.0 * np.pi, 41)
CIRCLE = np.stack([np.cos(_ROUND), np.sin(_ROUND)], axis=1)
_LEAST_SPREAD_M = 0.02


def frames(c: Calibration) -> dict[str, np.ndarray]:
    """T_imu_sensor (4, 4) of the body and of all that is mounted on it."""
    return {c.body: np.eye(4)} | {name: c.T_imu_sensor(name) for name in c.mounted}


def spread(c: Calibration) -> float:
    """How far apart the sensors are along an axis of the imu frame [m], which says how large they are drawn."""
    origins = np.array([T[:3, 3] for T in frames(c).values()])
    return max(float(np.ptp(np.vstack([origins, np.zeros(3)]), axis=0).max()), _LEAST_SPREAD_M)


def rings(radius: float) -> np.ndarray:
    """Three circles about z, as a spinning LiDAR looks level, up and down."""
    x, y = CIRCLE.T
    tilted = ((np.cos(e), np.sin(e)) for e in np.deg2rad([-15.0, 0.0, 15.0]))
    circles = [radius * np.stack([a * x, a * y, np.full_like(x, b)], axis=1) for a, b in tilted]
    return np.vstack([part for circle in circles for part in (circle, PEN_UP)])


def axle(c: Calibration, name: str) -> np.ndarray:
    """The two wheels as discs, and the axle between them; nothing where radii and baseline are not known."""
    known = {g.name: g.value for g in c.groups if g.sensor == name}
    if "radii" not in known:
        return PEN_UP
    left, right = (np.array([0.0, s * 0.5 * known["baseline"][0], 0.0]) for s in (1.0, -1.0))
    rim = np.insert(CIRCLE, 1, 0.0, axis=1)
    discs = [(hub + r * rim, hub + r * rim[::5]) for hub, r in zip((left, right), known["radii"], strict=True)]
    pen = [left, right, PEN_UP]
    for hub, (circle, ends) in zip((left, right), discs, strict=True):
        pen += [circle, PEN_UP, *(np.stack([hub, end, PEN_UP[0]]) for end in ends)]
    return np.vstack(pen)


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
