"""Wheel rates against the path of the wheel frame; relative poses against (27) and their covariance against samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.data.measurements import WheelPoses, WheelStream
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import simulate

from .conftest import alone, on_ground, wheel_path


def instants(sim):
    stream, truth = sim.measurements.wheels[0], sim.truth
    return (stream.stamps_ns - truth.imu_clock_origin_ns) * 1e-9 + truth.time_offset[stream.name]


def turned(sim, begin, end, parts=2000):
    """(2,) angles that the wheels turn, by summing up the small moves of the wheel frame."""
    w = sim.scenario.of(SimWheels)[0]
    R, p = wheel_path(sim.truth, w.T_imu_sensor, np.linspace(begin, end, parts + 1))
    middle, _ = wheel_path(
        sim.truth, w.T_imu_sensor, np.linspace(begin, end, parts + 1)[:-1] + 0.5 * (end - begin) / parts
    )
    ahead = np.einsum("ni,ni->n", middle[:, :, 0], np.diff(p, axis=0)).sum()
    small = np.einsum("nji,njk->nik", R[:-1], R[1:])
    yaw = 0.5 * (small[:, 1, 0] - small[:, 0, 1]).sum()
    return np.array([ahead - 0.5 * w.baseline * yaw, ahead + 0.5 * w.baseline * yaw]) / w.radii


@each("kind", ["planar", "ramps", "spin"])
def test_mean_rates_are_the_angles_turned_since_the_stamp_before(robot, kind):
    scenario = replace(alone(on_ground(robot, kind)), robot_noise_enabled=False)
    sim = simulate(scenario, 6)
    stream, t = sim.measurements.wheels[0], instants(sim)
    np.testing.assert_allclose(sim.truth.reported["wheel0"].seconds, t, atol=1e-9)
    for i in (1, 50, 200):
        expected = turned(sim, t[i - 1], t[i], 200) / (t[i] - t[i - 1])
        np.testing.assert_allclose(instance(stream, WheelStream).rate[i], expected, rtol=1e-5, atol=1e-6)
    angle = (instance(stream, WheelStream).rate[1:] * np.diff(t)[:, None]).sum(axis=0)
    np.testing.assert_allclose(angle, turned(sim, t[0], t[-1]), rtol=1e-6, atol=1e-6)


def test_instant_rates_are_those_at_the_stamp(robot):
    scenario = replace(alone(on_ground(robot, "planar")), robot_noise_enabled=False)
    instant = scenario.with_sensors(replace(scenario.of(SimWheels)[0], sampling="instantaneous"))
    sim, mean = simulate(instant, 6), simulate(scenario, 6)
    stream, t = sim.measurements.wheels[0], instants(sim)
    assert (
        instance(stream, WheelStream).sampling == "instantaneous"
        and instance(mean.measurements.wheels[0], WheelStream).sampling == "interval-mean"
    )
    np.testing.assert_array_equal(stream.stamps_ns, mean.measurements.wheels[0].stamps_ns)
    for i in (0, 50, 200):
        np.testing.assert_allclose(
            instance(stream, WheelStream).rate[i], turned(sim, t[i] - 1e-4, t[i] + 1e-4, 2) / 2e-4, atol=1e-5
        )
    assert (
        np.abs(instance(stream, WheelStream).rate - instance(mean.measurements.wheels[0], WheelStream).rate).max()
        > 1e-3
    )


def test_the_path_is_found_again_from_the_rates(robot):
    """Dead reckoning over a flat floor: what encoders are there for."""
    scenario = replace(alone(on_ground(robot, "planar")), robot_noise_enabled=False, duration_s=10.0)
    sim = simulate(scenario, 7)
    w, stream, t = scenario.of(SimWheels)[0], sim.measurements.wheels[0], instants(sim)
    R, p = wheel_path(sim.truth, w.T_imu_sensor, t)
    x, y, heading = *p[0, :2], np.arctan2(R[0, 1, 0], R[0, 0, 0])
    for (left, right), dt in zip(instance(stream, WheelStream).rate[1:], np.diff(t), strict=True):
        ahead = 0.5 * dt * (left * w.radii[0] + right * w.radii[1])
        yaw = dt * (right * w.radii[1] - left * w.radii[0]) / w.baseline
        x, y = x + ahead * np.cos(heading + 0.5 * yaw), y + ahead * np.sin(heading + 0.5 * yaw)
        heading += yaw
    np.testing.assert_allclose([x, y], p[-1, :2], atol=1e-4)
    np.testing.assert_allclose(np.tan(heading), R[-1, 1, 0] / R[-1, 0, 0], atol=1e-6)


def test_noise_of_rates_has_the_density_stated(robot):
    scenario = replace(alone(on_ground(robot, "standing")), duration_s=60.0)
    rate = instance(simulate(scenario, 8).measurements.wheels[0], WheelStream).rate
    # 8400 numbers: their standard deviation is known to 0.8 %, four of which are allowed.
    assert rate.std() == pytest.approx(0.03 * np.sqrt(70.0), rel=0.032)
    assert abs((rate[1:] * rate[:-1]).mean()) < 4.0 * rate.var() / np.sqrt(rate.size)


@pytest.mark.parametrize("kind", ["free", "planar"])
def test_relative_poses_are_those_of_27(robot, kind):
    scenario = replace(alone(robot), motion=replace(robot.motion, kind=kind), robot_noise_enabled=False)
    sim = simulate(scenario, 9)
    stream, t = sim.measurements.wheels[0], instants(sim)
    assert len(t) == len(instance(stream, WheelPoses).pose) + 1 and np.allclose(np.diff(t), 3.0 / 70.0, atol=2e-9)
    T = scenario.of(SimWheels)[0].T_imu_sensor
    R_W_I, p_W_I = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    p_I_W = T[:3, 3]
    R, p, _ = sim.truth.pose_at(t)
    for k in range(0, len(instance(stream, WheelPoses).pose), 7):
        turn = R_W_I @ R[k].T @ R[k + 1] @ R_W_I.T
        angle = np.arccos(0.5 * (np.trace(turn) - 1.0))
        yaw = (turn[1, 0] - turn[0, 1]) * angle / (2.0 * np.sin(angle))
        xyz = R_W_I @ R[k].T @ (p[k + 1] + R[k + 1] @ p_I_W - p[k]) + p_W_I
        np.testing.assert_allclose(instance(stream, WheelPoses).pose[k], [yaw, *xyz[:2]], atol=1e-8)
    if kind == "planar":  # a wheel that goes ahead and to the left
        assert (instance(stream, WheelPoses).pose[:, 1] > 0.0).all()
        np.testing.assert_allclose(
            instance(stream, WheelPoses).pose[:, 2],
            0.5 * instance(stream, WheelPoses).pose[:, 0] * instance(stream, WheelPoses).pose[:, 1],
            atol=1e-4,
        )


def test_covariance_of_relative_poses_is_that_of_integrated_noise(robot):
    """10 000 dead reckonings with noisy rates along one curve, against the covariance stated for it."""
    wheels = replace(robot.of(SimWheels)[0], reports="poses", poses_every=35, slip=0.004)
    scenario = replace(alone(robot), motion=replace(robot.motion, kind="planar"), sensors=(wheels,))
    sim = simulate(scenario, 11)
    stream, t = sim.measurements.wheels[0], instants(sim)
    k, parts, runs = 2, 200, 10_000
    dt = (t[k + 1] - t[k]) / parts
    middle = t[k] + dt * (np.arange(parts) + 0.5)
    R, p = wheel_path(sim.truth, wheels.T_imu_sensor, np.concatenate([middle - 0.5 * dt, middle[-1:] + 0.5 * dt]))
    speed = np.linalg.norm(np.diff(p, axis=0), axis=1) / dt
    heading = np.unwrap(np.arctan2(R[:, 1, 0], R[:, 0, 0]))
    yaw_rate = np.diff(heading) / dt
    rng = np.random.default_rng(0)
    noise = wheels.noise / np.sqrt(dt) * rng.standard_normal((2, runs, parts)) * np.array(wheels.radii)[:, None, None]
    v, w = speed + noise.mean(axis=0), yaw_rate + (noise[1] - noise[0]) / wheels.baseline
    side = wheels.slip / np.sqrt(dt) * rng.standard_normal((runs, parts))
    angle = np.cumsum(w, axis=1) * dt
    mid = angle - 0.5 * w * dt
    x = np.sum(v * np.cos(mid) - side * np.sin(mid), axis=1) * dt
    y = np.sum(v * np.sin(mid) + side * np.cos(mid), axis=1) * dt
    samples = np.stack([angle[:, -1], x, y])
    stated, found = instance(stream, WheelPoses).covariance[k], np.cov(samples)
    size = np.sqrt(np.diag(stated))
    # Each entry of a correlation from 10 000 samples is known to 0.014; four of these.
    np.testing.assert_allclose(found / np.outer(size, size), stated / np.outer(size, size), atol=0.06)
    assert abs(stated[0, 2]) > 0.2 * size[0] * size[2]  # turning early moves the end sideways


def test_noise_of_relative_poses_has_their_covariance(robot):
    scenario = replace(alone(robot), duration_s=60.0)
    stream = simulate(scenario, 12).measurements.wheels[0]
    error = instance(stream, WheelPoses).pose - simulate(scenario, 12).truth.reported["wheel0"].value
    whitened = np.linalg.solve(np.linalg.cholesky(instance(stream, WheelPoses).covariance), error[..., None])[..., 0]
    n = len(whitened)
    np.testing.assert_allclose(whitened.T @ whitened / n, np.eye(3), atol=4.0 * np.sqrt(2.0 / n))


@pytest.mark.parametrize("reports", ["rates", "poses"])
def test_readings_do_not_depend_on_how_many_are_made_at_a_time(robot, reports, monkeypatch):
    scenario = alone(robot) if reports == "poses" else alone(on_ground(robot, "planar"))
    scenario = replace(scenario, robot_noise_enabled=False)
    assert scenario.of(SimWheels)[0].reports == reports
    whole = simulate(scenario, 9).measurements.wheels[0]
    monkeypatch.setattr("icalib.sensors.wheels.simulate._CHUNK", 177)
    parts = simulate(scenario, 9).measurements.wheels[0]
    same = "rate" if reports == "rates" else "pose"
    np.testing.assert_array_equal(getattr(parts, same), getattr(whole, same))
