"""Attitude, biases, lever arm and time offset from second differences of fixes, by Gauss-Newton over a window.

Second differences of positions over triples of fixes, and of the motion by the IMU's readings.

With p'' = R_world_imu f - g z and the operator A[x] = (x_k - x_j) / h_2 - (x_j - x_i) / h_1 over fixes i, j, k,

    A[p_fix] = R_wg (A[D_f] - A[D_R] b_a) + R_wg A[R_gi] p_imu_sensor - g z (h_1 + h_2) / 2

where g is the IMU's frame at a reference instant, R_gi the gyroscope's rotation from there, D_f and D_R the double
integrals of R_gi f and R_gi. Velocity and origin cancel. The world is the frame of the fixes, which is levelled.

Candidate time offsets by cross-correlation of the norms of third differences of position, from fixes and from IMU.

Third differences over equal steps contain neither gravity nor velocity, and their norms do not depend on the attitude.
The IMU's readings give them by integrating rotations over three steps only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from icalib.geometry import so3
from icalib.geometry.small import once_integrated, twice_integrated
from icalib.initialize.lever_arm import Triples
from icalib.initialize.rate_correlation import CorrelationPeak, best_shifts
from icalib.motion.imu_data import ImuData, clear_of
from icalib.sensors.position.read import steps

MAX_WINDOW_ROUNDS = 12
# rad, rad/s, m/s^2, m, s: of a Gauss-Newton step. Smaller changes of a start value do not change the estimate.
WINDOW_STEP_TOLERANCE = 1e-5
MAX_TRIPLE_MEDIANS = 4.0  # times the median residual; a triple with a larger one has no weight
OFFSET_DIFFERENCE_S = 0.005  # half a step of central differences by the time offset: one IMU reading at 200 Hz
MIN_WINDOW_TRIPLES = 12  # 36 rows for 13 unknowns
# Prior standard deviations of the unknowns of a window.
GYRO_BIAS_SIGMA_RAD_S = 0.02  # rad/s, of consumer gyroscopes
ACCEL_BIAS_SIGMA_M_S2 = 0.3  # m/s^2
ARM_SIGMA_M = 2.0  # m, of a car's antenna
OFFSET_SIGMA_S = 0.3  # s, about a peak of the correlation
ROTATION_SIGMA_RAD = 10.0  # rad: no prior
N_YAWS = 24  # candidates of the first attitude
MIN_TRIPLE_SIGMA_M_S = 0.05  # m/s, of a second difference of fixes with 2 cm of noise, 1 s apart


@dataclass(frozen=True)
class Fix:
    """Fixes of one recording: t (N,) s on the sensor's clock, position (N, 3) m in its frame; same_clock: the time
    offset [s] if one clock made all stamps."""

    t: np.ndarray
    position: np.ndarray
    same_clock: float = 0.0

    @cached_property
    def run(self) -> np.ndarray:
        """(N,) int: number of the run of each fix. A run ends where the solution steps, so that differences within a
        run contain no step."""
        at, _ = steps(self.t, self.position)
        return np.cumsum(np.bincount(at, minlength=len(self.t)))

    @cached_property
    def noise(self) -> float:
        """Standard deviation of a fix [m], root of the sum over the axes, by the median absolute fourth differences,
        which contain little motion; at least 1 mm. 70: sum of squared binomials; 1.48: ratio of sigma to the median."""
        fourth = np.abs(np.diff(self.position, n=4, axis=0))
        return max(1e-3, float(np.linalg.norm(1.4826 / np.sqrt(70.0) * np.median(fourth, axis=0))))

    @cached_property
    def triples(self) -> Triples:
        """Triples of fixes without a step of the solution between them. They are as far apart as their noise demands:
        velocities change more in a longer time, and noise changes them less."""
        candidates: list[Triples] = []
        for step in TRIPLE_STEPS_S:
            triples = triples_of(self.t, step)
            candidates.append(triples.some(self.run[triples.i] == self.run[triples.k]))
            if len(candidates[-1].i) < MIN_WINDOW_TRIPLES or self.noise_share(candidates[-1]) < MAX_TRIPLE_NOISE:
                break
        return next((x for x in reversed(candidates) if len(x.i) >= MIN_WINDOW_TRIPLES), candidates[0])

    def noise_share(self, triples: Triples) -> float:
        """RMS of the noise in second differences over `triples`, over their RMS."""
        size = np.sqrt((triples.second(self.position) ** 2).sum(axis=1).mean())
        return float(np.sqrt(6.0) * self.noise / np.median(triples.half) / max(size, 1e-9))


@dataclass(frozen=True)
class WindowUnknowns:
    """Unknowns of a window of time. R_wg (3, 3): attitude of the IMU at `reference` s on its clock, in the frame of the
    fixes; gyro_bias (3,) rad/s; accel_bias (3,) m/s^2; arm (3,): lever arm p_imu_sensor [m]; offset: t_imu - t_sensor
    [s]."""

    reference: float
    R_wg: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    arm: np.ndarray
    offset: float

    def moved(self, step: np.ndarray) -> WindowUnknowns:
        """The unknowns after a step (13,) in the order of the fields; the rotation is in world axes, on the left."""
        return replace(
            self,
            R_wg=so3.exp(step[:3]) @ self.R_wg,
            gyro_bias=self.gyro_bias + step[3:6],
            accel_bias=self.accel_bias + step[6:9],
            arm=self.arm + step[9:12],
            offset=self.offset + float(step[12]),
        )

    def minus(self, other: WindowUnknowns) -> np.ndarray:
        """(13,) the step from `other` to these unknowns: other.moved(step) is equal to them."""
        return np.concatenate(
            [
                so3.log(self.R_wg @ other.R_wg.T),
                self.gyro_bias - other.gyro_bias,
                self.accel_bias - other.accel_bias,
                self.arm - other.arm,
                [self.offset - other.offset],
            ]
        )


@dataclass(frozen=True)
class WindowPrior:
    """Gaussian prior of `WindowUnknowns`: mean, and standard deviations sigma (13,) of a step from it."""

    mean: WindowUnknowns
    sigma: np.ndarray


@dataclass(frozen=True)
class WindowFit:
    """Result of `fit_window`. misfit: RMS of the residuals over the RMS of the second differences of the fixes;
    covariance (13, 13) of the unknowns, scaled by the residuals."""

    at: WindowUnknowns
    misfit: float
    covariance: np.ndarray


def sigmas(arm: float = ARM_SIGMA_M, offset: float = OFFSET_SIGMA_S) -> np.ndarray:
    """(13,) prior standard deviations of `WindowUnknowns` for a usual IMU and antenna."""
    groups = (ROTATION_SIGMA_RAD, GYRO_BIAS_SIGMA_RAD_S, ACCEL_BIAS_SIGMA_M_S2, arm)
    return np.append(np.repeat(groups, 3), offset)


def first_unknowns(
    imu: ImuData, fix: Fix, triples: Triples, mean: WindowUnknowns, sigma: np.ndarray, gravity: float
) -> WindowUnknowns:
    """The prior `mean`, of standard deviations sigma (13,), with estimates of attitude, accelerometer bias and lever
    arm. For a known attitude the equations are linear. Candidates are Kabsch's attitude for the lever arm of `mean`,
    and all yaws of the one that levels the specific forces; Kabsch's method refines the best."""
    t = fix.t + mean.offset
    integrated = IntegratedReadings.of(imu, span_of(t, triples), mean.reference, np.zeros(3))
    differences = triples.second(fix.position)
    differences[:, 2] += gravity * triples.half
    doubles, rotation = integrated.doubles_at(t), integrated.rotation_at(t)
    felt = triples.second(doubles[:, :3] + rotation @ mean.arm)
    J = np.concatenate([-triples.second(doubles[:, 3:12]).reshape(-1, 3, 3), triples.second(rotation)], axis=2)
    inverse = np.linalg.inv(np.einsum("nij,nik->jk", J, J) + np.diag((MIN_TRIPLE_SIGMA_M_S / sigma[6:12]) ** 2))

    def fitted(R: np.ndarray) -> tuple[float, np.ndarray]:
        """Sum of squared residuals with the best bias and lever arm, and both (6,)."""
        r = differences @ R - felt
        b = np.einsum("nij,ni->j", J, r)
        return float((r**2).sum() - b @ inverse @ b), inverse @ b

    level = so3.closest_rotation(np.outer([0.0, 0.0, 1.0], felt.sum(axis=0)) + np.diag([1e-6, 1e-6, 0.0]))
    yaws = np.linspace(0.0, 2.0 * np.pi, N_YAWS, endpoint=False)[:, None] * [0.0, 0.0, 1.0]
    candidates = [so3.closest_rotation(differences.T @ felt), *(so3.exp_many(yaws) @ level)]
    _, x = fitted(min(candidates, key=lambda R: fitted(R)[0]))
    R = so3.closest_rotation(differences.T @ (felt + J @ x))
    _, x = fitted(R)
    return replace(mean, R_wg=R, accel_bias=mean.accel_bias + x[:3], arm=mean.arm + x[3:])


def fit_window(
    imu: ImuData,
    fix: Fix,
    triples: Triples,
    start: WindowUnknowns,
    prior: WindowPrior,
    gravity: float,
) -> WindowFit:
    """Robust Gauss-Newton on the second differences over `triples` from `start`. gravity
    [m/s^2]."""
    x, row_sigma, information = start, MIN_TRIPLE_SIGMA_M_S, np.eye(13)
    r, kept = np.zeros((0, 3)), np.zeros(0, dtype=bool)
    for _ in range(MAX_WINDOW_ROUNDS):
        r, J = _rows(imu, fix, triples, x, gravity)
        size = np.linalg.norm(r, axis=1)
        kept = size <= MAX_TRIPLE_MEDIANS * np.median(size)
        row_sigma = max(MIN_TRIPLE_SIGMA_M_S, float(np.median(size)))
        A, b = J[kept].reshape(-1, 13) / row_sigma, r[kept].ravel() / row_sigma
        information = A.T @ A + np.diag(prior.sigma**-2)
        step = np.linalg.solve(information, A.T @ b - x.minus(prior.mean) / prior.sigma**2)
        x = x.moved(step)
        if np.abs(step).max() < WINDOW_STEP_TOLERANCE:
            break
    differences = triples.second(fix.position)[kept]
    misfit = np.sqrt((r[kept] ** 2).sum() / max(float((differences**2).sum()), 1e-9))
    return WindowFit(x, float(misfit), np.linalg.inv(information))


def _rows(imu: ImuData, fix: Fix, triples: Triples, x: WindowUnknowns, gravity: float) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of A[p_fix] (n, 3) m/s, and derivatives (n, 3, 13) of the prediction by `WindowUnknowns`."""
    t = fix.t + x.offset
    integrated = IntegratedReadings.of(imu, span_of(t, triples), x.reference, x.gyro_bias)
    predicted, J = _predicted(integrated, t, triples, x), np.zeros((len(triples.i), 3, 13))
    R, doubles = integrated.rotation_at(t), integrated.doubles_at(t)
    J[:, :, 0:3] = -so3.hat_many(np.ascontiguousarray(predicted))
    J_arm_bias = so3.hat_many(np.ascontiguousarray(R @ x.arm)) @ integrated.rotation_integral_at(t)
    J[:, :, 3:6] = x.R_wg @ (triples.second(doubles[:, 12:]).reshape(-1, 3, 3) + triples.second(J_arm_bias))
    J[:, :, 6:9] = -x.R_wg @ triples.second(doubles[:, 3:12]).reshape(-1, 3, 3)
    J[:, :, 9:12] = x.R_wg @ triples.second(R)
    later, earlier = (_predicted(integrated, t + d, triples, x) for d in (OFFSET_DIFFERENCE_S, -OFFSET_DIFFERENCE_S))
    J[:, :, 12] = (later - earlier) / (2.0 * OFFSET_DIFFERENCE_S)
    r = triples.second(fix.position) - predicted
    r[:, 2] += gravity * triples.half
    return r, J


def _predicted(integrated: IntegratedReadings, t: np.ndarray, triples: Triples, x: WindowUnknowns) -> np.ndarray:
    """(n, 3) m/s, the prediction of A[p_fix] without its gravity term."""
    doubles = integrated.doubles_at(t)
    felt = triples.second(doubles[:, :3] - doubles[:, 3:12].reshape(-1, 3, 3) @ x.accel_bias)
    return (felt + triples.second(integrated.rotation_at(t) @ x.arm)) @ x.R_wg.T


def span_of(t: np.ndarray, triples: Triples) -> tuple[float, float]:
    """First and last instant [s] of the readings that `triples` of fixes at t (N,) s on the IMU's clock need."""
    return float(t[triples.i].min()) - WINDOW_MARGIN_S, float(t[triples.k].max()) + WINDOW_MARGIN_S


# s, between the fixes of a triple. A second difference has 5 cm/s by noise of 2 cm, and about 1 m/s by the motion of a
# walk or a car. A gyroscope drifts by less than a degree meanwhile. Longer ones are for more noise or a slower motion.
TRIPLE_STEPS_S = 1.0, 2.0, 4.0
MAX_TRIPLE_NOISE = 0.25  # noise over size of second differences: with more, the next step is taken
MAX_TRIPLE_STEPS = 1.6  # times the step, or that of slower fixes: beyond it there is a gap
WINDOW_MARGIN_S = 0.2  # s of readings on both sides of the fixes of a window, as the time offset changes in the fit


def triples_of(t: np.ndarray, step: float) -> Triples:
    """All triples of fixes at increasing t (N,) s that are about `step` s apart; of slower fixes, neighbours."""
    usual = float(np.median(np.diff(t))) if len(t) > 1 else step
    step = max(step, usual)
    i = np.arange(len(t))
    j = np.searchsorted(t, t + step - 0.1 * usual)
    k = np.searchsorted(t, t[np.minimum(j, len(t) - 1)] + step - 0.1 * usual)
    good = k < len(t)
    i, j, k = i[good], j[good], k[good]
    near = np.maximum(t[j] - t[i], t[k] - t[j]) < MAX_TRIPLE_STEPS * step
    return Triples.at(t, i[near], j[near], k[near])


def recorded(imu: ImuData, triples: Triples, t: np.ndarray) -> Triples:
    """Those triples of fixes at t (N,) s on the IMU's clock during which the IMU has no gap."""
    begin, end = t[triples.i] - WINDOW_MARGIN_S, t[triples.k] + WINDOW_MARGIN_S
    inside = (begin >= imu.seconds[0]) & (end <= imu.seconds[-1])
    return triples.some(inside & clear_of((*imu.gaps, *imu.seams), begin, end))


@dataclass(frozen=True)
class IntegratedReadings:
    """Integrals of the readings of a window, at their stamps `seconds` (N,).

    rotation (N, 3, 3) R_gi; rate (N - 1, 3) rad/s between stamps; rotation_integral (N, 3, 3) s, of R_gi from the
    reference instant; columns (N, c), first, second: R_gi f, R_gi and hat(R_gi f) rotation_integral, flattened row by
    row, with their integrals and double integrals from the first stamp. With `forces_only` there is only R_gi f."""

    seconds: np.ndarray
    rotation: np.ndarray
    rate: np.ndarray
    rotation_integral: np.ndarray
    columns: np.ndarray
    first: np.ndarray
    second: np.ndarray

    @classmethod
    def of(
        cls, imu: ImuData, span: tuple[float, float], reference: float, bias: np.ndarray, forces_only: bool = False
    ) -> IntegratedReadings:
        """Of the readings within `span` s, corrected by a gyroscope bias (3,) rad/s; reference: instant of g [s]."""
        a, b = (int(k) for k in imu.interval(np.array(span)))
        within = slice(max(a - 1, 0), b + 3)
        s, gyro, accel = imu.seconds[within], imu.gyro[within], imu.accel[within]
        dt = np.diff(s)
        rate = 0.5 * (gyro[1:] + gyro[:-1]) - bias
        R = np.empty((len(s), 3, 3))
        R[0] = np.eye(3)
        so3.chain(so3.exp_many(rate * dt[:, None]), R)
        at = int(np.clip(np.searchsorted(s, reference), 0, len(s) - 1))
        R = np.ascontiguousarray(R[at].T @ R)
        rotation_integral = once_integrated(R.reshape(len(s), 9), dt).reshape(-1, 3, 3)
        rotation_integral -= rotation_integral[at]
        force = np.einsum("nij,nj->ni", R, accel)
        columns = force
        if not forces_only:
            J_bias = so3.hat_many(force) @ rotation_integral
            columns = np.concatenate([force, R.reshape(-1, 9), J_bias.reshape(-1, 9)], axis=1)
        first = once_integrated(columns, dt)
        second = twice_integrated(columns, first, dt)
        return cls(s, R, rate, rotation_integral, columns, first, second)

    def _interval(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        j = np.clip(np.searchsorted(self.seconds, t, side="right") - 1, 0, len(self.seconds) - 2)
        return j, t - self.seconds[j]

    def rotation_at(self, t: np.ndarray) -> np.ndarray:
        """(n, 3, 3) R_gi at t (n,) s."""
        j, tau = self._interval(t)
        return self.rotation[j] @ so3.exp_many(self.rate[j] * tau[:, None])

    def rotation_integral_at(self, t: np.ndarray) -> np.ndarray:
        """(n, 3, 3) s, integrals of R_gi from the reference instant to t (n,) s."""
        j, tau = self._interval(t)
        return self.rotation_integral[j] + self.rotation[j] * tau[:, None, None]

    def doubles_at(self, t: np.ndarray) -> np.ndarray:
        """(n, c) double integrals of `columns` at t (n,) s."""
        j, tau = self._interval(t)
        tau = tau[:, None]
        return self.second[j] + self.first[j] * tau + 0.5 * self.columns[j] * tau**2


SIGNAL_RATE_HZ = 20.0  # of the correlated signals: the offset is found to 50 ms, and refined later
DIFFERENCE_STEP_S = 1.0  # s: with 2 cm of noise a third difference has 9 cm/s^2
MIN_JERK_OVERLAP_S = 10.0  # s: shorter overlaps correlate by chance
MAX_JERK_PEAKS = 6  # candidates
PEAK_SPACING_S = 0.3  # s: closer peaks lead to the same offset once it is refined
MIN_JERK_CORRELATION = 0.3  # of a candidate
MIN_SIGNAL_RANGE = 1e-4  # m/s^2 or m/s: less is rounding
# Third differences of fixes are rejected above this ratio to the largest of the IMU, and above this limit. The ratio
# leaves room for a long lever arm, which adds to them when the rig turns.
MAX_JERK_RATIO, MIN_JERK_LIMIT_M_S2 = 1.5, 5.0


def offsets_by_jerk(imu: ImuData, fix: Fix) -> list[CorrelationPeak]:
    """Candidate offsets t_imu - t_sensor in samples of 1 / SIGNAL_RATE_HZ s, the highest correlation first."""
    fix_signal, fix_known = _of_fixes(fix)
    imu_signal, imu_known = _of_imu(imu)
    fix_known &= fix_signal <= max(MAX_JERK_RATIO * imu_signal.max(initial=0.0), MIN_JERK_LIMIT_M_S2)
    if not (varies(fix_signal, fix_known) and varies(imu_signal, imu_known)):
        return []
    least, apart = MIN_JERK_OVERLAP_S * SIGNAL_RATE_HZ, round(PEAK_SPACING_S * SIGNAL_RATE_HZ)
    return best_shifts((imu_signal, imu_known), (fix_signal, fix_known), least, MAX_JERK_PEAKS, apart)


def varies(signal: np.ndarray, known: np.ndarray) -> bool:
    """Whether a signal (n,), where it is `known` (n,), changes by more than rounding, so that it can be correlated."""
    return bool(known.any()) and float(np.ptp(signal[known])) > MIN_SIGNAL_RANGE


def _of_fixes(fix: Fix) -> tuple[np.ndarray, np.ndarray]:
    """Norms (m,) of third differences of the fixes over DIFFERENCE_STEP_S [m/s^2], at SIGNAL_RATE_HZ from 0 s on; and
    (m,) bool: which of them are known."""
    t = fix.t
    usual = float(np.median(np.diff(t)))
    step = max(DIFFERENCE_STEP_S, usual)
    index = [np.arange(len(t))]
    for _ in range(3):
        index.append(np.searchsorted(t, t[np.minimum(index[-1], len(t) - 1)] + step - 0.1 * usual))
    good = index[3] < len(t)
    i, j, k, m = (x[good] for x in index)
    h1, h2, h3 = (t[b] - t[a] for a, b in ((i, j), (j, k), (k, m)))
    even = (np.max([h1, h2, h3], axis=0) < 1.2 * step) & (fix.run[i] == fix.run[m])
    v1, v2, v3 = ((fix.position[b] - fix.position[a]) / h[:, None] for a, b, h in ((i, j, h1), (j, k, h2), (k, m, h3)))
    third = (v3 - v2) / (0.5 * (h2 + h3))[:, None] - (v2 - v1) / (0.5 * (h1 + h2))[:, None]
    middle = 0.25 * (t[i] + t[j] + t[k] + t[m])
    longest = 1.5 * max(usual, 1.0 / SIGNAL_RATE_HZ)
    return _on_grid(middle[even], np.linalg.norm(third[even], axis=1), float(t[-1]), longest)


def _of_imu(imu: ImuData) -> tuple[np.ndarray, np.ndarray]:
    """As `_of_fixes`, from the readings; known where 3 DIFFERENCE_STEP_S about an instant have no gap."""
    t = imu.seconds
    integrated = IntegratedReadings.of(imu, (float(t[0]), float(t[-1])), 0.0, np.zeros(3), forces_only=True)
    middle = np.arange(0.0, float(t[-1]), 1.0 / SIGNAL_RATE_HZ)
    x = [integrated.doubles_at(middle + at * DIFFERENCE_STEP_S) for at in (-1.5, -0.5, 0.5, 1.5)]
    third = (x[3] - 3.0 * x[2] + 3.0 * x[1] - x[0]) / DIFFERENCE_STEP_S**2
    inside = imu.covers(middle - 1.5 * DIFFERENCE_STEP_S, middle + 1.5 * DIFFERENCE_STEP_S)
    return np.where(inside, np.linalg.norm(third, axis=1), 0.0), inside


def change_of_acceleration(imu: ImuData) -> float:
    """Root of the median square of the third differences over DIFFERENCE_STEP_S [m/s^2], by the readings."""
    third, known = _of_imu(imu)
    return float(np.sqrt(np.median(third[known] ** 2))) if known.any() else 0.0


def _on_grid(t: np.ndarray, x: np.ndarray, end: float, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """x (n,) at t (n,) s, linearly interpolated at SIGNAL_RATE_HZ from 0 to `end` s, and where it is known: between
    samples at most `apart` s from each other."""
    grid = np.arange(int(end * SIGNAL_RATE_HZ) + 1) / SIGNAL_RATE_HZ
    if len(t) < 2:
        return np.zeros(len(grid)), np.zeros(len(grid), dtype=bool)
    after = np.clip(np.searchsorted(t, grid), 1, len(t) - 1)
    known = (grid >= t[0]) & (grid <= t[-1]) & (t[after] - t[after - 1] <= apart)
    return np.interp(grid, t, x), known
