"""LiDAR scans: each point, moved with the truth at its own instant, lies on its plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import hills_of_slope, simulate

from .conftest import alone, on_ground


def in_world(sim, shift_s: float | np.ndarray = 0.0):
    """(N, 3) the points in the world, by raw stamps, offsets and the truth; shift_s is added to their instants."""
    stream, truth = sim.measurements.lidars[0], sim.truth
    since = (stream.stamps_ns - truth.imu_clock_origin_ns) * 1e-9 + truth.time_offset[stream.name]
    seconds = np.repeat(since, np.diff(stream.start)) + stream.offset_s.astype(np.float64) + shift_s
    T = truth.T_imu_sensor[stream.name]
    R, p, _ = truth.pose_at(seconds)
    return p + np.einsum("nij,nj->ni", R, stream.xyz.astype(np.float64) @ T[:3, :3].T + T[:3, 3])


def distance(sim, points):
    n_d = sim.truth.planes[sim.measurements.lidars[0].plane]
    return np.sum(n_d[:, :3] * points, axis=1) - n_d[:, 3]


@pytest.fixture(scope="module")
def quiet(robot):
    return simulate(replace(alone(robot), duration_s=3.0, sensors=robot.sensors, robot_noise_enabled=False), 4)


def test_points_lie_on_their_planes_at_their_own_instants(robot):
    sim = simulate(replace(alone(robot), sensors=robot.sensors, robot_noise_enabled=False), 4)
    stream = sim.measurements.lidars[0]
    assert len(stream.stamps_ns) == 31 and (np.diff(stream.start) == 180 * 8).all()
    assert len(np.unique(stream.plane)) > 8 and stream.plane.min() >= 0
    # xyz is float32: half a unit in the last place of 8 m is 5e-7 m.
    np.testing.assert_allclose(distance(sim, in_world(sim)), 0.0, atol=3e-6)
    assert np.abs(distance(sim, in_world(sim, 1e-3))).max() > 1e-3
    one_pose = sim.measurements.lidars[0].offset_s * -1.0
    assert np.abs(distance(sim, in_world(sim, one_pose))).max() > 0.05


def test_a_scan_turns_once_and_its_rings_fire_one_after_another(robot, quiet):
    stream, lidar = quiet.measurements.lidars[0], robot.of(SimLidar)[0]
    np.testing.assert_array_equal(np.diff(stream.stamps_ns), 125_000_000)
    assert stream.stamps_ns[0] == 77 + 60_000_000  # 50 ms of the IMU's clock, the LiDAR's lags by -10 ms
    xyz, offset = stream.xyz[:1440].reshape(180, 8, 3), stream.offset_s[:1440].reshape(180, 8)
    azimuth = np.unwrap(np.arctan2(xyz[:, :, 1], xyz[:, :, 0]), axis=0)
    np.testing.assert_allclose(np.diff(azimuth, axis=0), 2.0 * np.pi / 180, atol=1e-6)
    level = np.hypot(xyz[..., 0], xyz[..., 1])
    elevation = np.rad2deg(np.arctan2(xyz[..., 2], level))
    low, high = lidar.elevation_deg
    np.testing.assert_allclose(elevation, np.broadcast_to(np.linspace(low, high, 8), (180, 8)), atol=1e-4)
    np.testing.assert_allclose(offset[:, 0], np.arange(180) * 0.125 / 180, atol=1e-8)
    np.testing.assert_allclose(offset - offset[:, :1], np.broadcast_to(2.304e-6 * np.arange(8), (180, 8)), atol=1e-8)


def test_noise_is_along_the_beam_and_of_the_size_stated(robot, quiet):
    noisy = simulate(replace(quiet.scenario, robot_noise_enabled=True), 4)
    a, b = noisy.measurements.lidars[0], quiet.measurements.lidars[0]
    np.testing.assert_array_equal(a.plane, b.plane)
    beam = b.xyz / np.linalg.norm(b.xyz, axis=1, keepdims=True)
    error = a.xyz.astype(np.float64) - b.xyz
    along = np.sum(error * beam, axis=1)
    np.testing.assert_allclose(error, along[:, None] * beam, atol=3e-6)
    n = len(along)
    assert along.std() == pytest.approx(0.03, rel=4.0 / np.sqrt(2.0 * n))
    assert abs(along.mean()) < 4.0 * 0.03 / np.sqrt(n)


def test_errors_of_ranges_and_angles(robot, quiet):
    lidar, off_deg, off_m = robot.of(SimLidar)[0], 0.1 * np.arange(8), 0.01 * np.arange(8)
    rings = {
        "elevation_errors_deg": tuple(off_deg),
        "ring_offsets_m": tuple(off_m),
        "azimuth_errors_deg": tuple(2.0 * off_deg),
    }
    bent = replace(lidar, range_offset_m=0.03, **rings)
    sensors = tuple(bent if s is lidar else s for s in robot.sensors)
    sim = simulate(replace(quiet.scenario, sensors=sensors), 4)
    xyz = sim.measurements.lidars[0].xyz.astype(np.float64).reshape(-1, 180, 8, 3)
    level, off = np.hypot(xyz[..., 0], xyz[..., 1]), np.deg2rad(off_deg)
    true = (np.linalg.norm(xyz, axis=3) - 0.03 - off_m)[..., None] * np.stack(
        [
            np.cos(np.arctan2(xyz[..., 1], xyz[..., 0]) + 2.0 * off) * np.cos(np.arctan2(xyz[..., 2], level) + off),
            np.sin(np.arctan2(xyz[..., 1], xyz[..., 0]) + 2.0 * off) * np.cos(np.arctan2(xyz[..., 2], level) + off),
            np.sin(np.arctan2(xyz[..., 2], level) + off),
        ],
        axis=3,
    )
    stream = replace(sim.measurements.lidars[0], xyz=true.reshape(-1, 3).astype(np.float32))
    corrected = replace(sim, measurements=sim.measurements.with_streams(stream))
    np.testing.assert_allclose(distance(corrected, in_world(corrected)), 0.0, atol=3e-6)
    assert np.abs(distance(sim, in_world(sim))).max() > 0.02


def test_points_on_hills_have_no_plane(robot):
    scenario = replace(on_ground(robot, "ramps"), features=None, robot_noise_enabled=False)
    sim = simulate(scenario, 5)
    world, plane = in_world(sim), sim.measurements.lidars[0].plane
    hills = hills_of_slope(12.0)
    ground = plane < 0
    assert 0.1 < ground.mean() < 0.7
    np.testing.assert_allclose(world[ground, 2], hills.height(world[ground, :2]), atol=3e-6)
    np.testing.assert_allclose(distance(sim, world)[~ground], 0.0, atol=3e-6)


def test_what_is_out_of_range_gives_no_point(robot):
    lidar = replace(robot.of(SimLidar)[0], range_m=(3.0, 5.0))
    sim = simulate(
        replace(alone(robot), duration_s=1.0, sensors=(lidar, *robot.of(SimWheels)), robot_noise_enabled=False), 4
    )
    stream = sim.measurements.lidars[0]
    reach = np.linalg.norm(stream.xyz, axis=1)
    assert 3.0 - 1e-5 < reach.min() < 3.1 and 4.9 < reach.max() < 5.0 + 1e-5
    assert 0 < len(reach) < 0.9 * 1440 * len(stream.stamps_ns)
    np.testing.assert_allclose(distance(sim, in_world(sim)), 0.0, atol=3e-6)
    assert SimLidar("lidar0", np.eye(4)).azimuth_steps == 1800
