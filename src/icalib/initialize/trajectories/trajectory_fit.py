"""The trajectory of the IMU and a sensor's extrinsics, from the sensor's trajectory and the IMU's readings alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.rate_alignment import RateAlignment, only_axis
from icalib.initialize.steps.rate_correlation import SensorRates
from icalib.initialize.steps.single_recording import KnownExtrinsics
from icalib.initialize.trajectories.imu_trajectory import ImuTrajectory
from icalib.initialize.trajectories.lever_arm_rows import (
    ACCEL_BIAS_PRIOR,
    SINGLE_AXIS_RATE_RATIO,
    UNKNOWN_SIGMA,
    VELOCITY_CHANGE_SIGMA_M_S,
    lever_arm_prior,
    solve_lever_arm,
    system_from_readings,
    unexplained_displacement,
)
from icalib.initialize.trajectories.sensor_trajectory import ExtrinsicsGuess, SensorTrajectory
from icalib.motion.imu_data import ImuData

TRAJECTORY_GRAVITY_TOLERANCE = 0.1  # relative error of gravity: more means wrong units or a wrong trajectory


@dataclass(frozen=True)
class TrajectoryFit:
    """guess: extrinsics of the sensor; motion: trajectory of the IMU; gravity: its estimated magnitude [m/s^2];
    R_world_map (3, 3): levels the map, whose origin is that of the world; unexplained: see `unexplained_displacement`.
    """

    guess: ExtrinsicsGuess
    motion: ImuTrajectory
    gravity: float
    R_world_map: np.ndarray
    unexplained: float


def fit_imu_trajectory(
    imu: ImuData,
    path: SensorTrajectory,
    rates: SensorRates,
    aligned: RateAlignment,
    gravity: float,
    known: KnownExtrinsics,
) -> TrajectoryFit | None:
    """Fits the trajectory `path` of one sensor, which must lie within the IMU's recording. rates, aligned: of this
    sensor; gravity: expected magnitude [m/s^2]; known: values that are kept. Returns None if the trajectory is too
    short."""
    gyro, t = GyroRotation.integrate(imu, aligned.gyro_bias), path.seconds + aligned.offset

    def carry(at_poses: np.ndarray) -> np.ndarray:
        return gyro.carry(t, at_poses, imu.seconds)

    sigmas = np.array([UNKNOWN_SIGMA] * 3 + [ACCEL_BIAS_PRIOR] * 3)  # of gravity and bias
    rotation_known = known.rotation is not None
    prior = lever_arm_prior(sigmas, rates.rate, VELOCITY_CHANGE_SIGMA_M_S, rotation_known, known.position)
    system = system_from_readings(imu, carry, t, path.rotation, path.position)
    solution = solve_lever_arm(system, prior, aligned.rotation, rates.rate)
    if solution is None:
        return None
    R_is, x = solution
    R_world_map, R_map_imu = _levelling_rotation(x[6:9]), path.rotation @ R_is.T
    position = (path.position - R_map_imu @ x[3:6]) @ R_world_map.T
    velocity = np.zeros_like(position)
    start = ImuTrajectory(gyro, t, R_world_map @ R_map_imu, position, velocity, aligned.gyro_bias, x[9:12], gravity)
    rotation_observable = only_axis(rates.rate, SINGLE_AXIS_RATE_RATIO) is None
    guess = ExtrinsicsGuess(R_is, x[3:6], aligned.offset, rotation_observable)
    unexplained = unexplained_displacement(system, R_is, x)
    return TrajectoryFit(guess, start.smoothed(), float(np.linalg.norm(x[6:9])), R_world_map, unexplained)


def _levelling_rotation(gravity: np.ndarray) -> np.ndarray:
    """R_world_map: the smallest rotation that turns gravity (3,) to -z."""
    d = -gravity / np.linalg.norm(gravity)
    axis = np.array([d[1], -d[0], 0.0])  # d x z
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return np.diag([1.0, np.sign(d[2]), np.sign(d[2])])
    return so3.exp(axis * (np.arctan2(sine, d[2]) / sine))
