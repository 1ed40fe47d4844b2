"""The trajectory of the IMU and a sensor's extrinsics, from the sensor's trajectory and the IMU's readings alone.

Extrinsics of a sensor with its own trajectory, by a known trajectory of the IMU. Time offset, rotation and gyroscope
bias that align a sensor's trajectory to the IMU, by angular rates.

The trajectory of a sensor by its own measurements, and the guess of its extrinsics.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.vectors import hermite
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.rate_alignment import (
    RateAlignment,
    align_rates,
    alignment_as_stated,
    is_still,
    only_axis,
    rates_contradict,
    rms_rates,
)
from icalib.initialize.steps.rate_correlation import MIN_RATE_CORRELATION, SensorRates, max_rate_step
from icalib.initialize.steps.single_recording import KnownExtrinsics
from icalib.initialize.steps.smooth_trajectory import rate_window, window_rates
from icalib.initialize.trajectories.imu_trajectory import ImuTrajectory
from icalib.initialize.trajectories.lever_arm_rows import (
    ACCEL_BIAS_PRIOR,
    DISPLACEMENT_SIGMA_M,
    SINGLE_AXIS_RATE_RATIO,
    UNKNOWN_SIGMA,
    VELOCITY_CHANGE_SIGMA_M_S,
    is_mirrored,
    lever_arm_prior,
    solve_lever_arm,
    system_from_readings,
    system_from_trajectory,
    unexplained_displacement,
)
from icalib.motion.imu_data import ImuData
from icalib.optim.state import Key, State

TRAJECTORY_GRAVITY_TOLERANCE = 0.1  # relative error of gravity: more means wrong units or a wrong trajectory


@dataclass(frozen=True)
class TrajectoryFit:
    """guess: extrinsics of the sensor; motion: trajectory of the IMU; gravity: its estimated magnitude [m/s^2];
    R_world_map (3, 3): levels the map, whose origin is that of the world; unexplained: see `unexplained_displacement`;
    mirrored: see `is_mirrored`.
    """

    guess: ExtrinsicsGuess
    motion: ImuTrajectory
    gravity: float
    R_world_map: np.ndarray
    unexplained: float
    mirrored: bool


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
    unexplained, mirrored = unexplained_displacement(system, R_is, x), is_mirrored(system, R_is, x)
    return TrajectoryFit(guess, start.smoothed(), float(np.linalg.norm(x[6:9])), R_world_map, unexplained, mirrored)


def _levelling_rotation(gravity: np.ndarray) -> np.ndarray:
    """R_world_map: the smallest rotation that turns gravity (3,) to -z."""
    d = -gravity / np.linalg.norm(gravity)
    axis = np.array([d[1], -d[0], 0.0])  # d x z
    sine = np.linalg.norm(axis)
    if sine < 1e-12:
        return np.diag([1.0, np.sign(d[2]), np.sign(d[2])])
    return so3.exp(axis * (np.arctan2(sine, d[2]) / sine))


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


def align_trajectory(imu: ImuData, name: str, rates: SensorRates, known: KnownExtrinsics) -> RateAlignment:
    """Alignment from the angular rates of the sensor `name`; `known` values are kept. Raises EstimationError if the
    rates do not determine it, or contradict the known values."""
    if known.rotation is not None and known.offset is not None:
        alignment = alignment_as_stated(imu, name, rates, known.offset, known.rotation)
        if rates_contradict(imu, rates, alignment):
            raise EstimationError(
                f"{name} does not turn as {imu.name} does with the rotation and time_offset in the rig file; "
                "correct them, or remove them so that they are estimated."
            )
        return alignment
    _check_turning(imu, name, rates)
    alignment = align_rates(imu, name, rates, known.offset)
    return (
        alignment if known.rotation is None else alignment_as_stated(imu, name, rates, alignment.offset, known.rotation)
    )


def _check_turning(imu: ImuData, name: str, rates: SensorRates) -> None:
    """Raises EstimationError if neither sensor turned significantly."""
    imu_rate, sensor_rate = rms_rates(imu, rates)
    if is_still(imu_rate, sensor_rate):
        raise EstimationError(
            f"{name} and {imu.name} hardly turn ({imu_rate:.4f} rad/s RMS), so time offset and rotation are "
            "unobservable; record again with rotation about two axes or more, or give rotation and "
            f"time_offset of {name} in the rig file."
        )


@dataclass(frozen=True)
class SensorTrajectory:
    """Poses of a sensor in a frame of its own, the map: seconds (n,) on its clock since its first stamp, R_map_sensor
    (n, 3, 3), p_map_sensor (n, 3) m; ok (n,): whether the pose is known."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    ok: np.ndarray

    def only(self, chosen: np.ndarray) -> SensorTrajectory:
        """The poses selected by `chosen` (n,)."""
        return SensorTrajectory(self.seconds[chosen], self.rotation[chosen], self.position[chosen], self.ok[chosen])


@dataclass(frozen=True)
class ExtrinsicsGuess:
    """rotation: R_imu_sensor (3, 3); position: p_imu_sensor (3,) m; offset: t_imu - t_sensor [s], both since their
    clocks' first stamps; rotation_observable: whether the sensor turned about more than one axis."""

    rotation: np.ndarray
    position: np.ndarray
    offset: float
    rotation_observable: bool = False

    def values(self, name: str) -> dict[Key, np.ndarray]:
        """The guess as calibration parameters of the sensor `name`."""
        return {
            (name, "rotation"): self.rotation,
            (name, "translation"): self.position,
            (name, "time_offset"): np.array([self.offset]),
        }
