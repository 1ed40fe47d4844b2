"""Extrinsics of a sensor with its own trajectory, by a known trajectory of the IMU."""

from __future__ import annotations

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry.cubic import hermite
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.rate_correlation import MIN_RATE_CORRELATION, SensorRates, max_rate_step
from icalib.initialize.steps.rate_windows import rate_window, window_rates
from icalib.initialize.steps.single_recording import KnownExtrinsics
from icalib.initialize.trajectories.lever_arm_rows import (
    DISPLACEMENT_SIGMA_M,
    lever_arm_prior,
    solve_lever_arm,
    system_from_trajectory,
    unexplained_displacement,
)
from icalib.initialize.trajectories.rotation_alignment import align_trajectory
from icalib.initialize.trajectories.sensor_trajectory import ExtrinsicsGuess, SensorTrajectory
from icalib.motion.imu_data import ImuData
from icalib.optim.state import State

MIN_RATE_WINDOW_S = 0.1  # s: shortest window of a mean rate
MIN_RATE_WINDOWS = 20  # mean rates: fewer do not show a time offset


def trajectory_rates(name: str, path: SensorTrajectory) -> SensorRates:
    """Mean angular rates of the sensor `name`, over windows as long as the noise of its poses demands, at least
    MIN_RATE_WINDOW_S. Raises EstimationError if there are too few, or the rotation is constant."""
    t, R = path.seconds, path.rotation
    longest = max_rate_step(name, t, "poses")
    a, b, rate = window_rates(t, R, rate_window(t, R, MIN_RATE_WINDOW_S, longest), longest)
    if len(a) < MIN_RATE_WINDOWS:
        raise EstimationError(
            f"{name}: only {len(a)} pairs of its {len(t)} poses are at most {longest:.3g} s apart, and "
            f"{MIN_RATE_WINDOWS} are needed; record for longer."
        )
    if not np.linalg.norm(rate, axis=1).max() > 0.0:
        raise EstimationError(
            f"{name}: its rotation is the same in all poses, as if only positions were measured; a pose "
            "sensor needs both."
        )
    return SensorRates(t[a], t[b], rate, MIN_RATE_CORRELATION, longest)


def extrinsics_on_trajectory(
    imu: ImuData, name: str, path: SensorTrajectory, state: State, known: KnownExtrinsics
) -> tuple[ExtrinsicsGuess, float]:
    """The extrinsics of the sensor `name` that align its trajectory `path` to the IMU's in `state`, and
    `unexplained_displacement`. Raises EstimationError if too few poses overlap."""
    rates = trajectory_rates(name, path)
    aligned = align_trajectory(imu, name, rates, known)
    t = path.seconds + aligned.offset
    path = path.only((t >= state.seconds[0]) & (t <= state.seconds[-1]))
    if not len(path.seconds):
        raise too_few_poses(name)
    t = path.seconds + aligned.offset
    R, p = imu_poses_at(state, GyroRotation.integrate(imu, state.bias[:, :3].mean(axis=0)), t)
    prior = lever_arm_prior(np.zeros(0), rates.rate, DISPLACEMENT_SIGMA_M, known.rotation is not None, known.position)
    system = system_from_trajectory(R, p, t, path.rotation, path.position)
    solution = solve_lever_arm(system, prior, aligned.rotation, rates.rate)
    if solution is None:
        raise too_few_poses(name)
    return ExtrinsicsGuess(solution[0], solution[1][3:6], aligned.offset), unexplained_displacement(system, *solution)


def imu_poses_at(state: State, gyro: GyroRotation, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_world_imu (n, 3, 3), p_world_imu (n, 3) m at times t (n,) s: rotations by the gyroscope from the nearest
    keyframe, positions by cubic Hermite interpolation."""
    k = np.clip(np.searchsorted(state.seconds, t, side="right") - 1, 0, len(state.seconds) - 2)
    h = np.diff(state.seconds)[k][:, None]
    s = (t - state.seconds[k])[:, None] / h
    displacement = hermite(
        s, state.position[k + 1] - state.position[k], state.velocity[k] * h, state.velocity[k + 1] * h
    )
    return gyro.carry(state.seconds, state.rotation, t), state.position[k] + displacement


def too_few_poses(name: str) -> EstimationError:
    """The error of a sensor whose poses hardly overlap in time with the trajectory."""
    return EstimationError(
        f"{name}: too few of its poses fall within the recording of the other sensors to estimate its "
        "lever arm; check that the clocks overlap, or record for longer."
    )
