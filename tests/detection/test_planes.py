"""Planes found in clouds: of simulated rooms whose points know their face, and of small scenes made by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.detection.planes import PlaneSearch, find_planes
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.simulation import load_scenario, simulate

EXAMPLE = Path(__file__).parents[2] / "examples" / "paper" / "table2-3d.yaml"
SEARCH = PlaneSearch(position_m=0.01, angle_rad=np.deg2rad(0.5))
NOISE = 0.03


def smooth(rng, seconds, largest):
    """(n, 3) a slow motion of at most `largest`."""
    wave = sum(
        rng.normal(size=3) * np.sin(2 * np.pi * rng.uniform(0.1, 1.0, 3) * seconds[:, None] + rng.uniform(0, 6, 3))
        for _ in range(3)
    )
    return wave * (largest / np.linalg.norm(wave, axis=1).max())


@pytest.fixture(scope="module")
def room():
    """Points of a room and where they were seen from, in the world, by a trajectory wrong by up to 1 cm and 0.5 deg;
    the face of each."""
    scenario = load_scenario(EXAMPLE)
    lidar = replace(scenario.of(SimLidar)[0], azimuth_steps=900)
    scenario = replace(scenario, duration_s=10.0, cameras=(), features=None, board=False, sensors=(lidar,))
    simulation = simulate(scenario, 2)
    stream, truth, rng = simulation.measurements.lidars[0], simulation.truth, np.random.default_rng(0)
    stamps = (stream.stamps_ns - truth.imu_clock_origin_ns) * 1e-9 + lidar.time_offset_s
    times = np.repeat(stamps, np.diff(stream.start)) + stream.offset_s
    columns, of_point = np.unique(np.round(times, 6), return_inverse=True)
    R, p, _ = truth.pose_at(columns)
    R = R @ Rotation.from_rotvec(smooth(rng, columns, np.deg2rad(0.5))).as_matrix()
    p = p + smooth(rng, columns, 0.01) + R @ lidar.T_imu_sensor[:3, 3]
    R = R @ lidar.T_imu_sensor[:3, :3]
    return np.einsum("nij,nj->ni", R[of_point], stream.xyz) + p[of_point], p[of_point], stream.plane


def test_every_large_plane_of_a_room_is_found_once_and_hardly_a_point_is_on_a_wrong_one(room):
    points, seen_from, face = room
    found = find_planes(points, seen_from, SEARCH)
    plane = found.of_points(points, seen_from, SEARCH)
    used = plane >= 0
    table = np.zeros((len(found.planes), face.max() + 1), dtype=int)
    np.add.at(table, (plane[used], face[used]), 1)
    own = table.argmax(axis=1)
    assert len(set(own)) == len(own)
    assert set(np.flatnonzero(np.bincount(face) > 0.01 * len(face))) <= set(own)
    assert table.max(axis=1).sum() > 0.995 * used.sum()
    assert used.mean() > 0.8


def sheet(rng, n, size, z=0.0):
    """Points of a rectangle at height z, with noise along z."""
    xy = (rng.random((n, 2)) - 0.5) * size
    return np.column_stack([xy, z + NOISE * rng.normal(size=n)])


def test_a_thin_wall_has_two_sides():
    rng = np.random.default_rng(1)
    above, below = sheet(rng, 20000, 4.0, 0.05), sheet(rng, 20000, 4.0, 0.0)
    points = np.concatenate([above, below + [4.0, 0.0, 0.0]])
    seen_from = np.where(np.arange(40000)[:, None] < 20000, [0.0, 0.0, 2.0], [4.0, 0.0, -2.0])
    found = find_planes(points, seen_from, PlaneSearch())
    normals = sorted(found.planes[:, 2])
    np.testing.assert_allclose(normals, [-1.0, 1.0], atol=1e-4)
    plane = found.of_points(points, seen_from, PlaneSearch())
    for own in (plane[:20000], plane[20000:]):
        assert len(set(own[own >= 0])) == 1


@pytest.mark.parametrize(("gap", "seen_from", "share"), [(0.5, 3.0, 0.5), (0.5, 0.25, 0.0), (0.0, 3.0, 0.0)])
def test_a_wall_that_stands_twice_is_seen_through(gap: float, seen_from: float, share: float):
    """The lower half of the points lies `gap` below the others. From between both nothing is seen through."""
    rng = np.random.default_rng(4)
    points = np.concatenate([sheet(rng, 20000, 4.0), sheet(rng, 20000, 4.0, -gap)])
    origins = np.full((40000, 3), [0.0, 0.0, 3.0])
    origins[20000:, 2] = seen_from - gap
    search = PlaneSearch()
    found = find_planes(points, origins, search)
    plane = found.of_points(points, origins, search)
    assert found.share_seen_through(points, origins, plane, search) == pytest.approx(share, abs=0.05)


def test_a_wall_between_voxels_is_one_plane_where_it_is():
    """Half of its noise is in either layer of voxels, whose own means are 2.4 cm off."""
    rng = np.random.default_rng(2)
    points = sheet(rng, 40000, 6.0)
    points[:, 2] += 0.9  # an edge of voxels of 0.3 m
    found = find_planes(points, np.full((40000, 3), [0.0, 0.0, 3.0]), PlaneSearch())
    (plane,) = found.planes
    assert plane[:3] @ plane[3:] == pytest.approx(0.9, abs=2e-3)
    assert found.areas_m2[0] == pytest.approx(36.0, rel=0.15)


def test_what_bends_is_no_plane():
    rng = np.random.default_rng(3)
    flat = sheet(rng, 40000, 4.0)
    bent = flat + np.column_stack([np.zeros((40000, 2)), 0.04 * flat[:, 0] ** 2])
    seen_from = np.full((40000, 3), [0.0, 0.0, 3.0])
    assert len(find_planes(flat, seen_from).planes) == 1
    assert len(find_planes(bent, seen_from).planes) == 0


@each("height", [0.03, 0.016])
def test_what_waves_within_its_noise_is_no_plane(height: float):
    """Too little for each of its squares, and not in one direction: planes of such hills turned robots by 0.25 deg."""
    rng = np.random.default_rng(5)
    flat, wall = sheet(rng, 40000, 4.0), sheet(rng, 60000, 4.0)[:, [2, 0, 1]] + [2.5, 0.0, 2.5]
    waves = height * np.sin(3.0 * flat[:, 0]) * np.cos(2.0 * flat[:, 1])
    seen_from = np.full((100000, 3), [0.0, 0.0, 3.0])
    search = PlaneSearch(position_m=1e-3, angle_rad=1e-3)
    assert len(find_planes(np.concatenate([flat, wall]), seen_from, search).planes) == 2
    (left,) = find_planes(np.concatenate([flat + waves[:, None] * [0.0, 0.0, 1.0], wall]), seen_from, search).planes
    assert abs(left[0]) > 0.99


def test_where_all_surfaces_wave_the_planes_stay():
    """It is not they: poses or the times of points are wrong then, and without planes nobody would say so."""
    rng = np.random.default_rng(5)
    flat, wall = sheet(rng, 40000, 4.0), sheet(rng, 60000, 4.0)[:, [2, 0, 1]] + [2.5, 0.0, 2.5]
    flat[:, 2] += 0.03 * np.sin(3.0 * flat[:, 0]) * np.cos(2.0 * flat[:, 1])
    wall[:, 0] += 0.03 * np.sin(3.0 * wall[:, 1]) * np.cos(2.0 * wall[:, 2])
    points, seen_from = np.concatenate([flat, wall]), np.full((100000, 3), [0.0, 0.0, 3.0])
    assert len(find_planes(points, seen_from, PlaneSearch(position_m=1e-3, angle_rad=1e-3)).planes) == 2


def test_points_near_two_planes_or_in_grazing_beams_belong_to_none():
    rng = np.random.default_rng(4)
    floor = sheet(rng, 40000, 4.0)
    wall = np.roll(sheet(rng, 20000, (4.0, 2.0)), 1, axis=1) + [-2.0, 0.0, 1.0]
    points, seen_from = np.concatenate([floor, wall]), np.tile([0.5, 0.0, 1.2], (60000, 1))
    found = find_planes(points, seen_from)
    assert len(found.planes) == 2
    probe = np.array([[0.0, 0.0, 0.0], [-2.0, 0.3, 1.0], [-1.97, 0.3, 0.02], [0.0, 0.0, 0.5]])
    eyes = np.tile([0.5, 0.0, 1.2], (4, 1))
    plane = found.of_points(probe, eyes, PlaneSearch())
    assert (plane >= 0).tolist() == [True, True, False, False]
    assert plane[0] != plane[1]
    low = np.tile([1.9, 0.0, 0.1], (1, 1))
    assert found.of_points(probe[:1], low, PlaneSearch())[0] == -1
    assert found.of_points(probe[:1], eyes[:1] * [1.0, 1.0, -1.0], PlaneSearch())[0] == -1
    foot = np.array([[-2.0, 0.3, 0.05], [-2.0, 0.3, 0.5]])  # of the wall, and further up
    assert (found.of_points(foot, np.tile(low, (2, 1)), PlaneSearch()) >= 0).tolist() == [False, True]


def test_which_points_belong_to_a_small_face_does_not_depend_on_their_noise():
    """Else those left on it err one way, and so does the plane: by 1.5 mm on blocks in a room, or 8 sigma."""
    rng = np.random.default_rng(6)
    floor = np.column_stack([rng.uniform(-3.0, 3.0, (150000, 2)), np.zeros(150000)])
    top = np.column_stack([rng.uniform([-0.6, -0.4], [0.6, 0.4], (30000, 2)), np.full(30000, 0.7)])
    front = np.column_stack([rng.uniform(-0.6, 0.6, 20000), np.full(20000, -0.4), rng.uniform(0.0, 0.7, 20000)])
    eye, hidden = np.array([0.3, -2.5, 1.6]), (np.abs(floor[:, :2]) < [0.6, 0.4]).all(axis=1)
    clean = np.concatenate([floor[~hidden], top, front])
    beams = (clean - eye) / np.linalg.norm(clean - eye, axis=1)[:, None]
    error = rng.normal(size=len(clean))
    points, seen_from = clean + 0.03 * error[:, None] * beams, np.tile(eye, (len(clean), 1))
    search = PlaneSearch(position_m=1e-3, angle_rad=1e-4)
    found = find_planes(points, seen_from, search)
    plane = found.of_points(points, seen_from, search)
    assert len(found.planes) == 3
    for q in range(3):
        own = error[plane == q]
        assert len(own) > 5000
        assert abs(own.mean()) < 3.5 / np.sqrt(len(own))


def test_where_there_are_no_planes_none_is_found():
    rng = np.random.default_rng(5)
    points, seen_from = rng.uniform(-2.0, 2.0, (20000, 3)), np.zeros((20000, 3))
    found = find_planes(points, seen_from)
    assert len(found.planes) == 0
    assert (found.of_points(points, seen_from, PlaneSearch()) == -1).all()
    nothing = find_planes(points[:0], seen_from[:0])
    assert len(nothing.planes) == 0
