"""A sensor whose poses are measured, placed on a motion of the IMU that other sensors showed."""

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

MIN_RATE_WINDOW_S = 0.1  # of a mean rate, at least
MIN_RATE_WINDOWS = 20


def trajectory_rates(name: str, path: SensorTrajectory) -> SensorRates:
    """Mean angular rates of the sensor `name` over windows of WINDOW_S or more, as the noise of its poses asks for, one
    from each pose. Raises EstimationError where there are hardly any."""
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
    imu: ImuData, name: str, path: SensorTrajectory, known: State, held: KnownExtrinsics
) -> tuple[ExtrinsicsGuess, float]:
    """The guess of the sensor `name` from the motion of the IMU in `known`, and the share of its displacements that is
    left, see `left_over`. Raises EstimationError where they do not show it."""
    rates = trajectory_rates(name, path)
    aligned = align_trajectory(imu, name, rates, held)
    t = path.seconds + aligned.offset
    path = path.only((t >= known.seconds[0]) & (t <= known.seconds[-1]))
    if not len(path.seconds):
        raise too_few_poses(name)
    t = path.seconds + aligned.offset
    R, p = imu_poses_at(known, GyroRotation.integrate(imu, known.bias[:, :3].mean(axis=0)), t)
    prior = lever_arm_prior(np.zeros(0), rates.rate, DISPLACEMENT_SIGMA_M, held.rotation is not None, held.position)
    system = system_from_trajectory(R, p, t, path.rotation, path.position)
    found = solve_lever_arm(system, prior, aligned.rotation, rates.rate)
    if found is None:
        raise too_few_poses(name)
    return ExtrinsicsGuess(found[0], found[1][3:6], aligned.offset), unexplained_displacement(system, *found)


def imu_poses_at(known: State, gyro: GyroRotation, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_world_imu (n, 3, 3), p_world_imu (n, 3) at times t (n,): positions are cubic between keyframes, by their
    velocities."""
    k = np.clip(np.searchsorted(known.seconds, t, side="right") - 1, 0, len(known.seconds) - 2)
    h = np.diff(known.seconds)[k][:, None]
    s = (t - known.seconds[k])[:, None] / h
    way = hermite(s, known.position[k + 1] - known.position[k], known.velocity[k] * h, known.velocity[k + 1] * h)
    return gyro.carry(known.seconds, known.rotation, t), known.position[k] + way


def too_few_poses(name: str) -> EstimationError:
    """The error of a sensor whose poses hardly overlap with the motion."""
    return EstimationError(
        f"{name}: too few of its poses fall within the recording of the other sensors to estimate its "
        "lever arm; check that the clocks overlap, or record for longer."
    )
