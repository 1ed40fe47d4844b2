"""The room: its faces, its points, and rays against obvious formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.tools.simulation import hills_of_slope
from icalib.tools.simulation.room import distances


def met(room, origin, direction):
    """Distance to the nearest face seen from its front, by solving origin + t d = o + s u + r v for each."""
    best = np.inf
    for o, u, v, mark in room.faces:
        t, s, r = np.linalg.solve(np.column_stack([-direction, u, v]), origin - o)
        inside = s >= 0 and r >= 0 and (s + r <= 1 if mark[0] else s <= 1 and r <= 1)
        if t > 0 and inside and direction @ np.cross(u, v) < 0:
            best = min(best, t)
    return best


@pytest.fixture(scope="module")
def rays():
    rng = np.random.default_rng(3)
    origins = rng.uniform([-3.0, -2.5, 0.4], [3.0, 2.5, 2.5], (400, 3))
    return origins, rng.standard_normal((400, 3))


def test_rays_meet_the_nearest_face(robot, rays):
    found = np.empty(400)
    distances(robot.room.surfaces, rays[0], rays[1], found)
    np.testing.assert_allclose(found, [met(robot.room, o, d) for o, d in zip(*rays, strict=True)], rtol=1e-10)
    assert np.isfinite(found).all()  # the room is closed


def test_rays_meet_hills_where_they_pass_below_them(robot, rays):
    hills = hills_of_slope(12.0)
    room = replace(robot.room, hills=hills)
    found = np.empty(400)
    distances(room.surfaces, rays[0], rays[1], found)
    on_ground = 0
    for i, (o, d) in enumerate(zip(*rays, strict=True)):
        wall = met(room, o, d)
        path = o + np.linspace(0.0, min(wall, found[i]), 20_000)[:, None] * d
        gap = path[:, 2] - hills.height(path[:, :2])
        if found[i] < wall - 1e-9:
            on_ground += 1
            assert abs(gap[-1]) < 1e-8 and (gap[:-1] > 0.0).all()
        else:
            assert found[i] == pytest.approx(wall, rel=1e-10) and (gap[:-1] > 0.0).all()
    assert on_ground > 50
    xy = np.random.default_rng(0).uniform(-5.0, 5.0, (50_000, 2))
    h = 1e-5
    slope = np.hypot(*((hills.height(xy + h * e) - hills.height(xy - h * e)) / (2 * h) for e in np.eye(2)))
    assert 11.0 < np.rad2deg(np.arctan(slope.max())) <= 12.0


def test_a_ray_from_the_ground_leaves_it(robot):
    """As those of a sensor whose frame is that of the wheels, on the ground."""
    hills = hills_of_slope(12.0)
    room = replace(robot.room, hills=hills)
    xy = np.random.default_rng(1).uniform(-2.0, 2.0, (50, 2))
    origins = np.column_stack([xy, hills.height(xy)])
    upwards, downwards = (np.tile([0.1, 0.05, z], (50, 1)) for z in (0.5, -0.5))
    found = np.empty(50)
    distances(room.surfaces, origins, upwards, found)
    np.testing.assert_allclose(found, [met(room, o, d) for o, d in zip(origins, upwards, strict=True)], rtol=1e-10)
    distances(room.surfaces, origins, downwards, found)
    np.testing.assert_allclose(found, 0.0, atol=1e-8)


def test_planes_and_points_are_those_of_the_faces(robot):
    planes, faces = robot.room.planes, robot.room.faces
    for (nx, ny, nz, d), (o, u, v, _) in zip(planes, faces, strict=True):
        n = np.array([nx, ny, nz])
        for corner in (o, o + u, o + v):
            assert n @ corner == pytest.approx(d, abs=1e-12)
    # Seen from the middle, walls, floor and ceiling show their front.
    middle = np.array([0.0, 0.0, 1.5])
    assert (planes[:6, :3] @ middle > planes[:6, 3]).all()
    points, normals = robot.room.points(3000, np.random.default_rng(1))
    gap = np.abs(points @ planes[:, :3].T - planes[:, 3])
    assert gap.min(axis=1).max() < 1e-12
    np.testing.assert_allclose(normals, planes[gap.argmin(axis=1), :3], atol=1e-12)
    floor = np.abs(points[:, 2]) < 1e-12
    share = 120.0 / (120.0 + 120.0 + 2 * 3.2 * 22.0 + 25.0)  # 25 m^2 or so of blocks
    assert floor.mean() == pytest.approx(share, abs=0.03)
    hilly = replace(robot.room, hills=hills_of_slope(12.0))
    points, _ = hilly.points(2000, np.random.default_rng(1))
    on_hills = np.abs(points[:, 2] - hilly.hills.height(points[:, :2])) < 1e-12
    assert 0.2 < on_hills.mean() < 0.5
