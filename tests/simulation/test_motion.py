"""The simulated motion against numerical derivatives and a Runge-Kutta integration."""

from dataclasses import replace

import numpy as np
import pytest
from tests.typed import not_none

from icalib.tools.simulation import handheld, simulate

GRAVITY = np.array([0.0, 0.0, -9.81])
KINDS = ("handheld", "planar", "single_axis", "motionless")


def scenario_of(kind, exact, duration_s=3.0, **changes):
    scenario = handheld(duration_s=duration_s, exact=exact, noiseless=True)
    motion = replace(scenario.motion, kind=kind)
    return replace(scenario, motion=motion, gyro_bias=(0.0,) * 3, accel_bias=(0.0,) * 3, **changes)


def cross_matrix(w):
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def runge_kutta(state, reading, dt, steps):
    """Integrate R' = R [w]x, p' = v, v' = R f + g with constant w and f."""
    W, f = cross_matrix(reading[:3]), reading[3:]
    h = dt / steps

    def slope(R, p, v):
        return R @ W, v, R @ f + GRAVITY

    for _ in range(steps):
        k1 = slope(*state)
        k2 = slope(*(s + 0.5 * h * k for s, k in zip(state, k1, strict=True)))
        k3 = slope(*(s + 0.5 * h * k for s, k in zip(state, k2, strict=True)))
        k4 = slope(*(s + h * k for s, k in zip(state, k3, strict=True)))
        state = tuple(
            s + h / 6.0 * (a + 2.0 * b + 2.0 * c + d) for s, a, b, c, d in zip(state, k1, k2, k3, k4, strict=True)
        )
    return state


@pytest.mark.parametrize("kind", KINDS)
def test_readings_are_derivatives_of_the_closed_form_pose(kind):
    sim = simulate(scenario_of(kind, exact=False), seed=1)
    t, h = sim.truth.seconds[::50], 1e-4
    R, _, v = sim.truth.pose_at(t)
    (R0, p0, v0), (R1, p1, v1) = sim.truth.pose_at(t - h), sim.truth.pose_at(t + h)
    spin = np.einsum("nji,njk->nik", R, (R1 - R0) / (2.0 * h))
    rate = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    force = np.einsum("nji,nj->ni", R, (v1 - v0) / (2.0 * h) - GRAVITY)
    np.testing.assert_allclose((p1 - p0) / (2.0 * h), v, atol=1e-6)
    np.testing.assert_allclose(not_none(sim.measurements.imu).gyro[::50], rate, atol=1e-5)
    np.testing.assert_allclose(not_none(sim.measurements.imu).accel[::50], force, atol=1e-5)


@pytest.mark.parametrize("jitter_s", [0.0, 1.5e-3])
def test_exact_trajectory_is_the_integral_of_mean_readings(jitter_s):
    sim = simulate(scenario_of("handheld", exact=True, duration_s=1.5, imu_jitter_s=jitter_s), seed=2)
    truth, imu = sim.truth, sim.measurements.imu
    readings = np.concatenate([not_none(imu).gyro, not_none(imu).accel], axis=1)
    state = (truth.R_world_imu[0], truth.position[0], truth.velocity[0])
    for i in range(len(readings) - 1):
        dt = (not_none(imu).stamps_ns[i + 1] - not_none(imu).stamps_ns[i]) * 1e-9
        mean = 0.5 * (readings[i] + readings[i + 1])
        halfway = truth.pose_at(np.array([truth.seconds[i] + 0.37 * dt]))
        for found, expected in zip(halfway, runge_kutta(state, mean, 0.37 * dt, 2), strict=True):
            np.testing.assert_allclose(found[0], expected, atol=1e-10)
        state = runge_kutta(state, mean, dt, 4)
    for found, expected in zip((truth.R_world_imu, truth.position, truth.velocity), state, strict=True):
        np.testing.assert_allclose(found[-1], expected, atol=1e-10)


def test_exact_motion_stays_by_its_reference_and_is_rich():
    exact = simulate(scenario_of("handheld", exact=True, duration_s=30.0), seed=3)
    closed = simulate(scenario_of("handheld", exact=False, duration_s=30.0), seed=3)
    assert np.abs(exact.truth.position - closed.truth.position).max() < 1e-3
    assert np.abs(exact.truth.R_world_imu - closed.truth.R_world_imu).max() < 1e-3
    assert (not_none(exact.measurements.imu).gyro.std(axis=0) > 0.4).all()
    assert (not_none(exact.measurements.imu).accel.std(axis=0) > 1.0).all()
    for camera in exact.measurements.cameras:
        assert len(camera.stamps_ns) > 590
        assert len(camera.uv) > 80 * len(camera.stamps_ns)
    R = exact.truth.R_world_imu
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-13)


@pytest.mark.parametrize("exact", [True, False])
def test_degenerate_motions_are_degenerate(exact):
    planar = simulate(scenario_of("planar", exact), seed=4).truth
    turns = planar.R_world_imu @ planar.R_world_imu[0].T
    np.testing.assert_allclose(turns[:, 2, :], np.broadcast_to([0.0, 0.0, 1.0], (len(turns), 3)), atol=1e-9)
    assert np.ptp(planar.position[:, 2]) < 1e-9 < 0.05 < np.ptp(planar.position[:, 0])
    assert turns[:, 0, 0].min() < 0.99

    single = simulate(scenario_of("single_axis", exact), seed=4)
    axis = np.array(single.scenario.motion.axis_imu)
    np.testing.assert_allclose(np.cross(not_none(single.measurements.imu).gyro, axis), 0.0, atol=1e-4)
    assert np.ptp(single.truth.position, axis=0).min() > 0.05

    still = simulate(scenario_of("motionless", exact), seed=4)
    np.testing.assert_allclose(still.truth.position, still.truth.position[:1] + np.zeros((601, 1)), atol=1e-9)
    np.testing.assert_allclose(not_none(still.measurements.imu).gyro, 0.0, atol=1e-12)
    np.testing.assert_allclose(
        still.truth.R_world_imu[0] @ not_none(still.measurements.imu).accel[0], -GRAVITY, atol=1e-12
    )


def test_scales_and_motion_seed():
    base = scenario_of("handheld", exact=False)
    slow = replace(base, motion=replace(base.motion, rotation_scale=0.2, translation_scale=0.5, seed=7))
    fast = replace(base, motion=replace(base.motion, seed=7))
    a, b = simulate(slow, seed=1), simulate(fast, seed=2)
    ratio = np.ptp(a.truth.position, axis=0) / np.ptp(b.truth.position, axis=0)
    np.testing.assert_allclose(ratio, 0.5, rtol=1e-9)
    assert not_none(a.measurements.imu).gyro.std() < 0.25 * not_none(b.measurements.imu).gyro.std()
    np.testing.assert_array_equal(simulate(fast, seed=3).truth.position, b.truth.position)
