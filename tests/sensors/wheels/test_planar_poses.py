"""Planar poses integrated from the wheels, and the factor of paper (27)-(28) on them."""

from dataclasses import replace

import numpy as np
import pytest

from icalib.motion.imu_data import StampIntervals
from icalib.optim.arrowhead import make_pieces
from icalib.sensors.wheels.ground_factor import RelativePoses, preintegrated
from icalib.sensors.wheels.residual import RelativePoseFactor, WheelNoise, drive_of, wheel_intervals

RNG = np.random.default_rng(3)
SECONDS = np.cumsum(RNG.uniform(0.01, 0.02, 60))
DRIVE = np.array([0.1, 0.12, 0.5])
INTERVALS = StampIntervals(np.array([0, 10, 20, 30]), np.array([1, 20, 40, 59]), np.array([0, 1, 2, 3]))


def steps(kind):
    """(60, 2) rad that the wheels turned: about 3 m/s; straight, or turning at up to 4 rad/s."""
    dt = np.diff(SECONDS, prepend=SECONDS[0] - 0.01)[:, None]
    rates = 30.0 + (0.0 if kind == "straight" else 10.0) * RNG.normal(size=(60, 2))
    if kind == "straight":
        rates = np.broadcast_to(30.0 / np.array([DRIVE[0], DRIVE[1]]) * 0.1, (60, 2))
    return np.cumsum(rates * dt, axis=0)


def by_small_steps(angles, first, last, drive=DRIVE, slip=None):
    """Euler's midpoint rule in 400 parts of every step."""
    yaw = x = y = 0.0
    for n in range(first, last):
        d_l, d_r = (angles[n + 1] - angles[n]) / 400
        side = 0.0 if slip is None else slip[n] / 400
        for _ in range(400):
            turn, path = (drive[1] * d_r - drive[0] * d_l) / drive[2], 0.5 * (drive[1] * d_r + drive[0] * d_l)
            c, s = np.cos(yaw + 0.5 * turn), np.sin(yaw + 0.5 * turn)
            x, y, yaw = x + path * c - side * s, y + path * s + side * c, yaw + turn
    return np.array([yaw, x, y])


@pytest.mark.parametrize("kind", ["straight", "turning"])
def test_poses_are_those_of_small_steps(kind):
    angles = steps(kind)
    made = preintegrated(SECONDS, angles, INTERVALS, DRIVE, 0.02, 5e-3)
    for i in range(4):
        want = by_small_steps(angles, INTERVALS.first[i], INTERVALS.last[i])
        np.testing.assert_allclose(made.z[i], want, rtol=0, atol=1e-7)
    if kind == "straight":
        assert np.abs(made.z[:, 0]).max() < 1e-14 < made.z[:, 1].min()


@pytest.mark.parametrize("kind", ["straight", "turning"])
def test_derivatives_by_radii_and_baseline_are_central_differences(kind):
    angles, h = steps(kind), 1e-6
    made = preintegrated(SECONDS, angles, INTERVALS, DRIVE, 0.02, 5e-3)
    for k in range(3):
        up, down = (
            preintegrated(SECONDS, angles, INTERVALS, DRIVE + s * h * np.eye(3)[k], 0.02, 5e-3).z for s in (1, -1)
        )
        np.testing.assert_allclose(
            made.J_drive[:, :, k], (up - down) / (2 * h), rtol=0, atol=2e-8 * np.abs(made.J_drive).max()
        )


def test_covariance_is_that_of_samples():
    """Every step with its own noise of either wheel and of lateral slip; 4000 samples."""
    wheel, slip, n = 0.05, 8e-3, 4000
    angles, dt, rng = steps("turning"), np.diff(SECONDS), np.random.default_rng(8)
    one = StampIntervals(np.array([20]), np.array([40]), np.array([0]))
    made = preintegrated(SECONDS, angles, one, DRIVE, wheel, slip)
    first, last, r = 20, 40, DRIVE[:2]
    errors = np.zeros((n, 3))
    turned = np.diff(angles, axis=0)[first:last] + wheel * np.sqrt(dt[first:last, None]) * rng.normal(size=(n, 20, 2))
    aside = slip * np.sqrt(dt[first:last]) * rng.normal(size=(n, 20))
    yaw = np.zeros(n)
    for k in range(last - first):
        turn, path = turned[:, k] @ [-r[0], r[1]] / DRIVE[2], 0.5 * turned[:, k] @ r
        c, s = np.cos(yaw + 0.5 * turn), np.sin(yaw + 0.5 * turn)
        length = path * np.sinc(0.5 * turn / np.pi)
        errors[:, 1] += length * c - aside[:, k] * s
        errors[:, 2] += length * s + aside[:, k] * c
        yaw += turn
    errors[:, 0] = yaw
    white = (errors - made.z[0]) @ made.W[0].T
    assert np.linalg.norm(white.mean(0)) < 0.08
    np.testing.assert_allclose(np.cov(white.T), np.eye(3), rtol=0, atol=0.08)


def factor_on(world):
    return RelativePoseFactor.build(
        "wheel0", world.seconds, world.angles, world.motion(), WheelNoise(0.01), world.layout
    )


def residuals(factor, state):
    """(n, 3) rad, m, m."""
    out = factor.output()
    for piece in make_pieces(len(state.seconds), factor.layout.size):
        factor.accumulate(state, piece, out, sums=False)
    return np.linalg.solve(factor.poses.W, out.residual[:, :, None])[:, :, 0]


def test_residuals_vanish_on_planar_motion(drive_of_kind, world_of):
    world = world_of(drive_of_kind("planar", 1), wheel_hz=200.0)
    r = residuals(factor_on(world), world.state)
    assert len(r) > 70
    assert np.abs(r[:, 0]).max() < 5e-8 and np.abs(r[:, 1:]).max() < 1e-7


def test_given_poses_of_the_wheels_frame_leave_no_residual(drive_of_kind, world_of):
    drive = drive_of_kind("planar", 1)
    world = world_of(drive)
    t = world.seconds + 0.0123
    chosen = wheel_intervals("wheel0", world.seconds, world.imu, world.state)
    yaw, xy = drive.yaw(t), drive.integral(drive.travel, t)[:, :2]
    a, b = chosen.first, chosen.last
    c, s, (x, y) = np.cos(yaw[a]), np.sin(yaw[a]), (xy[b] - xy[a]).T
    z = np.column_stack([yaw[b] - yaw[a], c * x + s * y, c * y - s * x])
    made = RelativePoses(z, np.zeros((len(z), 3, 3)), np.tile(100.0 * np.eye(3), (len(z), 1, 1)), np.zeros(3))
    assert np.abs(residuals(replace(factor_on(world), poses=made), world.state)).max() < 1e-7


def test_signs_of_the_rows(drive_of_kind, world_of):
    """A wheel that turned further: on the right yaw was measured too large, residuals are predicted - measured."""
    world = world_of(drive_of_kind("planar", 1))
    angles = world.angles.copy()
    angles[100:, 1] += 0.01
    r = residuals(factor_on(replace(world, angles=angles)), world.state)
    i = np.argmax(np.abs(r[:, 0]))
    assert r[i, 0] == pytest.approx(-0.01 * 0.11 / 0.5, rel=1e-4)
    assert r[i, 1] == pytest.approx(-0.5 * 0.01 * 0.11, rel=0.05)


def test_the_measured_pose_follows_radii_and_baseline_to_first_order(drive_of_kind, world_of):
    world = world_of(drive_of_kind("planar", 1))
    factor = factor_on(world)
    d = np.array([1e-4, -1e-4, 5e-4])
    moved = world.moved(radii=d[:2], baseline=d[2:])
    anew = preintegrated(world.seconds, world.angles, factor.intervals, drive_of("wheel0", moved), 0.01, 5e-3)
    change = residuals(factor, moved) - residuals(factor, world.state)
    exact = factor.poses.z - anew.z
    assert np.abs(exact).max() > 5e-5
    np.testing.assert_allclose(change, exact, rtol=0, atol=2e-3 * np.abs(exact).max())
