"""Mean angular rates of noisy rotations, over windows so long that noise is a small part of the rates.

A smooth trajectory through noisy poses: local quadratic regression of rotation and position (Savitzky-Golay smoothing
for uneven stamps).

Where a sensor was at rest: what it measures hardly changes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from icalib.base.compiled import njit
from icalib.data.stamps import STREAM_S
from icalib.geometry import so3
from icalib.geometry.small import MEDIAN_NORM, tmul3
from icalib.motion.imu_data import SAME_INSTANT_S

MAX_RATE_NOISE_SHARE = 0.15  # noise over variation of the rates: with more, rates of two sensors hardly correlate
WINDOW_FACTORS = (1.5, 2.5, 4.0, 6.0)  # longer windows, in units of the shortest: 0.15 to 0.6 s for poses
MAX_WINDOW_STRETCH = 2.5  # actual length over nominal length of a window: more spans a gap
THIRD_DIFFERENCE_SIGMA = np.sqrt(20.0)  # standard deviation of x_3 - 3 x_2 + 3 x_1 - x_0, for white x of variance 1


def rotation_noise(rotation: np.ndarray) -> float:
    """Standard deviation [rad] of white noise about each axis of rotations (n, 3, 3). It uses third differences, in
    which smooth motion cancels, and their median, which is robust to outliers."""
    if len(rotation) < 4:
        return 0.0
    turn = so3.log_many(np.ascontiguousarray(rotation[:-1].transpose(0, 2, 1) @ rotation[1:]))
    third = turn[2:] - 2.0 * turn[1:-1] + turn[:-2]
    return float(np.median(np.linalg.norm(third, axis=1))) / (MEDIAN_NORM * THIRD_DIFFERENCE_SIGMA)


def rate_window(seconds: np.ndarray, rotation: np.ndarray, shortest: float, longest_step: float) -> float:
    """The shortest window [s] over which the noise of the rates is below MAX_RATE_NOISE_SHARE of their variation. If
    there is none, the window with the smallest share.

    rotation (n, 3, 3) at seconds (n,); shortest: the first window that is tried [s]; longest_step: see `window_rates`.
    """
    noise, shares = rotation_noise(rotation), []
    windows = [shortest, *(shortest * k for k in WINDOW_FACTORS)]
    for window in windows:
        _, _, rate = window_rates(seconds, rotation, window, longest_step)
        if len(rate) < 2:
            break
        error = np.sqrt(2.0 * 3.0) * noise / window
        varies = float(np.mean(((rate - rate.mean(axis=0)) ** 2).sum(axis=1)))
        shares.append(error / np.sqrt(max(varies - error**2, (0.1 * error) ** 2, 1e-12)))
        if shares[-1] < MAX_RATE_NOISE_SHARE:
            break
    return windows[int(np.argmin(shares))] if shares else shortest


def window_rates(
    seconds: np.ndarray, rotation: np.ndarray, window: float, longest_step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean rates over windows of about `window` s, one from each pose: indices (m,) of first and last pose, and rates
    (m, 3) rad/s in axes of the first. A window over a step longer than `longest_step` [s] is left out, unless all
    windows are long."""
    a = np.arange(len(seconds))
    b = np.searchsorted(seconds, seconds + window - 1e-9)
    a, b = a[b < len(seconds)], b[b < len(seconds)]
    a, b = pairs_within(seconds, a, b, max(longest_step, MAX_WINDOW_STRETCH * window))
    turn = so3.log_many(np.ascontiguousarray(rotation[a].transpose(0, 2, 1) @ rotation[b]))
    return a, b, turn / (seconds[b] - seconds[a])[:, None]


def pairs_within(seconds: np.ndarray, i: np.ndarray, j: np.ndarray, longest: float) -> tuple[np.ndarray, np.ndarray]:
    """The pairs of instants i, j (n,), indices of increasing `seconds` (N,), that are at most `longest` s apart."""
    near = seconds[j] - seconds[i] <= longest
    return i[near], j[near]


MIN_HALF_WINDOW_S = 0.1  # s: half of the smallest window
MIN_HALF_WINDOW_STEPS = 3.2  # the same in steps between poses: seven poses for three coefficients
MIN_PARABOLA_POSES = 5  # poses that a parabola is fitted to, at least
MAX_HALF_WINDOW_S = 0.6  # s: half of the largest window, for very noisy poses
MIN_THIRD_DERIVATIVE_RAD_S3 = 0.3  # floor of the motion's third derivative: bounds the window of slow motion
SAMPLED_INSTANTS = 400  # instants at which the third derivative is estimated
MEDIAN_CHI2_OF_3 = 2.366  # median of chi^2 with three degrees of freedom


@dataclass(frozen=True)
class SmoothTrajectory:
    """The trajectory at seconds (m,): R_world_body (m, 3, 3), p_world_body (m, 3) m, angular rate (m, 3) rad/s in body
    axes, velocity (m, 3) m/s in world axes, acceleration (m, 3) m/s^2 in body axes. near (m,): whether poses on both
    sides lie within the window. acceleration_variance (m,): of each axis, by the known noise of the positions."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    near: np.ndarray
    acceleration_variance: np.ndarray


@dataclass(frozen=True)
class BodyPoses:
    """Poses of the body in one recording: seconds (n,) since the first stamp of its clock, R_world_body (n, 3, 3),
    p_world_body (n, 3) m. variance (n,): of each axis of the position [m^2] by known noise; None if poses are alike."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    variance: np.ndarray | None = None

    def at(self, seconds: np.ndarray, narrow: bool = False) -> SmoothTrajectory:
        """The smoothed trajectory at `seconds` (m,), see `smooth_trajectory`."""
        return smooth_trajectory(self.seconds, self.rotation, self.position, seconds, narrow, self.variance)


def smooth_trajectory(
    t: np.ndarray,
    R: np.ndarray,
    p: np.ndarray,
    at: np.ndarray,
    narrow: bool = False,
    variance: np.ndarray | None = None,
) -> SmoothTrajectory:
    """Smooths poses R (n, 3, 3), p (n, 3) at increasing t (n,) s, and evaluates them at `at` (m,) s. Needs
    MIN_PARABOLA_POSES poses. narrow: uses the smallest window, which keeps all of the motion and more of the noise.
    variance: see `BodyPoses`."""
    half = _min_half_window(t) if narrow else _half_window(t, R, p)
    first, last = np.searchsorted(t, at - half - SAME_INSTANT_S), np.searchsorted(t, at + half + SAME_INSTANT_S)
    few = last - first < MIN_PARABOLA_POSES
    middle = np.clip(np.searchsorted(t, at) - MIN_PARABOLA_POSES // 2, 0, len(t) - MIN_PARABOLA_POSES)
    first, last = np.where(few, middle, first), np.where(few, middle + MIN_PARABOLA_POSES, last)
    near = ~few & (t[first] <= at) & (t[last - 1] >= at)
    fitted, curvature_variance = np.empty((len(at), 3, 6)), np.empty(len(at))
    reference = np.clip(np.searchsorted(0.5 * (t[1:] + t[:-1]), at), 0, len(t) - 1)
    variance = np.zeros(len(t)) if variance is None else variance
    _parabolas(t, R, p, variance, at, first, last, reference, half, fitted, curvature_variance)
    turn, position = fitted[:, 0, :3], fitted[:, 0, 3:]
    rotation = R[reference] @ so3.exp_many(np.ascontiguousarray(turn))
    acceleration = np.einsum("mji,mj->mi", rotation, fitted[:, 2, 3:])
    rate, velocity = fitted[:, 1, :3], fitted[:, 1, 3:]
    return SmoothTrajectory(at, rotation, position, rate, velocity, acceleration, near, curvature_variance)


def _min_half_window(t: np.ndarray) -> float:
    """Half of the smallest window [s] for poses at t (n,)."""
    return max(MIN_HALF_WINDOW_S, MIN_HALF_WINDOW_STEPS * float(np.median(np.diff(t))))


def _half_window(t: np.ndarray, R: np.ndarray, p: np.ndarray) -> float:
    """Half of the window [s] at which noise and bias of the rate together are smallest. The slope of a parabola over
    +-h has variance 1.5 s^2 dt / h^3 by white noise s, and bias j h^2 / 10 by a third derivative j. Slopes over +-h and
    +-2 h differ by 0.3 j h^2 and noise, which shows j."""
    dt = float(np.median(np.diff(t)))
    least, h = _min_half_window(t), max(2.0 * MIN_HALF_WINDOW_S, MIN_HALF_WINDOW_STEPS * dt)
    at = t[(t > t[0] + 2.0 * h) & (t < t[-1] - 2.0 * h)]
    noise = rotation_noise(R)
    if len(at) < MIN_PARABOLA_POSES or 112.5 * noise**2 * dt < (least**7) * MIN_THIRD_DERIVATIVE_RAD_S3**2:
        return least
    at = at[np.linspace(0, len(at) - 1, min(len(at), SAMPLED_INSTANTS)).astype(int)]
    slopes = []
    for half in (h, 2.0 * h):
        first, last = np.searchsorted(t, at - half - SAME_INSTANT_S), np.searchsorted(t, at + half + SAME_INSTANT_S)
        full = last - first >= MIN_PARABOLA_POSES
        fitted = np.zeros((len(at), 3, 6))
        reference = np.clip(np.searchsorted(t, at), 0, len(t) - 1)
        last = np.where(full, last, first + MIN_PARABOLA_POSES)
        _parabolas(t, R, p, np.zeros(len(t)), at, first, last, reference, half, fitted, np.empty(len(at)))
        slopes.append(np.where(full[:, None], fitted[:, 1, :3], np.nan))
    differ = np.nanmedian(((slopes[1] - slopes[0]) ** 2).sum(axis=1)) / MEDIAN_CHI2_OF_3
    third = np.sqrt(max(differ - 1.3125 * noise**2 * dt / h**3, 0.0)) / (0.3 * h**2)
    best = (112.5 * noise**2 * dt / max(third, MIN_THIRD_DERIVATIVE_RAD_S3) ** 2) ** (1.0 / 7.0)
    return min(max(least, best), max(least, MAX_HALF_WINDOW_S))


@njit(cache=True, nogil=True)
def _parabolas(t, R, p, variance, at, first, last, reference, half, out, curvature_variance):
    """Fits a parabola around each instant at[m], to poses first[m]..last[m]. Fills out (m, 3, 6) with value, slope and
    curvature of rotation vectors relative to R[reference[m]] and of positions. The slope of the rotation is the angular
    rate in body axes. Fills curvature_variance (m,), of the positions, by their variance (n,)."""
    row, y = np.empty(3), np.empty(6)
    for m in range(len(at)):
        A, V, b = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 7))
        b[2, 6] = 1.0  # the last column of x is row 2 of the inverse of A, the curvature's
        R0 = R[reference[m]]
        for i in range(first[m], last[m]):
            u = (t[i] - at[m]) / half
            row[0], row[1], row[2] = 1.0, u, 0.5 * u * u
            turn = so3.log(tmul3(R0, R[i]))
            for k in range(3):
                y[k], y[3 + k] = turn[k], p[i, k]
            for a in range(3):
                for c in range(3):
                    A[a, c] += row[a] * row[c]
                    V[a, c] += variance[i] * row[a] * row[c]
                for c in range(6):
                    b[a, c] += row[a] * y[c]
        x = np.linalg.solve(A, b)
        curvature_variance[m] = 0.0
        for a in range(3):
            for c in range(3):
                curvature_variance[m] += x[a, 6] * V[a, c] * x[c, 6] / half**4
        for c in range(6):
            out[m, 0, c], out[m, 1, c], out[m, 2, c] = x[0, c], x[1, c] / half, x[2, c] / (half * half)
        J = so3.right_jacobian(out[m, 0, :3])
        for a in range(3):
            row[a] = J[a, 0] * out[m, 1, 0] + J[a, 1] * out[m, 1, 1] + J[a, 2] * out[m, 1, 2]
        for a in range(3):
            out[m, 1, a] = row[a]


# Rest: measurements of a sensor just before and after an instant are nearly equal.

MAX_CLOCK_OFFSET_S = 0.2  # largest clock offset; a sensor must be at rest this long before and after an instant
MAX_REST_GAP_S = 2.0  # longest gap between the two measurements that decide whether a sensor is at rest
MAX_REST_MOTION = 0.03  # largest motion between these, as a share of the median motion between random measurements
N_MOTION_SAMPLES = 500  # pairs of random measurements
QUIET_SHARE = 0.1  # of the steps between measurements: the quietest show noise alone if the sensor ever was at rest
# largest motion between measurements at rest over that of the quietest. At 4 Hz and more, a sensor that never rests
# moves by twice that of its quietest steps from MAX_CLOCK_OFFSET_S before to after; noise of 100 values varies by 10 %.
QUIET_RATIO = 1.5
Differ = Callable[[np.ndarray, np.ndarray], np.ndarray]  # motion (n,) between measurements of indices a, b (n,)


def rest_motion(count: int, differ: Differ) -> float:
    """The largest motion that counts as rest, as MAX_REST_MOTION says, among so many measurements."""
    return MAX_REST_MOTION * _quantile(0.5, differ(*np.random.default_rng(0).integers(0, count, (2, N_MOTION_SAMPLES))))


def quiet_motion(count: int, differ: Differ) -> float:
    """The largest difference by noise alone between measurements, as QUIET_RATIO says, among so many."""
    return QUIET_RATIO * _quantile(QUIET_SHARE, differ(np.arange(count - 1), np.arange(1, count)))


def _quantile(share: float, x: np.ndarray) -> float:
    """The quantile of the finite values of x (n,); 0 without any."""
    known = x[np.isfinite(x)]
    return float(np.quantile(known, share)) if len(known) else 0.0


def is_at_rest(seconds: np.ndarray, at: np.ndarray, differ: Differ, limit: float) -> np.ndarray:
    """(n,) whether a sensor with measurements at `seconds` (m,) is at rest at the instants `at` (n,). Its measurements
    just outside +- MAX_CLOCK_OFFSET_S must be at most MAX_REST_GAP_S apart and differ by less than `limit`."""
    last = len(seconds) - 1
    before = np.clip(np.searchsorted(seconds, at - MAX_CLOCK_OFFSET_S, side="right") - 1, 0, last)
    after = np.clip(np.searchsorted(seconds, at + MAX_CLOCK_OFFSET_S), 0, last)
    return (seconds[after] - seconds[before] <= MAX_REST_GAP_S) & (differ(before, after) < limit)


def rests(seconds: np.ndarray, differ: Differ, limit: float) -> np.ndarray:
    """(k, 2) first and last of the measurements of each stop, at rest for twice MAX_CLOCK_OFFSET_S or longer. A stop at
    the place of the stop before is left out."""
    still = np.concatenate([[False], is_at_rest(seconds, seconds, differ, limit), [False]])
    first, last = np.flatnonzero(still[1:] & ~still[:-1]), np.flatnonzero(still[:-1] & ~still[1:]) - 1
    long = seconds[last] - seconds[first] >= 2.0 * MAX_CLOCK_OFFSET_S
    kept: list[tuple[int, int]] = []
    for a, b in zip(first[long].tolist(), last[long].tolist(), strict=True):
        if not kept or differ(np.array([sum(kept[-1]) // 2]), np.array([(a + b) // 2]))[0] >= limit:
            kept.append((a, b))
    return np.array(kept, dtype=np.int64).reshape(-1, 2)


def follow_closely(stamps_ns: np.ndarray) -> bool:
    """Whether measurements at stamps (n,) follow one another so closely that they show a motion."""
    return len(stamps_ns) > 1 and bool(np.median(np.diff(stamps_ns)) <= 1e9 * STREAM_S)


def common_stops(views: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """(k, 2) first and last stamp [ns] of each stop in the views of sensors: stamps_ns (n,), and what moves in them
    (n, m, dim), NaN where it is unseen. Stops in several views are what these have in common."""
    spans, out = [], []
    for stamps_ns, x in views:
        if follow_closely(stamps_ns):
            differ, seconds = changes(x), 1e-9 * (stamps_ns - stamps_ns[0])
            limit = rest_motion(len(x), differ) + quiet_motion(len(x), differ)
            spans += stamps_ns[rests(seconds, differ, limit)].tolist()
    for first, last in sorted(spans):
        if out and first <= out[-1][1]:
            out[-1] = [first, min(last, out[-1][1])]
        else:
            out.append([first, last])
    return np.array(out, dtype=np.int64).reshape(-1, 2)


def changes(x: np.ndarray) -> Differ:
    """Differences of measurements x (n, m, dim): the median over m of the distance; infinite if none is in both."""

    def change(i: int, j: int) -> float:
        apart = np.linalg.norm(x[i] - x[j], axis=1)
        known = apart[np.isfinite(apart)]
        return float(np.median(known)) if len(known) else np.inf

    return lambda a, b: np.array([change(i, j) for i, j in zip(a.tolist(), b.tolist(), strict=True)])
