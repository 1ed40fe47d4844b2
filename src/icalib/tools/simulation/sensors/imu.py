"""Simulated IMU readings: sensor model, bias random walk, white noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.tools.simulation.scenario.scenario import Interval, Scenario
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory
from icalib.tools.simulation.sensors.motion import skew

_QUADRATURE_NODES = 6  # a motion below the Nyquist frequency is averaged to rounding
_LOWER = ((0, 1, 1, 2, 2, 2), (0, 0, 1, 0, 1, 2))  # row and column indices of xx, yx, yy, zx, zy, zz


@dataclass(frozen=True, eq=False)
class ImuReadings:
    """Measured gyro [rad/s] and accel [m/s^2], and the true biases that they contain, all (N, 3)."""

    gyro: np.ndarray
    accel: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray


def inside(intervals: tuple[Interval, ...], seconds: np.ndarray) -> np.ndarray:
    """(N,) bool: whether each instant in seconds (N,) is in one of the intervals, ends included."""
    hit = np.zeros(len(seconds), dtype=bool)
    for start, end in intervals:
        hit |= (seconds >= start) & (seconds <= end)
    return hit


def imu_stamps(scenario: Scenario, rng: np.random.Generator) -> np.ndarray:
    """Stamps (N,) int64 [ns] of the readings since the IMU clock's origin; the first is 0."""
    count = round(scenario.duration_s * scenario.imu_rate_hz) + 1
    seconds = np.arange(count) / scenario.imu_rate_hz
    seconds[1:] += rng.uniform(-scenario.imu_jitter_s, scenario.imu_jitter_s, count - 1)
    return np.round(seconds * 1e9).astype(np.int64)


def ideal_readings(scenario: Scenario, trajectory: TrueTrajectory, seconds: np.ndarray) -> np.ndarray:
    """(N, 6) readings without errors at seconds (N,): angular rates [rad/s] and specific forces [m/s^2], sampled as
    `Scenario.imu_sampling` says.

    Means are those over the time since the reading before; the first one's over a period. The low-pass filter is
    Gaussian and has no delay. Its amplitude is 1/sqrt(2) at half the rate.
    """
    period = 1.0 / scenario.imu_rate_hz
    if scenario.imu_sampling == "instantaneous":
        return trajectory.readings_at(seconds)
    if scenario.imu_sampling == "interval-mean":
        steps = np.diff(seconds, prepend=seconds[0] - period)
        nodes, weights = np.polynomial.legendre.leggauss(_QUADRATURE_NODES)
        shifts = [0.5 * steps * (node - 1.0) for node in nodes]
    else:
        sigma_s = np.sqrt(np.log(2.0)) * period / np.pi
        nodes, weights = np.polynomial.hermite_e.hermegauss(_QUADRATURE_NODES)
        shifts = [np.full(len(seconds), sigma_s * node) for node in nodes]
    shares = weights / weights.sum()
    return np.sum([w * trajectory.readings_at(seconds + s) for w, s in zip(shares, shifts, strict=True)], axis=0)


def distort(intrinsics: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(N, 6) readings without bias and noise of true angular rates [rad/s] and specific forces [m/s^2] (N, 6), by
    the scale-misalignment model. intrinsics (24,): see `Scenario`."""
    M_a, M_g = np.eye(3), np.eye(3)
    M_a[_LOWER] += intrinsics[:6]
    M_g[_LOWER] += intrinsics[6:12]
    C_a = rotation_from_vector(intrinsics[12:15])
    A_g = intrinsics[15:24].reshape(3, 3)
    rate, force = true[:, :3], true[:, 3:]
    return np.concatenate([rate @ M_g.T + force @ A_g.T, force @ (M_a @ C_a).T], axis=1)


def rotation_from_vector(vector: np.ndarray) -> np.ndarray:
    """Exp of a rotation vector (3,) [rad] by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle == 0.0:
        return np.eye(3)
    K = skew(vector / angle)
    return np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K


def read_imu(scenario: Scenario, seconds: np.ndarray, true: np.ndarray, rng: np.random.Generator) -> ImuReadings:
    """Readings with bias and noise of true angular rates [rad/s] and specific forces [m/s^2] (N, 6) at seconds (N,).

    A noise density d gives each reading the standard deviation d sqrt(rate). A walk density w adds w sqrt(dt) N(0, 1)
    to the bias from one reading to the next.
    """
    noise = scenario.imu_noise
    white, steps = rng.standard_normal((2, len(seconds), 6)) * float(scenario.imu_noise_enabled)
    white *= np.sqrt(scenario.imu_rate_hz) * np.repeat([noise.gyro, noise.accel], 3)
    steps *= np.repeat([noise.gyro_walk, noise.accel_walk], 3)
    steps[0] = 0.0
    steps[1:] *= np.sqrt(np.diff(seconds))[:, None]
    bias = np.concatenate([scenario.gyro_bias, scenario.accel_bias]) + np.cumsum(steps, axis=0)
    reading = distort(scenario.imu_intrinsics, true) + bias + white
    return ImuReadings(reading[:, :3], reading[:, 3:], bias[:, :3], bias[:, 3:])
