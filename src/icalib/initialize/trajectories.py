"""A sensor's own trajectory, aligned to the IMU's readings or to a known trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.small import hermite, once_integrated
from icalib.initialize.initializer import KnownExtrinsics
from icalib.initialize.lever_arm import Triples
from icalib.initialize.rate_alignment import (
    RateAlignment,
    align_rates,
    alignment_as_stated,
    is_still,
    only_axis,
    rates_contradict,
    rms_rates,
)
from icalib.initialize.rate_correlation import MIN_RATE_CORRELATION, GyroRotation, SensorRates, max_rate_step
from icalib.initialize.smooth_trajectory import rate_window, window_rates
from icalib.motion.imu_data import ImuData, clear_of
from icalib.optim.state import Key, State

# The trajectory of the IMU and a sensor's extrinsics, from the sensor's trajectory and the IMU's readings alone.
#
# Extrinsics of a sensor with its own trajectory, by a known trajectory of the IMU. Time offset, rotation and gyroscope
# bias that align a sensor's trajectory to the IMU, by angular rates.
#
# The trajectory of a sensor by its own measurements, and the guess of its extrinsics.

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
    R_world_map, R_map_imu = levelling_rotation(x[6:9]), path.rotation @ R_is.T
    position = (path.position - R_map_imu @ x[3:6]) @ R_world_map.T
    velocity = np.zeros_like(position)
    start = ImuTrajectory(gyro, t, R_world_map @ R_map_imu, position, velocity, aligned.gyro_bias, x[9:12], gravity)
    rotation_observable = only_axis(rates.rate, SINGLE_AXIS_RATE_RATIO) is None
    guess = ExtrinsicsGuess(R_is, x[3:6], aligned.offset, rotation_observable)
    unexplained, mirrored = unexplained_displacement(system, R_is, x), is_mirrored(system, R_is, x)
    return TrajectoryFit(guess, start.smoothed(), float(np.linalg.norm(x[6:9])), R_world_map, unexplained, mirrored)


def levelling_rotation(gravity: np.ndarray) -> np.ndarray:
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


# Lever arm of a sensor with its own trajectory, and the part of its rotation that angular rates do not determine.
#
# `map` is the world frame of the sensor's trajectory. If the IMU's trajectory (R, p) is known, with the sensor's
# displacement u from instant i to j in sensor axes at i (hand-eye equation):
#
#     (R_j - R_i) p_imu_sensor - R_i R_imu_sensor u = p_i - p_j
#
# With the IMU's readings alone, and A[x] = (x_2 - x_1) / h_2 - (x_1 - x_0) / h_1 over three poses, which removes
# velocities (symbols as in `lever_arm`, with `map` in place of the board frame):
#
#     A[p_map_sensor] = A[R_map_imu] p_imu_sensor + A[D_f] - A[D_R] b_a + g (h_1 + h_2) / 2
#
# Both are also linear in a small rotation d of R_imu_sensor Exp(d). If the sensor turned about one axis, rates do not
# show d about this axis. The solution then starts from the candidate rotation about the axis that fits these equations
# best.

LEVER_ARM_PRIOR_M = 0.5  # m: prior standard deviation; keeps unobservable components small
ACCEL_BIAS_PRIOR = 0.3  # m/s^2: prior standard deviation
UNKNOWN_SIGMA = 1e3  # prior standard deviation of unknowns without a prior, in their units
FIXED_SIGMA = 1e-6  # prior standard deviation of known values, in their units
DISPLACEMENT_SIGMA_M = 0.1  # m: standard deviation of a row of displacements
VELOCITY_CHANGE_SIGMA_M_S = 0.05  # m/s: standard deviation of a row of readings
SENSOR_RATE_SIGMA_RAD_S = 0.02  # rad/s: standard deviation of a rate of the sensor
DISPLACEMENT_SPANS_S = (0.5, 2.0)  # s between the two poses of a displacement
MIN_TRIPLE_STEP_S = 0.1  # s between the poses of a triple
MIN_LEVER_ARM_ROWS = 10  # equations of three components each
# Spread of rates along the second principal axis over that along the first: below, the second is noise
SINGLE_AXIS_RATE_RATIO = 0.1
AXIS_TURN_CANDIDATES = 24  # start rotations about a single axis, 15 degrees apart
LEVER_ARM_ITERATIONS = 5  # of Gauss-Newton on the rotation
# unexplained share above which axes are left-handed: it is 2 there without noise, at most 1 in right-handed axes
MIN_MIRRORED_SHARE = 1.4


class LeverArmRows(NamedTuple):
    """Linear system A x = b: A (n, 3, m), b (n, 3). The first six of x are d [rad] and p_imu_sensor [m]. motion (n, 3):
    the part of b that the sensor's trajectory contributes."""

    A: np.ndarray
    b: np.ndarray
    motion: np.ndarray


# Maps R_imu_sensor and p_imu_sensor to the rows linearised there
LeverArmSystem = Callable[[np.ndarray, np.ndarray], LeverArmRows]


@dataclass(frozen=True)
class GaussianPrior:
    """Prior of x (m,). mean: in the units of x; sigma: standard deviation over that of a row; information (3, 3): of d
    by angular rates, times the variance of a row."""

    mean: np.ndarray
    sigma: np.ndarray
    information: np.ndarray


def lever_arm_prior(
    sigmas: np.ndarray, rates: np.ndarray, row_sigma: float, rotation_known: bool, arm: np.ndarray | None
) -> GaussianPrior:
    """The prior of a system with unknowns of standard deviation `sigmas` (k,) after d and p. rates (n, 3) rad/s: of the
    sensor; row_sigma: of a row; rotation_known: whether d is fixed at zero; arm (3,) m: the lever arm if it is known.
    """
    d = FIXED_SIGMA if rotation_known else UNKNOWN_SIGMA
    arm_sigma = LEVER_ARM_PRIOR_M if arm is None else FIXED_SIGMA
    mean = np.concatenate([np.zeros(3), np.zeros(3) if arm is None else arm, np.zeros(len(sigmas))])
    w = rates - rates.mean(axis=0)
    information = (w**2).sum() * np.eye(3) - w.T @ w
    return GaussianPrior(
        mean,
        np.concatenate([[d] * 3, [arm_sigma] * 3, sigmas]) / row_sigma,
        information * (row_sigma / SENSOR_RATE_SIGMA_RAD_S) ** 2,
    )


def system_from_trajectory(
    R_imu: np.ndarray, p_imu: np.ndarray, seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray
) -> LeverArmSystem:
    """The system of a sensor with poses R_map_sensor, p_map_sensor at seconds (n,), at which the IMU has the poses
    R_imu (n, 3, 3), p_imu (n, 3) in any world."""
    i, j = _displacement_pairs(seconds)
    u = np.einsum("nji,nj->ni", rotation[i], position[j] - position[i])
    hat_u = so3.hat_many(u)

    def rows(R_is: np.ndarray, p_is: np.ndarray) -> LeverArmRows:
        """First (hand-eye) equation of the module, linearised at R_is; it is linear in p_imu_sensor."""
        R = R_imu[i] @ R_is
        A = np.concatenate([R @ hat_u, R_imu[j] - R_imu[i]], axis=2)
        displacement = np.einsum("nij,nj->ni", R, u)
        return LeverArmRows(A, displacement - (p_imu[j] - p_imu[i]), displacement)

    return rows


def system_from_readings(
    imu: ImuData,
    carry: Callable[[np.ndarray], np.ndarray],
    seconds: np.ndarray,
    rotation: np.ndarray,
    position: np.ndarray,
) -> LeverArmSystem:
    """The system of a sensor with poses R_map_sensor, p_map_sensor at seconds (n,) on the IMU's clock. carry: maps
    R_map_imu (n, 3, 3) at the poses to those at the IMU's stamps (N, 3, 3). The unknowns after p are gravity [m/s^2] in
    the map and the accelerometer's bias [m/s^2]."""
    triples = _pose_triples(seconds, imu.gaps)
    n, second = len(triples.i), triples.second
    velocity_changes = second(position)

    def rows(R_is: np.ndarray, p_is: np.ndarray) -> LeverArmRows:
        """Second equation of the module, A[p_map_sensor] = ..., linearised at R_is, p_is. Columns: d, p_imu_sensor,
        gravity, accelerometer bias."""
        R_at_poses = rotation @ R_is.T
        R = carry(R_at_poses)
        force = np.einsum("nij,nj->ni", R, imu.accel)
        # R_map_sensor is measured, so R_imu_sensor Exp(d) rotates the force by -d in the sensor's axes.
        J_force_d = so3.hat_many(force) @ R @ R_is
        x = np.concatenate([force, R.reshape(-1, 9), J_force_d.reshape(-1, 9)], axis=1)
        D = SignalIntegrals.of(imu, x).at(seconds)[1]  # double integrals: of force, of R_map_imu, of J_force_d
        A = np.zeros((n, 3, 12))
        A[:, :, :3] = second(rotation @ so3.hat_many((R_is.T @ p_is)[None])[0] + D[:, 12:].reshape(-1, 3, 3))
        A[:, :, 3:6] = second(R_at_poses)
        A[:, :, 6:9] = triples.half[:, None, None] * np.eye(3)
        A[:, :, 9:] = -second(D[:, 3:12].reshape(-1, 3, 3))
        return LeverArmRows(A, velocity_changes - second(D[:, :3]), velocity_changes)

    return rows


def solve_lever_arm(
    rows: LeverArmSystem, prior: GaussianPrior, R_is: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """R_imu_sensor and x (m,) that fit the system best, starting at the rotation R_is that fits the sensor's rates
    (n, 3). None if the system has too few rows."""
    start = prior.mean[3:6]
    if len(rows(R_is, start).b) < MIN_LEVER_ARM_ROWS:
        return None
    rotation_known = prior.sigma[0] < 1.0
    axis = only_axis(rates, SINGLE_AXIS_RATE_RATIO)
    if not rotation_known and axis is not None:
        angles = 2.0 * np.pi * np.arange(AXIS_TURN_CANDIDATES) / AXIS_TURN_CANDIDATES
        turns = so3.exp_many(angles[:, None] * axis)
        R_is = min((R_is @ turn for turn in turns), key=lambda R: _misfit_of_rotation(rows(R, start), prior))
    x = prior.mean
    for _ in range(LEVER_ARM_ITERATIONS):
        x = _robust_least_squares(rows(R_is, x[3:6]), prior, 0)[0]
        R_is = R_is @ so3.exp(x[:3].copy())
    return R_is, x


def unexplained_displacement(rows: LeverArmSystem, R_is: np.ndarray, x: np.ndarray) -> float:
    """Median residual of the solution R_is, x (m,) over the median motion of the IMU in the equations. The motion of
    the sensor is no measure: inverted poses of a robot that turns in place move far, and any lever arm explains it."""
    residual, _, of_imu = _median_sizes(rows, R_is, x)
    return residual / of_imu


def is_mirrored(rows: LeverArmSystem, R_is: np.ndarray, x: np.ndarray) -> bool:
    """Whether the sensor moved opposite to the solution R_is, x (m,). Rates in left-handed axes equal those in axes
    rotated by 180 deg, so such rates fit. Displacements then have the wrong sign, and the residual is about twice as
    large as the displacements, by IMU and by sensor."""
    residual, of_sensor, of_imu = _median_sizes(rows, R_is, x)
    return residual > MIN_MIRRORED_SHARE * max(of_sensor, of_imu)


def _median_sizes(rows: LeverArmSystem, R_is: np.ndarray, x: np.ndarray) -> tuple[float, float, float]:
    """Median sizes of the residuals of R_is, x (m,), and of the motion of sensor and IMU in the equations [m]."""
    A, b, motion = rows(R_is, x[3:6])
    inertial = motion - b + A[:, :, 6:] @ x[6:]  # without gravity and bias
    vectors = (b - A[:, :, 3:] @ x[3:], motion, inertial)
    residual, of_sensor, of_imu = (float(np.median(np.linalg.norm(v, axis=1))) for v in vectors)
    return residual, of_sensor, max(of_imu, 1e-30)


def _misfit_of_rotation(rows: LeverArmRows, prior: GaussianPrior) -> float:
    """RMS residual of the best fit with d = 0."""
    return _robust_least_squares(rows, prior, 3)[1]


def _robust_least_squares(rows: LeverArmRows, prior: GaussianPrior, without: int) -> tuple[np.ndarray, float]:
    """Least squares for x, without its first `without` components, with the prior. Repeated twice without outliers.
    Returns x (m,) and the RMS residual of the inliers."""
    A, free = rows.A[:, :, without:], slice(without, None)
    N0, mean = np.diag(prior.sigma[free] ** -2), prior.mean[free]
    weight, x, size = np.ones(len(A)), mean, np.zeros(len(A))
    r0 = N0 @ mean
    if not without:
        N0[:3, :3] += prior.information
    for _ in range(3):
        wA = A * weight[:, None, None]
        x = np.linalg.solve(N0 + np.einsum("nia,nib->ab", wA, A), r0 + np.einsum("nia,ni->a", wA, rows.b))
        size = np.linalg.norm(rows.b - A @ x, axis=1)
        weight = (size < 4.0 * np.median(size) + 1e-9).astype(float)
    return np.concatenate([np.zeros(without), x]), float(np.sqrt(np.mean(size[weight > 0.0] ** 2)))


def _displacement_pairs(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of instants (i, j) about DISPLACEMENT_SPANS_S apart."""
    i = np.tile(np.arange(len(t)), len(DISPLACEMENT_SPANS_S))
    span = np.repeat(DISPLACEMENT_SPANS_S, len(t))
    j = np.searchsorted(t, t[i] + span - 1e-3)
    good = (j < len(t)) & (t[np.minimum(j, len(t) - 1)] - t[i] < 2.0 * span)
    return i[good], j[good]


def _pose_triples(t: np.ndarray, gaps: tuple[tuple[float, float], ...]) -> Triples:
    """Triples of poses about MIN_TRIPLE_STEP_S apart, or of neighbours if these are further apart. None spans a gap of
    the IMU."""
    i = np.arange(len(t))
    step = max(MIN_TRIPLE_STEP_S, float(np.median(np.diff(t))))
    j = np.searchsorted(t, t + 0.99 * step - 1e-3)
    k = np.searchsorted(t, t + 1.98 * step - 1e-3)
    good = (k < len(t)) & (j < k) & (i < j)
    i, j, k = i[good], j[good], k[good]
    close = (t[j] - t[i] < 2.0 * step) & (t[k] - t[j] < 2.0 * step)
    close &= clear_of(gaps, t[i], t[k])
    return Triples.at(t, i[close], j[close], k[close])


# Trajectory of the IMU, from the poses of a sensor on it and from the IMU's readings in between.
#
# Rotations come from the sensor, interpolated by the gyroscope. With known gravity and accelerometer bias, positions
# p_k and velocities v_k at the poses k follow by linear least squares, independently for each axis, from
#
#     p_k+1 = p_k + v_k h + g h^2 / 2 + dp_k        v_k+1 = v_k + g h + dv_k        p_k = measured position
#
# with interval h, gravity g, and the double and single integrals dp_k, dv_k of the specific force in world axes.

SENSOR_POSITION_SIGMA_M = 0.02  # m: standard deviation of the sensor's positions
IMU_DISPLACEMENT_SIGMA_M = 2e-3  # m: of a displacement by the IMU between two poses, without gap
IMU_VELOCITY_SIGMA_M_S = 0.02  # m/s: of a change of velocity by the IMU between two poses, without gap
IMU_GAP_SIGMA_FACTOR = 1e4  # factor on both standard deviations of the IMU over a gap: practically no constraint
MAX_PROPAGATION_S = 1.0  # s: longer intervals between poses count as gaps


@dataclass(frozen=True)
class SignalIntegrals:
    """First and second integrals over time, from the first stamp, of a signal x (N, m) that is linear between the IMU's
    stamps. once, twice (N, m): at these stamps."""

    imu: ImuData
    x: np.ndarray
    once: np.ndarray
    twice: np.ndarray

    @classmethod
    def of(cls, imu: ImuData, x: np.ndarray) -> SignalIntegrals:
        """Integrates the signal x (N, m), given at the stamps of `imu`."""
        h = np.diff(imu.seconds)[:, None]
        once, twice = once_integrated(x, h[:, 0]), np.zeros_like(x)
        twice[1:] = np.cumsum(h * once[:-1] + h**2 * (x[:-1] / 3.0 + x[1:] / 6.0), axis=0)
        return cls(imu, x, once, twice)

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First and second integral (n, m) at times t (n,) s. Outside the recording the signal is extrapolated
        linearly."""
        j = self.imu.interval(t)
        s, h = (t - self.imu.seconds[j])[:, None], np.diff(self.imu.seconds)[j][:, None]
        slope = (self.x[j + 1] - self.x[j]) / h
        once = self.once[j] + self.x[j] * s + 0.5 * slope * s**2
        return once, self.twice[j] + self.once[j] * s + 0.5 * self.x[j] * s**2 + slope * s**3 / 6.0


@dataclass(frozen=True)
class ImuTrajectory:
    """The IMU in a world with z up, at increasing seconds (n,): R_world_imu (n, 3, 3), position (n, 3) m, velocity
    (n, 3) m/s. gyro_bias (3,) rad/s, accel_bias (3,) m/s^2; gravity: magnitude [m/s^2]."""

    gyro: GyroRotation
    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    gravity: float

    @property
    def bias(self) -> np.ndarray:
        """(6,) biases of gyroscope [rad/s] and accelerometer [m/s^2]."""
        return np.concatenate([self.gyro_bias, self.accel_bias])

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_world_imu (n, 3, 3), position (n, 3) m and velocity (n, 3) m/s at times t (n,) s on the IMU's clock,
        propagated by its readings from the last instant before."""
        down = np.array([0.0, 0.0, -self.gravity])
        force = self._force_integrals()
        k = np.clip(np.searchsorted(self.seconds, t, side="right") - 1, 0, len(self.seconds) - 1)
        once, twice = force.at(t)
        once_k, twice_k = (x[k] for x in force.at(self.seconds))
        h = (t - self.seconds[k])[:, None]
        velocity = self.velocity[k] + h * down + once - once_k
        position = self.position[k] + h * self.velocity[k] + 0.5 * h**2 * down + twice - twice_k - h * once_k
        return self.gyro.carry(self.seconds, self.rotation, t), position, velocity

    def _force_integrals(self) -> SignalIntegrals:
        """Integrals of the specific force in world axes, without bias."""
        imu = self.gyro.imu
        R = self.gyro.carry(self.seconds, self.rotation, imu.seconds)
        return SignalIntegrals.of(imu, np.einsum("nij,nj->ni", R, imu.accel - self.accel_bias))

    def smoothed(self) -> ImuTrajectory:
        """The trajectory with positions smoothed, and velocities estimated, by the IMU's readings between the poses."""
        down, t = np.array([0.0, 0.0, -self.gravity]), self.seconds
        once, twice = self._force_integrals().at(t)
        h = np.diff(t)[:, None]
        velocity_change = np.diff(once, axis=0) + h * down
        displacement = np.diff(twice, axis=0) - h * once[:-1] + 0.5 * h**2 * down
        has_gap = (h[:, 0] > MAX_PROPAGATION_S) | ~clear_of(self.gyro.imu.gaps, t[:-1], t[1:])
        position, velocity = _least_squares(
            h[:, 0], self.position, displacement, velocity_change, np.where(has_gap, IMU_GAP_SIGMA_FACTOR, 1.0)
        )
        return ImuTrajectory(
            self.gyro, t, self.rotation, position, velocity, self.gyro_bias, self.accel_bias, self.gravity
        )


def _least_squares(
    h: np.ndarray,
    positions: np.ndarray,
    displacement: np.ndarray,
    velocity_change: np.ndarray,
    sigma_factor: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and velocities (n, 3) from measured positions (n, 3), and increments of position and velocity (n -
    1, 3) over intervals h (n - 1,) s, whose standard deviations are scaled by sigma_factor (n - 1,)."""
    n = len(positions)
    D, U, r = np.zeros((n, 2, 2)), np.zeros((n - 1, 2, 2)), np.zeros((n, 2, 3))
    D[:, 0, 0] = SENSOR_POSITION_SIGMA_M**-2
    r[:, 0] = positions * SENSOR_POSITION_SIGMA_M**-2
    # Rows B x_k+1 + A x_k = (displacement, velocity_change) of x = (position, velocity).
    A, B = np.zeros((n - 1, 2, 2)), np.tile(np.eye(2), (n - 1, 1, 1))
    A[:, 0, 0] = A[:, 1, 1] = -1.0
    A[:, 0, 1] = -h
    w = np.stack(
        [(IMU_DISPLACEMENT_SIGMA_M * sigma_factor) ** -2, (IMU_VELOCITY_SIGMA_M_S * sigma_factor) ** -2], axis=1
    )
    b = np.stack([displacement, velocity_change], axis=1)
    At, Bt = A.transpose(0, 2, 1) * w[:, None, :], B.transpose(0, 2, 1) * w[:, None, :]
    D[:-1] += At @ A
    D[1:] += Bt @ B
    U[:] = At @ B
    r[:-1] += At @ b
    r[1:] += Bt @ b
    x = _solve_block_tridiagonal(D, U, r)
    return x[:, 0], x[:, 1]


def _solve_block_tridiagonal(D: np.ndarray, U: np.ndarray, r: np.ndarray) -> np.ndarray:
    """x (n, 2, 3) of the symmetric system with diagonal blocks D (n, 2, 2), blocks U (n - 1, 2, 2) above them and right
    sides r (n, 2, 3), by block elimination. D and r are overwritten."""
    n = len(D)
    for k in range(1, n):
        F = np.linalg.solve(D[k - 1], U[k - 1]).T
        D[k] -= F @ U[k - 1]
        r[k] -= F @ r[k - 1]
    x = np.empty((n, 2, 3))
    x[-1] = np.linalg.solve(D[-1], r[-1])
    for k in range(n - 2, -1, -1):
        x[k] = np.linalg.solve(D[k], r[k] - U[k] @ x[k + 1])
    return x
