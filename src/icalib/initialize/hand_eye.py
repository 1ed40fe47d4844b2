"""Closed-form alignment of two motions: hand-eye rotation, lever arm, and regression of rates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.small import MEDIAN_NORM, once_integrated, twice_integrated
from icalib.initialize.rate_correlation import (
    MAX_OFFSET_PEAKS,
    MAX_USUAL_STEPS,
    MIN_PEAK_DISTANCE_S,
    MIN_RATE_OVERLAP_S,
    GyroRotation,
    SensorRates,
    interpolated,
)
from icalib.motion.factor import Extrinsics, Frame, absolute_residuals
from icalib.motion.imu_data import ImuData, clear_of

# Hand-eye calibration: extrinsics of a pose sensor on a body, from poses of both at the same instants.
#
#     T_world_body(i) T_body_sensor = T_world_frame T_frame_sensor(i)
#
# The rotation starts from relative rotations between pairs of instants (Park and Martin, IEEE Trans. Robotics and
# Automation, 1994). If these are all about one axis, or there are none, it starts from relative translations as well.
# All twelve unknowns follow by robust Gauss-Newton. Nothing is assumed about the motion between instants.

MAX_HAND_EYE_PAIRS = 2000  # pairs of instants between which motions are compared; bounds the time
# Singular values of the rotation vectors, second over first: below, the second axis may be noise
SINGLE_AXIS_TURN_RATIO = 0.1
HAND_EYE_CANDIDATES = 24  # start rotations about a single axis, 15 degrees apart
MAX_HAND_EYE_ITERATIONS = 40  # at most; a smaller step than HAND_EYE_STEP_TOLERANCE ends it
HAND_EYE_STEP_TOLERANCE = 1e-10  # rad, m: largest component of the last step
MAX_HAND_EYE_STEP_RAD = 0.5  # rad: largest rotation of a step; the linearisation does not hold beyond
# Prior standard deviations of the extrinsics about their start value: unobservable components stay there.
EXTRINSICS_PRIOR_RAD = 3.0
EXTRINSICS_PRIOR_M = 0.5
MIN_RESIDUAL_SCALE = 1e-7  # rad, m: keeps weights finite for poses without noise
CAUCHY_WIDTH_SIGMAS = 3.0  # standard deviations: width of Cauchy's loss
OUTLIER_SIGMAS = 6.0  # standard deviations: pairs with a larger residual are rejected
MAX_OUTLIER_SHARE = 0.3  # of all pairs
MAX_UNEXPLAINED_MOTION = 0.35  # unexplained share of the motion: above, the poses do not belong to one rigid body
# Floors of the relative motion that residuals are compared with: a body at rest has none.
MIN_COMPARED_TURN_RAD = 0.02  # rad
MIN_COMPARED_DISPLACEMENT_M = 0.01  # m


@dataclass(frozen=True)
class PosePairs:
    """Poses of a body and of a sensor on it at the same n instants: R_world_body (n, 3, 3), p_world_body (n, 3) m;
    R_frame_sensor, p_frame_sensor likewise."""

    R_body: np.ndarray
    p_body: np.ndarray
    R_sensor: np.ndarray
    p_sensor: np.ndarray

    def some(self, which: np.ndarray) -> PosePairs:
        """The pairs selected by `which`, indices or a mask."""
        return PosePairs(self.R_body[which], self.p_body[which], self.R_sensor[which], self.p_sensor[which])


class HandEye(NamedTuple):
    """extrinsics: T_body_sensor; frame: T_world_frame; residual (n, 6): rotation [rad] and position [m] of each
    pair."""

    extrinsics: Extrinsics
    frame: Frame
    residual: np.ndarray


class RelativeMotions(NamedTuple):
    """Relative poses between m pairs of instants: rotation vectors (m, 3) rad of body and sensor, and their
    displacements (m, 3) m, each in its own axes at the first instant."""

    turn_body: np.ndarray
    turn_sensor: np.ndarray
    displacement_body: np.ndarray
    displacement_sensor: np.ndarray


def hand_eye(pairs: PosePairs, start: Extrinsics | None, fixed: tuple[bool, bool]) -> HandEye:
    """The extrinsics and the frame that fit the pairs best, robustly. start: T_body_sensor, used for components that
    the poses do not show. fixed: whether rotation and translation of `start` are kept. Needs at least three pairs."""
    motions = relative_motions(pairs)
    rotations = [start.R] if start is not None and fixed[0] else _start_rotations(motions)
    if start is not None and not fixed[0]:
        rotations.append(start.R)
    p = np.zeros(3) if start is None else start.p
    fits = [_gauss_newton(pairs, Extrinsics(R, p), fixed) for R in rotations]
    return min(fits, key=lambda f: _cost(f.residual))


def relative_motions(pairs: PosePairs) -> RelativeMotions:
    """Relative motions between all pairs of instants, or between MAX_HAND_EYE_PAIRS random ones."""
    n = len(pairs.p_body)
    i, j = np.triu_indices(n, 1)
    if len(i) > MAX_HAND_EYE_PAIRS:
        some = np.random.default_rng(0).choice(len(i), MAX_HAND_EYE_PAIRS, replace=False)
        i, j = i[some], j[some]
    turns, displacements = [], []
    for R, p in ((pairs.R_body, pairs.p_body), (pairs.R_sensor, pairs.p_sensor)):
        R_back = R[i].transpose(0, 2, 1)
        turns.append(so3.log_many(np.ascontiguousarray(R_back @ R[j])))
        displacements.append(np.einsum("nij,nj->ni", R_back, p[j] - p[i]))
    return RelativeMotions(*turns, *displacements)


def unexplained_motion(pairs: PosePairs, fit: HandEye) -> float:
    """Median residual over the median relative motion, the larger ratio of rotation and position."""
    motions = relative_motions(pairs)
    angle = max(_median_norm(motions.turn_body), _median_norm(motions.turn_sensor), MIN_COMPARED_TURN_RAD)
    distance = max(
        _median_norm(motions.displacement_body), _median_norm(motions.displacement_sensor), MIN_COMPARED_DISPLACEMENT_M
    )
    return max(_median_norm(fit.residual[:, :3]) / angle, _median_norm(fit.residual[:, 3:]) / distance)


def outlier_pairs(residual: np.ndarray) -> np.ndarray:
    """(n,) bool: pairs whose residual (n, 6) exceeds OUTLIER_SIGMAS robust standard deviations. None if there are more
    than MAX_OUTLIER_SHARE, as the robust scale is unreliable then."""
    far = np.sqrt(_squared_lengths(residual, _scales(residual)).max(axis=1)) > OUTLIER_SIGMAS
    return far & (far.sum() <= MAX_OUTLIER_SHARE * len(far))


def _start_rotations(motions: RelativeMotions) -> list[np.ndarray]:
    """Candidates of R_body_sensor, from which Gauss-Newton starts."""
    by_turns = _robust_kabsch(motions.turn_body, motions.turn_sensor)
    candidates = [by_turns, _robust_kabsch(motions.displacement_body, motions.displacement_sensor)]
    _, spread, axes = np.linalg.svd(motions.turn_sensor, full_matrices=False)
    if spread[1] < SINGLE_AXIS_TURN_RATIO * spread[0]:
        angles = 2.0 * np.pi * np.arange(1, HAND_EYE_CANDIDATES) / HAND_EYE_CANDIDATES
        candidates += [by_turns @ turn for turn in so3.exp_many(angles[:, None] * axes[0])]
    return candidates


def _robust_kabsch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """R (3, 3) with a = R b for vectors a, b (m, 3), by Kabsch's method. Pairs of different lengths get Cauchy's
    weights."""
    unlike = np.abs(np.linalg.norm(a, axis=1) - np.linalg.norm(b, axis=1))
    weight = 1.0 / (1.0 + (unlike / max(CAUCHY_WIDTH_SIGMAS * np.median(unlike), MIN_RESIDUAL_SCALE)) ** 2)
    return so3.closest_rotation((a * weight[:, None]).T @ b)


def _gauss_newton(pairs: PosePairs, start: Extrinsics, fixed: tuple[bool, bool]) -> HandEye:
    """Robust Gauss-Newton from `start`. The frame starts at the value that fits it."""
    extrinsics, frame = start, _mean_frame(pairs, start)
    free = np.repeat([not fixed[0], not fixed[1], True, True], 3)
    prior = np.repeat([1.0 / EXTRINSICS_PRIOR_RAD, 1.0 / EXTRINSICS_PRIOR_M], 3)
    residual = np.zeros((len(pairs.p_body), 6))
    for _ in range(MAX_HAND_EYE_ITERATIONS):
        R, p = pairs.R_body @ extrinsics.R, pairs.p_body + pairs.R_body @ extrinsics.p
        rows = absolute_residuals(R, p, frame, pairs.R_sensor, pairs.p_sensor)
        residual, scales = rows.residual, _scales(rows.residual)
        weight = 1.0 / (1.0 + _squared_lengths(residual, scales).sum(axis=1) / (2.0 * 3.0 * CAUCHY_WIDTH_SIGMAS**2))
        root = np.sqrt(weight)[:, None] / np.repeat(scales, 3)
        (J_pose,) = rows.J_pose
        J_arm = J_pose[:, :, 3:] @ extrinsics.R.T
        J = np.concatenate([J_pose[:, :, :3], J_arm, rows.J_frame], axis=2) * root[:, :, None]
        away = np.concatenate([so3.log(np.ascontiguousarray(start.R.T @ extrinsics.R)), extrinsics.p - start.p])
        A = np.concatenate([J.reshape(-1, 12), np.eye(6, 12) * prior[:, None]])[:, free]
        b = np.concatenate([(residual * root).ravel(), prior * away])
        d = np.zeros(12)
        d[free] = -np.linalg.lstsq(A, b, rcond=None)[0]
        d *= min(1.0, MAX_HAND_EYE_STEP_RAD / max(np.linalg.norm(d[:3]), np.linalg.norm(d[6:9]), MIN_RESIDUAL_SCALE))
        extrinsics = Extrinsics(extrinsics.R @ so3.exp(d[:3].copy()), extrinsics.p + d[3:6])
        frame = Frame(frame.R @ so3.exp(d[6:9].copy()), frame.p + d[9:])
        if np.abs(d).max() < HAND_EYE_STEP_TOLERANCE:
            break
    return HandEye(extrinsics, frame, residual)


def _mean_frame(pairs: PosePairs, extrinsics: Extrinsics) -> Frame:
    """T_world_frame by the extrinsics: mean rotation and median translation over the pairs."""
    R = so3.closest_rotation((pairs.R_body @ extrinsics.R @ pairs.R_sensor.transpose(0, 2, 1)).sum(axis=0))
    return Frame(R, np.median(pairs.p_body + pairs.R_body @ extrinsics.p - pairs.p_sensor @ R.T, axis=0))


def _scales(residual: np.ndarray) -> np.ndarray:
    """(2,) robust standard deviations of a component of rotation [rad] and position [m], from medians of residuals
    (n, 6), corrected for the twelve estimated parameters."""
    n = len(residual)
    spent = np.sqrt(6.0 * n / max(6.0 * n - 12.0, 1.0))
    sizes = [_median_norm(residual[:, k : k + 3]) for k in (0, 3)]
    return np.maximum(spent * np.array(sizes) / MEDIAN_NORM, MIN_RESIDUAL_SCALE)


def _squared_lengths(residual: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """(n, 2) squared lengths of rotation and position residuals (n, 6), over the variances `scales` squared."""
    return (residual.reshape(-1, 2, 3) ** 2).sum(axis=2) / scales**2


def _cost(residual: np.ndarray) -> float:
    """The logarithm of the product of both scales: rotation and position count alike, whatever their units."""
    return float(np.log(_scales(residual)).sum())


def _median_norm(vectors: np.ndarray) -> float:
    """Median length of vectors (n, 3)."""
    return float(np.median(np.linalg.norm(vectors, axis=1)))


# Gravity, lever arm and accelerometer bias, linear in a camera's positions and the accelerometer's readings.
#
# With the operator A[x] = (x_2 - x_1) / h_2 - (x_1 - x_0) / h_1 over three images at intervals h_1, h_2,
#
#     A[p_board_cam] = A[R_board_imu] p_imu_cam + A[D_f] - A[D_R] b_a + g (h_1 + h_2) / 2
#
# D_f and D_R are the double integrals over time of R_board_imu f and of R_board_imu, with specific force f,
# accelerometer bias b_a, and gravity g in board axes. A is a difference of mean velocities, so velocities cancel.

TRIPLE_STEP_S = 0.12  # s between images of a triple: long against pose noise, short against the loss of the target
READINGS_PER_BLOCK = 8192  # IMU readings whose rotations are computed at once: bounds the memory
ACCEL_BIAS_PRIOR_M_S2 = 0.3  # m/s^2: prior standard deviation
# Factor on the standard deviation of a row: rows share images, so their errors are correlated
SHARED_IMAGE_FACTOR = 2.0
MIN_ROW_SIGMA_M_S = 0.05  # m/s: floor of the standard deviation of a row
TARGET_GRAVITY_TOLERANCE = 0.1  # relative error of gravity: more means wrong units or a wrong target size
# The same for gravity and size, if the camera's rotation is a guess that may be degrees off
GUESSED_ROTATION_TOLERANCE = 0.5
MAX_UNEXPLAINED_ACCELERATION = 1.2  # median residual over median acceleration
TARGET_SIZE_TOLERANCE = 0.15  # relative error of the target's size


class Triples(NamedTuple):
    """Indices (n,) of the instants i < j < k of each triple, and the intervals h1, h2 (n,) s between them."""

    i: np.ndarray
    j: np.ndarray
    k: np.ndarray
    h1: np.ndarray
    h2: np.ndarray

    @classmethod
    def at(cls, t: np.ndarray, i: np.ndarray, j: np.ndarray, k: np.ndarray) -> Triples:
        """Triples of the instants i, j, k (n,) among increasing times t (N,) s."""
        return cls(i, j, k, t[j] - t[i], t[k] - t[j])

    def some(self, chosen: np.ndarray) -> Triples:
        """The triples selected by `chosen`, a mask or indices (n,)."""
        return Triples(*(x[chosen] for x in self))

    def second(self, x: np.ndarray) -> np.ndarray:
        """A[x] (n, ...) of x (N, ...) at the instants: difference of its mean slopes, see the module's equation."""
        flat, h1, h2 = x.reshape(len(x), -1), self.h1[:, None], self.h2[:, None]
        differences = (flat[self.k] - flat[self.j]) / h2 - (flat[self.j] - flat[self.i]) / h1
        return differences.reshape(-1, *x.shape[1:])

    @property
    def half(self) -> np.ndarray:
        """(n,) (h_1 + h_2) / 2 [s], which is A[t^2 / 2]."""
        return 0.5 * (self.h1 + self.h2)


@dataclass(frozen=True)
class LeverArm:
    """position: p_imu_cam (3,) m, with covariance (3, 3); gravity (3,) m/s^2 in board axes; accel_bias (3,) m/s^2;
    size: true size of the target over the stated one, with standard deviation size_std; unexplained: median residual
    over the median acceleration that the camera shows."""

    position: np.ndarray
    covariance: np.ndarray
    gravity: np.ndarray
    accel_bias: np.ndarray
    size: float
    size_std: float
    unexplained: float

    @property
    def contradicts_camera(self) -> bool:
        """Whether the accelerometer measured another motion than the camera. Noise alone leaves an unexplained share of
        1."""
        return self.unexplained > MAX_UNEXPLAINED_ACCELERATION


def solve_camera_lever_arm(
    imu: ImuData,
    times: np.ndarray,
    R_board_imu: np.ndarray,
    p_board_cam: np.ndarray,
    gyro: GyroRotation,
    known: np.ndarray | None,
) -> LeverArm:
    """Solves for one camera, from rotations R_board_imu (M, 3, 3) and positions p_board_cam (M, 3) m at `times` (M,) s
    on the IMU's clock. known: p_imu_cam (3,) m if it is known. Raises EstimationError if too few images can be used."""
    used = (times >= imu.seconds[1]) & (times <= imu.seconds[-2])
    t, p = times[used], p_board_cam[used]
    # Errors of rotation and position of one image are correlated. Without smoothing, these errors bias the lever arm
    # towards the target.
    R_bi = gyro.smoothed(t, R_board_imu[used])
    D_f, D_R = _double_integrals(imu, t, R_bi, gyro)
    triples = _image_triples(t, imu.gaps)
    n, second = len(triples.i), triples.second
    if n < 10:
        raise EstimationError("too few images are close enough in time to estimate gravity; record for longer.")
    rows = np.zeros((n, 3, 9))
    rows[:, :, 0:3] = second(R_bi)
    rows[:, :, 3:6] = triples.half[:, None, None] * np.eye(3)
    rows[:, :, 6:9] = -second(D_R)
    rhs = second(p) - second(D_f)
    if known is not None:
        rhs = rhs - rows[:, :, 0:3] @ known
        rows[:, :, 0:3] = 0.0
    x, covariance = _solve(rows, rhs)
    arm, unexplained = x[0:3] if known is None else known, _median_ratio(rhs - rows @ x, second(p))
    return LeverArm(arm, covariance, x[3:6], x[6:9], *scale_by_accelerometer(rows, rhs, second(D_f)), unexplained)


def _median_ratio(a: np.ndarray, b: np.ndarray) -> float:
    """Median length of vectors `a` (n, 3) over that of `b` (m, 3)."""
    size = [float(np.median(np.linalg.norm(x, axis=1))) for x in (a, b)]
    return size[0] / max(size[1], 1e-12)


def _solve(rows: np.ndarray, rhs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least squares for x (9,): lever arm, gravity, bias, with a weak prior on lever arm and bias. Repeated without
    outliers. Returns x and the covariance (3, 3) of the lever arm."""
    prior = np.diag(1.0 / np.array([1.0] * 3 + [1e3] * 3 + [ACCEL_BIAS_PRIOR_M_S2] * 3))
    weight, sigma, x, A = np.ones(len(rows)), MIN_ROW_SIGMA_M_S, np.zeros(9), np.zeros((0, 9))
    for _ in range(4):
        A = np.concatenate([(rows * weight[:, None, None]).reshape(-1, 9), sigma * prior])
        b = np.concatenate([(rhs * weight[:, None]).ravel(), np.zeros(9)])
        x = np.linalg.lstsq(A, b, rcond=None)[0]
        size = np.linalg.norm(rhs - rows @ x, axis=1)
        weight = (size < 4.0 * np.median(size) + 1e-9).astype(float)
        sigma = max(MIN_ROW_SIGMA_M_S, SHARED_IMAGE_FACTOR * float(np.median(size)))
    return x, sigma**2 * np.linalg.inv(A.T @ A)[:3, :3]


def scale_by_accelerometer(rows: np.ndarray, rhs: np.ndarray, force_rows: np.ndarray) -> tuple[float, float]:
    """True size of the target, or of a trajectory, over the stated one, and its standard deviation.

    It is the inverse of an estimated factor on the accelerometer's part of the equations. A factor on the noisy
    positions would be biased towards zero. rows (n, 3, m), rhs (n, 3): of the linear system; force_rows (n, 3): the
    accelerometer's part of rhs.
    """
    A = np.concatenate([rows, force_rows[:, :, None]], axis=2).reshape(force_rows.size, -1)
    b = rhs.ravel()
    information = A.T @ A + 1e-9 * np.eye(A.shape[1])
    x = np.linalg.solve(information, A.T @ b)
    variance = np.mean((b - A @ x) ** 2)
    factor = max(1.0 + float(x[-1]), 1e-3)
    return 1.0 / factor, float(np.sqrt(variance * np.linalg.inv(information)[-1, -1])) / factor**2


def _image_triples(t: np.ndarray, gaps: tuple[tuple[float, float], ...]) -> Triples:
    """Triples of images about TRIPLE_STEP_S apart, within a factor of two, or of neighbours if most are further apart.
    None spans a gap of the IMU."""
    i = np.arange(len(t))
    j = np.searchsorted(t, t + TRIPLE_STEP_S - 1e-3)
    k = np.searchsorted(t, t + 2 * TRIPLE_STEP_S - 1e-3)
    longest, usual = 2 * TRIPLE_STEP_S, float(np.median(np.diff(t))) if len(t) > 1 else 0.0
    if usual > TRIPLE_STEP_S:
        k, longest = np.maximum(k, j + 1), max(longest, MAX_USUAL_STEPS * usual)
    good = (k < len(t)) & (j < k) & (i < j)
    i, j, k = i[good], j[good], k[good]
    close = (t[j] - t[i] < longest) & (t[k] - t[j] < longest)
    close &= clear_of(gaps, t[i], t[k])
    return Triples.at(t, i[close], j[close], k[close])


def _double_integrals(
    imu: ImuData, t: np.ndarray, R_bi: np.ndarray, gyro: GyroRotation
) -> tuple[np.ndarray, np.ndarray]:
    """Double integrals of R_board_imu f (n, 3) and of R_board_imu (n, 3, 3) at image times t (n,) s, from the first
    stamp of the IMU."""
    s, x = imu.seconds, np.empty((12, len(imu.seconds)))
    for a in range(0, len(s), READINGS_PER_BLOCK):
        block = slice(a, min(a + READINGS_PER_BLOCK, len(s)))
        R = gyro.carry(t, R_bi, s[block])
        x[:3, block] = (R @ imu.accel[block, :, None])[:, :, 0].T
        x[3:, block] = R.reshape(-1, 9).T
    j = imu.interval(t)
    out = np.stack([_double_integral(s, row, t, j) for row in x], axis=1)
    return out[:, :3], out[:, 3:].reshape(-1, 3, 3)


def _double_integral(s: np.ndarray, x: np.ndarray, t: np.ndarray, j: np.ndarray) -> np.ndarray:
    """(n,) at times t, in intervals j, of x (N,), linear between times s (N,)."""
    dt = np.diff(s)
    once = once_integrated(x, dt)
    twice = twice_integrated(x, once, dt)
    tau = t - s[j]
    return twice[j] + once[j] * tau + 0.5 * x[j] * tau**2


def check_target_size(arm: LeverArm, camera: str, guessed: bool) -> None:
    """Raises EstimationError if the accelerometer contradicts the stated size of the target. guessed: whether the
    camera's rotation is a guess, whose error also changes the size."""
    if abs(arm.size - 1.0) > max(GUESSED_ROTATION_TOLERANCE if guessed else TARGET_SIZE_TOLERANCE, 5.0 * arm.size_std):
        raise EstimationError(
            f"{camera}: the accelerometer shows the target to be {arm.size:.2f} +- {arm.size_std:.2f} times as "
            "large as in the rig file; check tag_size or square_size (in metres) and tag_spacing (gap over "
            "tag_size)."
        )


def check_gravity(measured: float, expected: float, imu: str, guessed: bool) -> None:
    """Raises EstimationError if the `measured` gravity is not `expected` [m/s^2]. guessed: see `check_target_size`."""
    if abs(measured / expected - 1.0) <= (GUESSED_ROTATION_TOLERANCE if guessed else TARGET_GRAVITY_TOLERANCE):
        return
    raise EstimationError(
        f"{imu} and the target together give a gravity of {measured:.3g} m/s^2 instead of {expected:.3g}; "
        "check that the accelerometer is in m/s^2 (not in g: accel_unit), and tag_size or square_size in the "
        "rig file."
    )


# Time offset between a sensor and the IMU, by regression of the gyroscope on the sensor's angular rates.
#
#     w_imu = M w_sensor + b
#
# M (3, 3) is free, so neither the rotation between both sensors nor the scale of the rates must be known; b absorbs
# the gyroscope's bias. The offset is the shift with the largest logarithm of the likelihood ratio, -n/2 log(1 - R^2).
#
# Mean angular rate of an IMU over the intervals between images or poses.

# Logarithm of the likelihood ratio above which a match is significant. Without a match, twice the score is chi^2 with
# nine degrees of freedom, for 3 x 3 coefficients; it exceeds 30 at a given shift with a probability of 4e-4.
MIN_REGRESSION_SCORE = 15.0
MIN_RATE_TO_NOISE = 3.0  # variation of rates over their noise: below, a match may not be significant
GRID_POINTS_PER_INTERVAL = 10  # offsets are found to a twentieth of an interval
# Share of the mean square rate that is added about each axis: without it, rotation about one axis is singular
REGULARISING_SPREAD = 1e-3


@dataclass(frozen=True)
class Regression:
    """offset: t_imu - t_sensor [s], both since their clocks' first stamps; score: logarithm of the likelihood ratio,
    where the number of samples is that of non-overlapping intervals."""

    offset: float
    score: float


def best_regressions(imu: ImuData, rates: SensorRates) -> list[Regression]:
    """Regressions at the best shifts, the best first; empty if the recordings overlap at none. Samples in gaps are left
    out."""
    length = float(np.median(rates.end - rates.start))
    step = length / GRID_POINTS_PER_INTERVAL
    middle = 0.5 * (rates.start + rates.end)
    sensor, sensor_mask = _on_grid(middle - middle[0], rates.rate, np.diff(middle) < rates.longest_step_s, step)
    start = np.arange(0.0, imu.seconds[-1] - length, step)
    gyro, gyro_mask = MeanRates.of(imu).over(start, start + length), clear_of(imu.gaps, start, start + length)
    if not gyro_mask.any() or not sensor_mask.any():
        return []
    explained, count = _explained_share(gyro, gyro_mask, sensor, sensor_mask)
    enough = count > min(MIN_RATE_OVERLAP_S / step, 0.5 * min(gyro_mask.sum(), sensor_mask.sum()))
    score = np.where(
        enough, -0.5 * count / GRID_POINTS_PER_INTERVAL * np.log(1.0 - np.minimum(explained, 1.0 - 1e-9)), -np.inf
    )
    peaks: list[Regression] = []
    apart = round(MIN_PEAK_DISTANCE_S / step)
    while len(peaks) < MAX_OFFSET_PEAKS and np.isfinite(score).any():
        k = int(np.argmax(score))
        peaks.append(Regression((k - (len(sensor) - 1)) * step + 0.5 * length - float(middle[0]), float(score[k])))
        score[max(k - apart, 0) : k + apart + 1] = -np.inf
    return peaks


def rate_difference_noise(imu: ImuData, rates: SensorRates, averaged: float = 0.0) -> float:
    """Standard deviation [rad/s] of the difference between sensor and gyroscope rates about each axis, for means over
    `averaged` s if that is longer than an interval. Zero if the noise of the sensor's rates is unknown."""
    if not rates.noise:
        return 0.0
    length = float(np.median(rates.end - rates.start))
    variance = rates.noise**2 + float(np.median(imu.variance[:, 0])) / length
    return float(np.sqrt(variance * min(1.0, length / averaged if averaged else 1.0)))


def no_match_error(imu: ImuData, name: str, rates: SensorRates) -> EstimationError:
    """The error if no shift gives a significant regression: the rig turns too slowly, or the recordings differ."""
    length = float(np.median(rates.end - rates.start))
    start = np.arange(0.0, imu.seconds[-1] - length, length / GRID_POINTS_PER_INTERVAL)
    gyro = MeanRates.of(imu).over(start, start + length)
    variation = float(np.median(np.linalg.norm(gyro - np.median(gyro, axis=0), axis=1))) / MEDIAN_NORM
    if variation < MIN_RATE_TO_NOISE * rate_difference_noise(imu, rates):
        return EstimationError(
            f"{imu.name} and {name} turn too slowly or too steadily for a time offset: the angular rate varies "
            f"by {np.rad2deg(variation):.2g} deg/s, and the images show it to {np.rad2deg(rates.noise):.2g} "
            "deg/s. Turn the rig faster, back and forth about all axes, or give rotation and time_offset in "
            "the rig file."
        )
    return EstimationError(
        f"the motion of {name} does not match that of {imu.name} at any time offset; check that both come "
        "from the same recording and overlap in time."
    )


def _on_grid(t: np.ndarray, rate: np.ndarray, near: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Rates (n, 3) at increasing t (n,), interpolated on a grid of `step` s from 0; and a mask: between neighbours
    whose step is `near` (n - 1,)."""
    grid = np.arange(int(t[-1] / step) + 1) * step
    mask = near[np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(near) - 1)]
    return np.stack([np.interp(grid, t, rate[:, k]) for k in range(3)], axis=1), mask


def _explained_share(
    a: np.ndarray, mask_a: np.ndarray, b: np.ndarray, mask_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """R^2 of the regression of a (n, 3) on b (m, 3), at shifts of b by -(m - 1) to n - 1 samples, and the number of
    samples that are known in both; each (n + m - 1,). By FFT, as in masked cross-correlation."""
    n = len(a) + len(b) - 1
    size = 1 << (n - 1).bit_length()

    def transformed(x: np.ndarray) -> np.ndarray:
        return np.fft.rfft(x, size, axis=0)

    def correlated(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        product = np.fft.irfft(x * np.conj(y), size)
        return np.concatenate([product[size - (len(b) - 1) :], product[: len(a)]])

    a, b = a * mask_a[:, None], b * mask_b[:, None]
    ma, mb, fa, fb = (transformed(x) for x in (mask_a.astype(float), mask_b.astype(float), a, b))
    count = np.maximum(correlated(ma, mb), 1e-9)
    sa, sb = (
        np.stack([correlated(*p) for p in pairs], axis=1)
        for pairs in ([(fa[:, k], mb) for k in range(3)], [(ma, fb[:, k]) for k in range(3)])
    )
    cross_covariance, auto_covariance = np.empty((n, 3, 3)), np.empty((n, 3, 3))
    for i in range(3):
        for j in range(3):
            cross_covariance[:, i, j] = correlated(fa[:, i], fb[:, j]) - sa[:, i] * sb[:, j] / count
            auto_covariance[:, i, j] = correlated(ma, transformed(b[:, i] * b[:, j])) - sb[:, i] * sb[:, j] / count
    spread = correlated(transformed((a**2).sum(axis=1)), mb) - (sa**2).sum(axis=1) / count
    least = REGULARISING_SPREAD * count * float((b**2).sum(axis=1).mean()) + 1e-12
    slope = np.linalg.solve(auto_covariance + least[:, None, None] * np.eye(3), cross_covariance.transpose(0, 2, 1))
    spread = spread + REGULARISING_SPREAD * count * float((a**2).sum(axis=1).mean()) + 1e-12
    return np.clip(np.einsum("nij,nji->n", cross_covariance, slope) / spread, 0.0, 1.0), count


@dataclass(frozen=True)
class MeanRates:
    """Means of the gyroscope's readings. angle (N, 3) rad: their integral from the first stamp to each."""

    imu: ImuData
    angle: np.ndarray

    @classmethod
    def of(cls, imu: ImuData) -> MeanRates:
        """Integrates the readings of `imu` by the trapezoidal rule."""
        return cls(imu, once_integrated(imu.gyro, np.diff(imu.seconds)))

    def over(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Mean rates (n, 3) rad/s over intervals from start to end (n,), in s on the IMU's clock."""
        t = self.imu.seconds
        return (interpolated(t, self.angle, end) - interpolated(t, self.angle, start)) / (end - start)[:, None]

    def slope(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Derivatives (n, 3) rad/s^2 of the mean rates by a common shift of start and end."""
        t, gyro = self.imu.seconds, self.imu.gyro
        return (interpolated(t, gyro, end) - interpolated(t, gyro, start)) / (end - start)[:, None]
