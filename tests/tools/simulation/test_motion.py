"""The simulated motion against numerical derivatives, and the sampling of the IMU against fine sums."""

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each
from tests.typed import not_none

from icalib.tools.simulation import handheld, simulate
from icalib.tools.simulation.motion import Reference, ideal_readings

GRAVITY = np.array([0.0, 0.0, -9.81])
KINDS = ("handheld", "planar", "single_axis", "motionless")


def scenario_of(kind, duration_s=3.0, **changes):
    scenario = handheld(duration_s=duration_s, noiseless=True)
    motion = replace(scenario.motion, kind=kind)
    changes = {"imu_rate_hz": 200.0} | changes
    return replace(scenario, motion=motion, gyro_bias=(0.0,) * 3, accel_bias=(0.0,) * 3, **changes)


@each("kind", KINDS)
def test_readings_are_derivatives_of_the_closed_form_pose(kind):
    sim = simulate(scenario_of(kind), seed=1)
    t, h = sim.truth.seconds[::50], 1e-4
    R, _, v = sim.truth.pose_at(t)
    (R0, p0, v0), (R1, p1, v1) = sim.truth.pose_at(t - h), sim.truth.pose_at(t + h)
    spin = np.einsum("nji,njk->nik", R, (R1 - R0) / (2.0 * h))
    rate = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    force = np.einsum("nji,nj->ni", R, (v1 - v0) / (2.0 * h) - GRAVITY)
    np.testing.assert_allclose((p1 - p0) / (2.0 * h), v, atol=1e-6)
    np.testing.assert_allclose(not_none(sim.measurements.imu).gyro[::50], rate, atol=1e-5)
    np.testing.assert_allclose(not_none(sim.measurements.imu).accel[::50], force, atol=1e-5)


def readings(imu):
    return np.concatenate([imu.gyro, imu.accel], axis=1)


@pytest.mark.parametrize("jitter_s", [0.0, 1.5e-3])
def test_an_interval_mean_is_that_of_the_time_since_the_reading_before(jitter_s):
    scenario = scenario_of("handheld", 1.5, imu_rate_hz=50.0, imu_jitter_s=jitter_s)
    sim = simulate(replace(scenario, imu_sampling="interval-mean"), seed=2)
    t = sim.truth.seconds
    fine = (np.arange(2000) + 0.5) / 2000
    for i in (1, 20, 60):
        samples = sim.truth.trajectory.readings_at(t[i - 1] + (t[i] - t[i - 1]) * fine)
        np.testing.assert_allclose(readings(not_none(sim.measurements.imu))[i], samples.mean(axis=0), atol=1e-6)


@pytest.mark.parametrize(("frequency", "left"), [(2.0, np.exp(-np.log(2.0) / 2.0 * 0.04**2)), (50.0, np.sqrt(0.5))])
def test_a_low_pass_has_no_delay_and_half_power_at_half_the_rate(frequency, left):
    class Wave(Reference):
        def __init__(self):
            pass

        def readings_at(self, seconds):
            return np.sin(2.0 * np.pi * frequency * seconds + 0.4)[:, None] * np.ones(6)

    scenario = replace(scenario_of("handheld", 1.0), imu_rate_hz=100.0, imu_sampling="low-pass")
    t = np.arange(100) / 100.0
    np.testing.assert_allclose(ideal_readings(scenario, Wave(), t), left * Wave().readings_at(t), atol=1e-6)


def test_handheld_motion_is_rich():
    sim = simulate(scenario_of("handheld", duration_s=30.0), seed=3)
    assert (not_none(sim.measurements.imu).gyro.std(axis=0) > 0.4).all()
    assert (not_none(sim.measurements.imu).accel.std(axis=0) > 1.0).all()
    for camera in sim.measurements.cameras:
        assert len(camera.stamps_ns) > 590
        assert len(camera.uv) > 80 * len(camera.stamps_ns)
    R = sim.truth.R_world_imu
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-13)


def test_degenerate_motions_are_degenerate():
    planar = simulate(scenario_of("planar"), seed=4).truth
    turns = planar.R_world_imu @ planar.R_world_imu[0].T
    np.testing.assert_allclose(turns[:, 2, :], np.broadcast_to([0.0, 0.0, 1.0], (len(turns), 3)), atol=1e-9)
    assert np.ptp(planar.position[:, 2]) < 1e-9 < 0.05 < np.ptp(planar.position[:, 0])
    assert turns[:, 0, 0].min() < 0.99

    single = simulate(scenario_of("single_axis"), seed=4)
    axis = np.array(single.scenario.motion.axis_imu)
    np.testing.assert_allclose(np.cross(not_none(single.measurements.imu).gyro, axis), 0.0, atol=1e-4)
    assert np.ptp(single.truth.position, axis=0).min() > 0.05

    still = simulate(scenario_of("motionless"), seed=4)
    np.testing.assert_allclose(still.truth.position, still.truth.position[:1] + np.zeros((601, 1)), atol=1e-9)
    np.testing.assert_allclose(not_none(still.measurements.imu).gyro, 0.0, atol=1e-12)
    np.testing.assert_allclose(
        still.truth.R_world_imu[0] @ not_none(still.measurements.imu).accel[0], -GRAVITY, atol=1e-12
    )


def test_scales_and_motion_seed():
    base = scenario_of("handheld")
    slow = replace(base, motion=replace(base.motion, rotation_scale=0.2, translation_scale=0.5, seed=7))
    fast = replace(base, motion=replace(base.motion, seed=7))
    a, b = simulate(slow, seed=1), simulate(fast, seed=2)
    ratio = np.ptp(a.truth.position, axis=0) / np.ptp(b.truth.position, axis=0)
    np.testing.assert_allclose(ratio, 0.5, rtol=1e-9)
    assert not_none(a.measurements.imu).gyro.std() < 0.25 * not_none(b.measurements.imu).gyro.std()
    np.testing.assert_array_equal(simulate(fast, seed=3).truth.position, b.truth.position)
