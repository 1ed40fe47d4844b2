"""The motion of the IMU, and a sensor's lever arm, from the sensor's path and the readings of the IMU alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.initialize.paths.imu_motion import ImuMotion
from icalib.initialize.paths.lever_arm_rows import (
    ANY_SIGMA,
    BIAS_SIGMA,
    ONE_AXIS,
    SPEED_SIGMA,
    against_readings,
    arm_prior,
    left_over,
    solve,
)
from icalib.initialize.paths.path import ExtrinsicsGuess, SensorPath
from icalib.initialize.steps.by_recording import Held
from icalib.initialize.steps.clock_shifts import CameraRates
from icalib.initialize.steps.clocks import Alignment, only_axis
from icalib.initialize.steps.gyro import GyroRotation
from icalib.motion.imu_data import ImuData

G_TOLERANCE = 0.1  # of gravity: further off, units are wrong or the path is


@dataclass(frozen=True)
class PathMotion:
    """What a path shows with the IMU: the sensor's guess, the motion of the IMU, the size of gravity [m/s^2], and
    R_world_map, which makes the map level; the origin of the world is the map's. left: see `left_over`."""

    guess: ExtrinsicsGuess
    motion: ImuMotion
    gravity: float
    level: np.ndarray
    left: float


def motion_of_path(
    imu: ImuData, path: SensorPath, rates: CameraRates, aligned: Alignment, gravity: float, held: Held
) -> PathMotion | None:
    """From the path of one sensor, all of it while the IMU was running; gravity [m/s^2]. None where it is too short."""
    gyro, t = GyroRotation.integrate(imu, aligned.gyro_bias), path.seconds + aligned.offset

    def carry(at_poses: np.ndarray) -> np.ndarray:
        return gyro.carry(t, at_poses, imu.seconds)

    prior = arm_prior(
        np.array([ANY_SIGMA] * 3 + [BIAS_SIGMA] * 3), rates.rate, SPEED_SIGMA, held.rotation is not None, held.position
    )
    system = against_readings(imu, carry, t, path.rotation, path.position)
    found = solve(system, prior, aligned.rotation, rates.rate)
    if found is None:
        return None
    R_is, x = found
    level, R_imu = _level(x[6:9]), path.rotation @ R_is.T
    position = (path.position - R_imu @ x[3:6]) @ level.T
    start = ImuMotion(gyro, t, level @ R_imu, position, np.zeros_like(position), aligned.gyro_bias, x[9:12], gravity)
    turned = only_axis(rates.rate, ONE_AXIS) is None
    guess, left = ExtrinsicsGuess(R_is, x[3:6], aligned.offset, turned), left_over(system, R_is, x)
    return PathMotion(guess, start.smoothed(), float(np.linalg.norm(x[6:9])), level, left)


def _level(gravity: np.ndarray) -> np.ndarray:
    """R_world_map: the smallest rotation that brings gravity (3,) down."""
    d = -gravity / np.linalg.norm(gravity)
    axis = np.array([d[1], -d[0], 0.0])  # d x z
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return np.diag([1.0, np.sign(d[2]), np.sign(d[2])])
    return so3.exp(axis * (np.arctan2(sine, d[2]) / sine))
