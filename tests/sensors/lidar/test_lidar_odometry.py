"""Parts of the LiDAR's guess against obvious formulas: registration, its linear systems, the IMU's motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each
from tests.typed import random_rotations

from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.rate_correlation import GyroRotation
from icalib.initialize.trajectories import ImuTrajectory, SignalIntegrals, system_from_readings, system_from_trajectory
from icalib.sensors.lidar.initialize import odometry
from icalib.sensors.lidar.initialize.odometry import (
    ACCELERATION_SIGMA,
    ANGULAR_ACCELERATION_SIGMA,
    GYRO_RATE_SIGMA,
    GYRO_ROTATION_SIGMA,
    KNOWN_TRANSLATION_SIGMA,
    POINT_SIGMA_M,
    STEP_POSITION_SIGMA,
    STEP_ROTATION_SIGMA,
    PosePrediction,
    add_prediction,
    lidar_trajectory,
    predicted_pose,
    sampled_scans,
)
from icalib.sensors.lidar.initialize.voxel_map import ScanPose, VoxelMap, accumulate_scan, corrected_pose, insert

SCALE = 0.3


@pytest.fixture(scope="module")
def scan():
    """A map of one voxel, with the plane z = 1 + 0.1 x + 0.2 y, and points of a scan near it with their instants."""
    rng = np.random.default_rng(0)
    xy = rng.uniform(1.0, 9.0, (500, 2))
    surface = np.column_stack([xy, 1.0 + xy @ [0.1, 0.2]])
    voxels = VoxelMap.empty(10.0, 16)
    still = ScanPose(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    insert(voxels, still, surface, np.zeros(500), 0, 1.0)
    R = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    pose = ScanPose(R, np.array([2.0, 1.0, 0.5]), np.array([0.2, -0.3, 0.4]), np.array([0.5, -0.2, 0.3]))
    tau = rng.uniform(-0.06, 0.06, 200)
    near = surface[:200] + rng.normal(size=(200, 3)) * 0.2 - (pose.position + tau[:, None] * pose.velocity)
    xyz = np.einsum(
        "nij,nj->ni", (R @ Rotation.from_rotvec(tau[:, None] * pose.rate).as_matrix()).transpose(0, 2, 1), near
    )
    return voxels, pose, np.ascontiguousarray(xyz), tau


def distances(pose, xyz, tau):
    turned = pose.rotation @ Rotation.from_rotvec(tau[:, None] * pose.rate).as_matrix()
    y = np.einsum("nij,nj->ni", turned, xyz) + pose.position + tau[:, None] * pose.velocity
    return (y[:, 2] - 1.0 - y[:, :2] @ [0.1, 0.2]) / np.sqrt(1.05)


def test_normal_equations_of_a_scan(scan):
    voxels, pose, xyz, tau = scan
    H, g = np.empty((12, 12)), np.empty(12)
    met, near = accumulate_scan(voxels, pose, xyz, tau, 0, SCALE, H, g)
    r, h = distances(pose, xyz, tau), 1e-6
    assert met == len(tau) and near == (np.abs(r) < 2.0).sum()
    J = np.stack(
        [
            distances(corrected_pose(pose, h * e), xyz, tau) - distances(corrected_pose(pose, -h * e), xyz, tau)
            for e in np.eye(12)
        ]
    )
    J = J.T / (2.0 * h)
    w = (1.0 + (r / SCALE) ** 2) ** -2.0
    size = np.sqrt(np.diag(J.T @ (w[:, None] * J)))
    # A turn of up to 0.03 rad within the scan stands beside dw, and is left out of its columns.
    np.testing.assert_allclose(H / np.outer(size, size), J.T @ (w[:, None] * J) / np.outer(size, size), atol=0.03)
    np.testing.assert_allclose(
        H[:6, :6] / np.outer(size, size)[:6, :6], (J.T @ (w[:, None] * J) / np.outer(size, size))[:6, :6], atol=1e-3
    )
    np.testing.assert_allclose(g[:6] / size[:6], (J.T @ (w * r) / size)[:6], atol=1e-3 * float(np.linalg.norm(r)))


def test_voxels_forget(scan):
    voxels, pose, _, _ = scan
    own = VoxelMap.empty(10.0, 16)
    still = pose._replace(rotation=np.eye(3), position=np.zeros(3), rate=np.zeros(3), velocity=np.zeros(3))
    rng = np.random.default_rng(1)
    for k, height in enumerate((2.0, 3.0)):
        points = np.column_stack([rng.uniform(1.0, 9.0, (300, 2)), np.full(300, height)])
        insert(own, still, points, np.zeros(300), 5 * k, 0.5)
    assert own.size[0] == 1 and own.flat[0]
    assert own.centre[0, 2] == pytest.approx((300 * 0.5**5 * 2.0 + 300 * 3.0) / (300 * 0.5**5 + 300))
    assert abs(own.normal[0, 2]) > 0.999
    own.clear()
    assert own.size[0] == 0 and (own.key == -1).all()


def test_a_full_map_takes_no_more():
    own = VoxelMap.empty(1.0, 16)
    still = ScanPose(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    insert(own, still, np.random.default_rng(0).uniform(-50.0, 50.0, (1000, 3)), np.zeros(1000), 0, 1.0)
    assert own.size[0] == 16


@pytest.fixture(scope="module")
def path(free_robot):
    """The true path of the LiDAR in the world: instants on the imu clock, R_world_lidar, p_world_lidar."""
    t = np.arange(1.0, 15.0, 0.125)
    R, p, _ = free_robot.pose_at(t)
    true = free_robot.truth()
    return t, R, p, R @ true.rotation, p + R @ true.position


def residual(rows, x):
    return rows.b - rows.A @ x


def test_way_against_a_known_motion(free_robot, path):
    t, R, p, R_lidar, p_lidar = path
    true = free_robot.truth()
    Q = Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix()  # the map stands anyhow
    system = system_from_trajectory(R, p, t, Q @ R_lidar, (p_lidar - 3.0) @ Q.T)
    x = np.concatenate([np.zeros(3), true.position])
    np.testing.assert_allclose(residual(system(true.rotation, true.position), x), 0.0, atol=1e-9)
    check_turn(system, true, x, 1e-9)


def check_turn(system, true, x, atol):
    """The columns of d against central differences of what rows lack."""
    A, h = system(true.rotation, true.position).A, 1e-5
    for k, e in enumerate(np.eye(3)):
        apart = [residual(system(true.rotation @ so3.exp(s * h * e), true.position), x) for s in (1.0, -1.0)]
        np.testing.assert_allclose(A[:, :, k], (apart[1] - apart[0]) / (2.0 * h), atol=atol)


def test_positions_against_the_readings(free_robot, path):
    t, _, _, R_lidar, p_lidar = path
    true, imu, sim = free_robot.truth(), free_robot.imu, free_robot.sim.truth
    gyro = GyroRotation.integrate(imu, sim.gyro_bias.mean(axis=0))
    system = system_from_readings(imu, lambda R: gyro.carry(t, R, imu.seconds), t, R_lidar, p_lidar)
    bias = sim.accel_bias.mean(axis=0)
    x = np.concatenate([np.zeros(3), true.position, [0.0, 0.0, -9.81], bias])
    left = residual(system(true.rotation, true.position), x)
    assert np.sqrt((left**2).mean()) < 2e-3  # m/s: white noise of 2e-3 m/s^2/sqrt(Hz) over 0.1 s is 7e-4
    # Columns take the LiDAR's rotation between scans as known; the gyroscope carries it there: 0.3 % apart.
    no_bias = np.concatenate([x[:9], np.zeros(3)])
    check_turn(system, true, no_bias, 0.01)


def test_integrals_of_a_line_are_exact(free_robot):
    imu = free_robot.imu
    x = np.column_stack([np.ones_like(imu.seconds), imu.seconds])
    once, twice = SignalIntegrals.of(imu, x).at(np.array([0.0, 1.2345, 7.7]))
    t = np.array([0.0, 1.2345, 7.7])
    np.testing.assert_allclose(once, np.column_stack([t, t**2 / 2]), atol=1e-10)
    np.testing.assert_allclose(twice, np.column_stack([t**2 / 2, t**3 / 6]), atol=1e-9)


def test_motion_between_noisy_positions(free_robot, path):
    """Smoothing takes most of 1 cm away, and gives velocities; a gap does not bend it."""
    t, R, p, _, _ = path
    sim, rng = free_robot.sim.truth, np.random.default_rng(3)
    gyro = GyroRotation.integrate(free_robot.imu, sim.gyro_bias.mean(axis=0))
    kept = (t < 6.0) | (t > 6.4)
    seen = p[kept] + 0.01 * rng.normal(size=p[kept].shape)
    bias = sim.accel_bias.mean(axis=0)
    rough = ImuTrajectory(gyro, t[kept], R[kept], seen, np.zeros_like(seen), sim.gyro_bias.mean(axis=0), bias, 9.81)
    at = np.linspace(1.0, 14.5, 400)
    _, p_found, v_found = rough.smoothed().at(at)
    _, p_true, v_true = free_robot.pose_at(at)
    assert np.sqrt(((p_found - p_true) ** 2).mean()) < 0.006
    assert np.sqrt(((v_found - v_true) ** 2).mean()) < 0.015


def test_rotations_that_follow_the_gyroscope(free_robot, path):
    """Nine of them within half a second take most of 1 deg away; none from beyond a gap, where another map stands."""
    t, R, _, _, _ = path
    rng, imu = np.random.default_rng(4), replace(free_robot.imu, gaps=((6.0, 6.1),))
    gyro = GyroRotation.integrate(imu, free_robot.sim.truth.gyro_bias.mean(axis=0))
    turn = Rotation.from_rotvec([0.5, -1.0, 2.0]).as_matrix()
    true = np.where((t > 6.05)[:, None, None], turn @ R, R)
    found = gyro.smoothed(t, true @ so3.exp_many(np.deg2rad(1.0) * rng.normal(size=(len(t), 3))))
    np.testing.assert_allclose(found @ found.transpose(0, 2, 1), np.tile(np.eye(3), (len(t), 1, 1)), atol=1e-12)
    off = np.rad2deg(so3.log_many(np.ascontiguousarray(true.transpose(0, 2, 1) @ found)))
    assert 0.8 < 3.0 * np.sqrt((off**2).mean()) < 1.2
    assert np.abs(off).max() < 1.5


def turns_between(free_robot, path, first, last):
    """Errors [rad] of the turns from scan to scan that `path` has of scans `first` to `last`, and how many of them are
    ok."""
    own, true = slice(first, last), free_robot.truth()
    R = free_robot.pose_at(path.seconds[own] + true.offset)[0] @ true.rotation
    found = path.rotation[own]
    apart = (R[:-1].transpose(0, 2, 1) @ R[1:]).transpose(0, 2, 1) @ found[:-1].transpose(0, 2, 1) @ found[1:]
    both = path.ok[own][:-1] & path.ok[own][1:]
    return np.linalg.norm(so3.log_many(np.ascontiguousarray(apart)), axis=1)[both], both.sum()


def test_a_path_that_lost_its_way_goes_on_in_another_map(free_robot):
    """Scans are missing, and the LiDAR stands elsewhere after them, turned by half a turn."""
    scans = sampled_scans(free_robot.streams[0])
    turned = [replace(s, xyz=s.xyz * [-1.0, -1.0, 1.0]) for s in scans]
    path = lidar_trajectory("lidar0", [*scans[:50], *turned[74:]], single_map=False)
    errors, n = turns_between(free_robot, path, 0, 50)
    assert n == 49 and errors.max() < 0.02
    half = np.diag([-1.0, -1.0, 1.0])
    after = replace(path, rotation=path.rotation @ half)
    errors, n = turns_between(free_robot, after, 50, len(path.seconds))
    assert n > 25 and errors.max() < 0.02
    known = path.seconds[path.ok]
    assert np.diff(known).max() > 1.0
    with pytest.raises(EstimationError, match="only 50 of 103 scans match"):
        lidar_trajectory("lidar0", [*scans[:50], *turned[74:]])


def test_a_long_path_is_followed_in_two_parts_at_once(free_robot, monkeypatch):
    """As good as in one, but for a second between the two maps."""
    scans = sampled_scans(free_robot.streams[0])
    one = lidar_trajectory("lidar0", scans, single_map=False)
    monkeypatch.setattr(odometry, "MIN_SCANS_FOR_TWO_MAPS", len(scans))
    two = lidar_trajectory("lidar0", scans, single_map=False)
    assert one.ok.all()
    n = len(scans) // 2
    np.testing.assert_array_equal(two.rotation[:n], one.rotation[:n])
    np.testing.assert_array_equal(two.rotation[n], np.eye(3))
    known = two.seconds[two.ok]
    assert 1.0 < np.diff(known).max() < 1.3 and (~two.ok).sum() < 10
    for own in (slice(0, n), slice(n, len(scans))):
        errors, met = turns_between(free_robot, two, own.start, own.stop)
        assert met > 50 and errors.max() < 0.02


def poses_in_first(path):
    """Rotations and positions of all scans seen from the first."""
    back = path.rotation[0].T
    return back @ path.rotation, (path.position - path.position[0]) @ back.T


def test_parts_of_a_path_that_is_to_be_whole_are_joined(free_robot, monkeypatch):
    scans = sampled_scans(free_robot.streams[0])
    one = lidar_trajectory("lidar0", scans)
    monkeypatch.setattr(odometry, "MIN_SCANS_FOR_TWO_MAPS", len(scans))
    joined = lidar_trajectory("lidar0", scans)
    assert joined.ok.all() and len(joined.seconds) == len(scans)
    n = len(scans) // 2 + odometry.OVERLAP_SCANS
    np.testing.assert_array_equal(joined.rotation[:n], one.rotation[:n])
    assert not np.array_equal(joined.rotation[n:], one.rotation[n:])  # of another map
    (R, p), (R_one, p_one) = poses_in_first(joined), poses_in_first(one)
    apart = so3.log_many(np.ascontiguousarray(R_one.transpose(0, 2, 1) @ R))
    assert np.linalg.norm(apart, axis=1).max() < np.deg2rad(0.5)
    assert np.linalg.norm(p - p_one, axis=1).max() < 0.03


@pytest.mark.parametrize("many", [1, 10**6])
def test_parts_that_share_too_little_are_not_joined(free_robot, monkeypatch, many: int):
    """The scans that both would share are of elsewhere, where the first map ends: the second is worth nothing."""
    scans = sampled_scans(free_robot.streams[0])
    middle = len(scans) // 2
    away = slice(middle, middle + odometry.OVERLAP_SCANS)
    scans[away] = [replace(s, xyz=s.xyz * [-1.0, -1.0, 1.0] + [3.0, 0.0, 1.0]) for s in scans[away]]
    monkeypatch.setattr(odometry, "MIN_SCANS_FOR_TWO_MAPS", many)
    with pytest.raises(EstimationError, match=f"only {middle} of {len(scans)} scans match"):
        lidar_trajectory("lidar0", scans)


def test_a_path_begins_later_where_its_first_map_leads_nowhere(free_robot):
    """The first scans are of elsewhere: half a turn away, and 3 m."""
    scans = sampled_scans(free_robot.streams[0])
    odd = [replace(s, xyz=s.xyz * [-1.0, -1.0, 1.0] + [3.0, 0.0, 1.0]) for s in scans[:3]]
    path = lidar_trajectory("lidar0", [*odd, *scans[3:]])
    assert not path.ok[:3].any() and path.ok[8:].mean() > 0.95
    errors, n = turns_between(free_robot, path, 8, len(path.seconds))
    assert n > 60 and errors.max() < 0.02


def expected_rows(e: PosePrediction, pose: ScanPose) -> np.ndarray:
    """(12,) whitened: how a pose departs from what the scan before says of it, written out."""
    b, h = e.before, e.step
    turned = b.rotation.T @ pose.rotation
    way = b.rotation @ e.translation if e.knows_translation else b.velocity * h
    log = Rotation.from_matrix(e.rotation.T @ turned if e.knows_rotation else turned).as_rotvec()
    moved = pose.position - b.position
    mean_rate, mean_velocity = 0.5 * (b.rate + pose.rate), 0.5 * (b.velocity + pose.velocity)
    return POINT_SIGMA_M * np.concatenate(
        [
            log / GYRO_ROTATION_SIGMA if e.knows_rotation else (log - h * mean_rate) / STEP_ROTATION_SIGMA,
            (moved - way) / KNOWN_TRANSLATION_SIGMA
            if e.knows_translation
            else (moved - h * mean_velocity) / STEP_POSITION_SIGMA,
            pose.rate / GYRO_RATE_SIGMA
            if e.knows_rotation
            else (pose.rate - b.rate) / (ANGULAR_ACCELERATION_SIGMA * h),
            (pose.velocity - (way / h if e.knows_translation else b.velocity)) / (ACCELERATION_SIGMA * h),
        ]
    )


@each("knows_way", [False, True])
@each("knows_turn", [False, True])
def test_what_is_expected_of_a_pose_is_in_the_normal_equations(knows_turn: bool, knows_way: bool):
    rng = np.random.default_rng(3)
    slow = np.array([1.0, 0.01, 1.0])[:, None]  # turns little: the slope of the logarithm is taken for one
    before = ScanPose(random_rotations(None, seed=1).as_matrix(), *slow * rng.normal(size=(3, 3)))
    turned, way = Rotation.from_rotvec([0.03, -0.02, 0.05]).as_matrix(), rng.normal(scale=0.1, size=3)
    e = PosePrediction.of(before, 0.1, turned if knows_turn else None, way if knows_way else None)
    predicted = predicted_pose(e)
    np.testing.assert_allclose(expected_rows(e, predicted)[:3], 0.0, atol=1e-9)
    np.testing.assert_allclose(expected_rows(e, predicted)[9:], 0.0, atol=1e-9)
    pose = corrected_pose(predicted, np.array([1e-5, 2e-5, -1e-5, *rng.normal(scale=0.1, size=9)]))
    H, g, h = np.zeros((12, 12)), np.zeros(12), 1e-6
    add_prediction(e, pose, H, g)
    J = np.array(
        [
            (expected_rows(e, corrected_pose(pose, h * d)) - expected_rows(e, corrected_pose(pose, -h * d))) / (2 * h)
            for d in np.eye(12)
        ]
    )
    J, r = J.T, expected_rows(e, pose)
    scale = np.sqrt(np.diag(J.T @ J))
    np.testing.assert_allclose(H / np.outer(scale, scale), J.T @ J / np.outer(scale, scale), atol=2e-3)
    np.testing.assert_allclose(g, J.T @ r, rtol=2e-3, atol=1e-3)
