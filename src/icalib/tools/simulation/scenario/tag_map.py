"""Scenario with tags on two walls and the floor of a room's corner, and a handheld rig in front of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.geometry.targets import AprilGrid, Markers, Scene, Target
from icalib.tools.simulation.scenario.scenario import Scenario, handheld

_TAGS = Markers("tag36h11", 0.16, tuple(range(40, 76, 3)))
_GRID = AprilGrid(3, 3, 0.1, 0.3)  # ids 0 to 8
# Rotations R_world_surface: columns are x, y and normal of a surface. Walls are the planes x = 0 and y = 0; the floor
# is z = 0.
_WALLS_AND_FLOOR = np.array([[(0, 0, 1), (1, 0, 0), (0, 1, 0)], [(-1, 0, 0), (0, 0, 1), (0, 1, 0)], np.eye(3)])
# x, y of the middle of each tag on its surface [m], and its counter-clockwise rotation [deg].
_PLACES = (
    ((0.20, 0.70, 4.0), (0.50, 0.30, 90.0), (0.45, 0.95, -12.0), (0.95, 1.05, 0.0)),
    ((-0.25, 0.40, -3.0), (-0.65, 0.30, 25.0), (-0.50, 0.85, 178.0), (-1.00, 0.65, 0.0)),
    ((0.30, 0.30, 45.0), (0.75, 0.25, 7.0), (0.25, 0.80, -80.0), (0.75, 0.70, 130.0)),
)
_GRID_PLACE = (1.00, 0.55, -15.0)  # on the first wall


def tag_map(duration_s: float = 20.0, noiseless: bool = False, with_grid: bool = False) -> Scenario:
    """The rig of `handheld`, moved by hand 1.7 m in front of a room's corner with twelve tags of 0.16 m. Each image
    shows at least 3 tags. with_grid: the target is a scene of these tags ("tags") and an AprilGrid ("grid")."""
    T_world_bodies = np.stack([_pose(_TAGS, i, *place) for i in range(3) for place in _PLACES[i]])
    target: Target = _TAGS
    if with_grid:
        target = Scene(("tags", "grid"), (_TAGS, _GRID))
        T_world_bodies = np.concatenate([T_world_bodies, _pose(_GRID, 0, *_GRID_PLACE)[None]])
    base = handheld(duration_s, noiseless=noiseless)
    motion = replace(base.motion, distance_m=1.7)
    return replace(base, target=target, motion=motion, T_world_board=_faced(), T_world_bodies=T_world_bodies)


def _pose(sheet: Target, surface: int, x: float, y: float, turn_deg: float) -> np.ndarray:
    """(4, 4) T_world_body of a sheet whose middle is at x, y of a surface [m], rotated in its plane counter-clockwise
    by turn_deg."""
    c, s = np.cos(np.deg2rad(turn_deg)), np.sin(np.deg2rad(turn_deg))
    T = np.eye(4)
    T[:3, :3] = _WALLS_AND_FLOOR[surface] @ [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    T[:3, 3] = _WALLS_AND_FLOOR[surface] @ [x, y, 0.0] - T[:3, :3] @ (0.5 * sheet.points.max(axis=0))
    return T


def _faced() -> np.ndarray:
    """(4, 4) pose in the world that the motion faces, near the room's corner; its z points into the room and up."""
    z = np.array([1.0, 1.0, 0.6]) / np.linalg.norm([1.0, 1.0, 0.6])
    x = np.cross([0.0, 0.0, 1.0], z)
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3] = np.stack([x, np.cross(z, x), z, [0.35, 0.35, 0.4]], axis=1)
    return T
