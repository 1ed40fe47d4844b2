"""Initial guess of wheels from a known motion: time offset by correlation, all other parameters by least squares.

Assumption: the z axis of the wheel frame is along `up`; only the estimator solves for roll, pitch and height. In the
horizontal plane the origin of the wheel frame, p_imu_wheel = l_1 e_1 + l_2 e_2, moves along e_1 only. With u (2,) the
horizontal velocity of the IMU, w its rate about `up`, and theta' the rate of a wheel:

    e_2 u + l_1 w = 0                      no lateral slip
    r theta' = e_1 u - (l_2 -+ b/2) w      right, left wheel of a pair; b = 0 for the driven wheel of a steered vehicle
    s_v v' = e_1 u - l_2 w,  s_w w' = w    speed v' and yaw rate w' of a twist
    v sin(d) = L w cos(d)                  front axle; v = r theta', d: steering angle + offset
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.initialize.initializer import MotionContradictedError
from icalib.initialize.rate_correlation import MAX_RATE_STEP_S, best_shift, correlation_in_words, max_rate_step
from icalib.initialize.smooth_trajectory import pairs_within
from icalib.motion.factor import Extrinsics
from icalib.motion.imu_data import MAX_INTERVAL_S, ImuData, clear_of
from icalib.rig import WheelKind, drive_names
from icalib.sensors.wheels.spec import REVERSED_YAW

CORRELATION_HZ = 100.0  # grid of the correlation; Gauss-Newton refines its peak
MIN_OVERLAP_S = 4.0  # of IMU and wheel readings; shorter overlaps correlate by chance
MIN_CORRELATION = 0.7  # of matching yaw rates: half of the variance; unrelated recordings stay far below
RATE_WINDOW_S = 0.1  # over which rates of the wheels are averaged: many ticks of an encoder
SAME_OVERLAP = 0.9  # share of samples that overlap, from which on two matches are of as many
MIN_WINDOWS = 20  # several for each of the at most five unknowns
MIN_YAW_RATE_RAD_S = 0.03  # RMS; less is noise of the estimated motion
MIN_SPEED_M_S = 0.05  # RMS; less is noise of the estimated motion
STANDSTILL_RATIO = 0.02  # RMS rate of the slower wheel over that of the faster one; below, it does not turn
RADIUS_RANGE_M = (0.005, 5.0)  # of any vehicle's wheel; beyond, the unit of the rates is wrong
MAX_LATERAL_SLIP = 0.25  # share of the speed; wheels that skid in curves have less
MIN_INDEPENDENCE = 0.02  # 1 - |cosine| of speed and yaw rate; below, baseline and lever arm are not separable
MAX_REFINEMENTS = 8  # Gauss-Newton steps of the time offset or the steering offset
OFFSET_STEP_S = 0.02  # largest step of the time offset: two samples of the grid
CONVERGED_S = 1e-6  # step of the time offset: far below its tolerance of 1 ms
SCALE_RANGE = 0.5, 2.0  # plausible scales of a twist; beyond, its unit is wrong or it is from another vehicle
KMH, DEGREE = 1.0 / 3.6, np.pi / 180.0
UNIT_TOLERANCE = 0.1  # relative difference between a scale and the factor of a unit that it is taken for
MIN_RATE_VARIATION = 0.5  # standard deviation over mean of the yaw rate; any offset fits a constant rate
MAX_STEERING_OFFSET_RAD = 1.2  # beyond the range of any steering: another quantity was recorded
REJECTION = 5.0  # median absolute residuals (3.4 standard deviations); rows with larger residuals are rejected as slip


class ReversedYawError(MotionContradictedError):
    """Wheels turn in the opposite direction to the body; also if its vertical is taken for the opposite one."""


@dataclass(frozen=True)
class WheelRates:
    """Mean rates over n windows from start (n,) to end (n,) [s] on the wheels' clock.

    rate (n, m): mean rates of the columns of `integrals_of`; for a pair the rates of left and right wheel [rad/s].
    longest_step_s: the longest time between two readings that a window may bridge.
    """

    start: np.ndarray
    end: np.ndarray
    rate: np.ndarray
    kind: WheelKind = "pair"
    longest_step_s: float = MAX_RATE_STEP_S

    @property
    def turning(self) -> np.ndarray:
        """Regressors (n, k) whose linear combination is the yaw rate; for steered wheels to first order in the
        offset."""
        if self.kind == "pair":
            return self.rate
        if self.kind == "twist":
            return self.rate[:, 1:]
        return self.rate[:, :1] * np.concatenate(
            [np.ones((len(self.rate), 1)), self.rate[:, 2:3] / np.maximum(self.rate[:, 1:2], 1e-3)], axis=1
        )

    @property
    def turn(self) -> np.ndarray:
        """Approximate yaw rate (n,), up to a positive factor."""
        return self.turning[:, -1] - (self.turning[:, 0] if self.kind == "pair" else 0.0)


@dataclass(frozen=True)
class DriveGuess:
    """Extrinsics with a horizontal lever arm, and the values of the drive parameters by name."""

    extrinsics: Extrinsics
    values: dict[str, np.ndarray]


def wheel_rates(name: str, seconds: np.ndarray, integrals: np.ndarray, kind: WheelKind = "pair") -> WheelRates:
    """Mean rates over windows of about RATE_WINDOW_S, one starting at each of the stamps seconds (N,).

    integrals (N, m): see `integrals_of`. Raises EstimationError if there are too few windows, or no motion.
    """
    a = np.arange(len(seconds))
    b = np.searchsorted(seconds, seconds + RATE_WINDOW_S - 1e-9)
    good = (b < len(seconds)) & (b > a)
    longest = max_rate_step(name, seconds, "readings", MAX_INTERVAL_S)
    a, b = pairs_within(seconds, a[good], b[good], longest)
    if len(a) < MIN_WINDOWS:
        raise EstimationError(
            f"{name}: only {len(a)} pairs of its {len(seconds)} readings are at most {longest:.3g} s apart, "
            f"and {MIN_WINDOWS} are needed; record for longer."
        )
    span = seconds[b] - seconds[a]
    rate = (integrals[b] - integrals[a]) / span[:, None]
    _check_turning(name, rate, kind)
    return WheelRates(seconds[a], seconds[b], rate, kind, longest)


def _check_turning(name: str, rate: np.ndarray, kind: WheelKind) -> None:
    """Raises EstimationError if a wheel or the vehicle stands still according to the mean rates (n, m)."""
    if kind != "pair":
        if not np.abs(rate[:, 0]).max() > 0.0:
            raise EstimationError(
                f"{name}: the vehicle stood still according to its readings; check its topic or table, and "
                "that it drove."
            )
        return
    sizes = np.sqrt((rate**2).mean(axis=0))
    still = [
        which for which, rms in zip(("left", "right"), sizes, strict=True) if rms <= STANDSTILL_RATIO * sizes.max()
    ]
    if still:
        raise EstimationError(
            f"{name}: the {' and the '.join(still)} wheel did not turn according to its readings; check the "
            "encoder, its column or joint, and that the vehicle drove. If joints have a position but no "
            "velocity, set measures to angles."
        )


def wheel_offset(imu: ImuData, up: np.ndarray, name: str, rates: WheelRates) -> float:
    """Time offset [s] to add to the clock of the wheels `name` to get the clock of the IMU, both since their first
    stamp.

    The yaw rate of the IMU about `up` (3,), in IMU axes, is correlated with that of the wheels; Gauss-Newton refines
    the peak. Raises EstimationError if they do not match at any offset.
    """
    axis = up / np.linalg.norm(up)
    turn = imu.gyro @ axis
    offset = _correlate(imu, turn, name, rates)
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (turn[1:] + turn[:-1]) * np.diff(imu.seconds))])
    for _ in range(MAX_REFINEMENTS):
        start, end = rates.start + offset, rates.end + offset
        inside = imu.covers(start, end)
        start, end, rate = start[inside], end[inside], rates.turning[inside]
        mean = (np.interp(end, imu.seconds, angle) - np.interp(start, imu.seconds, angle)) / (end - start)
        slope = (np.interp(end, imu.seconds, turn) - np.interp(start, imu.seconds, turn)) / (end - start)
        # mean(offset + d) = mean + slope d = yaw rate of the wheels + bias of the gyroscope.
        step = -_robust_fit(np.column_stack([slope, rate, np.ones(len(rate))]), mean)[0]
        offset += float(np.clip(step, -OFFSET_STEP_S, OFFSET_STEP_S))
        if abs(step) < CONVERGED_S:
            break
    return offset


def drive_guess(
    name: str, wheel_rate: np.ndarray, rate: np.ndarray, velocity: np.ndarray, up: np.ndarray, kind: WheelKind = "pair"
) -> DriveGuess:
    """Extrinsics and drive parameters of the wheels `name`.

    wheel_rate (n, m): see `WheelRates`. rate [rad/s], without bias, and velocity [m/s] (n, 3): means over the same
    windows for the IMU, in IMU axes. up (3,): the vertical in IMU axes. Raises EstimationError if the motion is too
    small or a single arc, or if columns are swapped or have wrong signs.
    """
    axis = up / np.linalg.norm(up)
    level = np.linalg.svd(axis[None])[2][1:]  # two horizontal axes
    if level[0] @ np.cross(level[1], axis) < 0.0:
        level = level[::-1]
    w, u = rate @ axis, velocity @ level.T
    _check_motion(name, w, u)
    e2, l1 = _no_slip(w, u)
    forwards = wheel_rate[:, :2].sum(axis=1) if kind == "pair" else wheel_rate[:, 0]
    _check_lateral_slip(name, u @ e2 + l1 * w, np.column_stack([u, w]), forwards)
    e1 = np.array([e2[1], -e2[0]])
    if _robust_fit(np.column_stack([u @ e1, w]), forwards)[0] < 0.0:  # e_1 must point forwards
        e1, e2, l1 = -e1, -e2, -l1
    _check_independence(name, w, u @ e1)
    l2, values = {"pair": _pair, "twist": _twist, "steered": _steered}[kind](name, w, u @ e1, wheel_rate)
    x, y = e1 @ level, e2 @ level
    return DriveGuess(Extrinsics(np.stack([x, y, axis], axis=1), l1 * x + l2 * y), values)


def _pair(name: str, w: np.ndarray, ahead: np.ndarray, rate: np.ndarray) -> tuple[float, dict[str, np.ndarray]]:
    """Lateral lever arm l_2 [m] of p_imu_wheel = l_1 e_1 + l_2 e_2 (e_1 forwards), radii and baseline of a pair.

    w (n,): yaw rate [rad/s]; ahead (n,): speed of the IMU along e_1 [m/s]; rate (n, 2): mean rates of the wheels."""
    left, right = (_robust_fit(np.column_stack([ahead, w]), rate[:, k]) for k in range(2))
    if left[0] <= 0.0 or right[0] <= 0.0:
        raise EstimationError(
            f"{name}: its wheels count in opposite directions; in the rig file set signs to [1, -1] or [-1, 1]. "
            "A skid-steer drive needs [1, 1, -1, -1] or [-1, -1, 1, 1]. -1 is for wheels that count down as the "
            "vehicle drives forwards."
        )
    radii = np.array([1.0 / left[0], 1.0 / right[0]])
    _check_radii(name, radii)
    arm_left, arm_right = left[1] * radii[0], right[1] * radii[1]
    baseline = float(arm_right - arm_left)
    if baseline < 0.0:
        raise EstimationError(f"{name}: {REVERSED_YAW['pair']}.")
    return -0.5 * float(arm_left + arm_right), {"radii": radii, "baseline": np.array([baseline])}


def _twist(name: str, w: np.ndarray, ahead: np.ndarray, rate: np.ndarray) -> tuple[float, dict[str, np.ndarray]]:
    """Lateral lever arm l_2 [m], see `_pair`, and scales of a twist, whose speed and yaw rate are fitted to the IMU's.

    w (n,) rad/s, ahead (n,) m/s: yaw rate and forward speed of the IMU. rate (n, 2): mean speed and yaw rate of the
    twist."""
    along = _robust_fit(np.column_stack([ahead, w]), rate[:, 0])
    # The constant column absorbs the bias of the gyroscope.
    turned = _robust_fit(np.column_stack([w, np.ones(len(w))]), rate[:, 1])
    scales = 1.0 / np.array([along[0], turned[0]])
    for scale, unit, what, should in (
        (scales[0], KMH, "forward speed", "m/s, not km/h: multiply it by 1 / 3.6"),
        (scales[1], DEGREE, "yaw rate", "rad/s, not deg/s: multiply it by pi / 180"),
    ):
        if abs(scale / unit - 1.0) < UNIT_TOLERANCE:
            raise EstimationError(f"{name}: its {what} must be in {should}.")
        if not SCALE_RANGE[0] < scale < SCALE_RANGE[1]:
            raise EstimationError(
                f"{name}: its {what} would have to be multiplied by {scale:.3g}; check its unit, and that it "
                "is from this vehicle."
            )
    return float(-along[1] * scales[0]), {"scales": scales}


def _steered(name: str, w: np.ndarray, ahead: np.ndarray, rate: np.ndarray) -> tuple[float, dict[str, np.ndarray]]:
    """Lateral lever arm l_2 [m], see `_pair`, radius, wheelbase and steering offset. w, ahead: see `_pair`; rate (n, 3
    or more): mean rate of the wheel, and mean cos and sin of the steering angle.

    v sin(d) = L w cos(d) is linearised in the offset and solved repeatedly (Gauss-Newton).
    """
    turned = _robust_fit(np.column_stack([ahead, w]), rate[:, 0])
    radius = 1.0 / turned[:1]
    _check_radii(name, radius)
    v, offset, base = radius[0] * rate[:, 0], 0.0, 0.0
    for _ in range(MAX_REFINEMENTS):
        c = rate[:, 1] * np.cos(offset) - rate[:, 2] * np.sin(offset)
        s = rate[:, 2] * np.cos(offset) + rate[:, 1] * np.sin(offset)
        base, step = _robust_fit(np.column_stack([w * c, -(v * c + base * w * s)]), v * s)
        offset += float(np.arctan(step))
    if base < 0.0:
        raise EstimationError(
            f"{name}: its steering angle is positive to the right; set signs to [1, -1] (or to "
            "[1, 1, -1, -1] for four joints) in the rig file."
        )
    if abs(offset) > MAX_STEERING_OFFSET_RAD or base == 0.0:
        raise EstimationError(
            f"{name}: its steering angle does not match the yaw rate of the vehicle; check that it is in "
            "radians, and that of the front wheels, not of the steering wheel."
        )
    values = radius, np.array([base]), np.array([offset])
    return float(-turned[1] * radius[0]), dict(zip(drive_names("steered"), values, strict=True))


def _check_radii(name: str, radii: np.ndarray) -> None:
    """Raises EstimationError if a radius [m] is beyond RADIUS_RANGE_M."""
    if radii.min() < RADIUS_RANGE_M[0] or radii.max() > RADIUS_RANGE_M[1]:
        which = " and ".join(f"{r:.3g}" for r in radii)
        raise EstimationError(
            f"{name}: its wheels would have radii of {which} m; check that it measures radians per second (not "
            "degrees or revolutions), or correct rate_unit (of rates) or counts_per_turn (of ticks) in the rig file."
        )


def _robust_fit(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Least-squares solution x (k,) of A x = b, solved twice more without outliers, such as readings during slip."""
    weight, x = np.ones(len(b)), np.zeros(A.shape[1])
    for _ in range(3):
        x = np.linalg.lstsq(A * weight[:, None], b * weight, rcond=None)[0]
        size = np.abs(b - A @ x)
        weight = (size < REJECTION * np.median(size) + 1e-12).astype(float)
    return x


def _no_slip(w: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit vector e_2 (2,) of either sign, and l_1 [m], from e_2 u + l_1 w = 0 by robust total least squares.

    w (n,): yaw rate [rad/s], scaled to the norm of u; u (n, 2): horizontal velocity [m/s].
    """
    scale = np.linalg.norm(u) / np.linalg.norm(w)
    rows, weight, x = np.column_stack([u, w * scale]), np.ones(len(w)), np.zeros(3)
    for _ in range(3):
        x = np.linalg.svd(rows * weight[:, None], full_matrices=False)[2][2]
        size = np.abs(rows @ x)
        weight = (size < REJECTION * np.median(size) + 1e-12).astype(float)
    length = np.linalg.norm(x[:2])
    return x[:2] / length, float(x[2] * scale / length)


def _check_motion(name: str, w: np.ndarray, u: np.ndarray) -> None:
    """Raises EstimationError if the vehicle hardly turned or moved. w (n,): yaw rate [rad/s]; u (n, 2): velocity
    [m/s]."""
    turn, speed = np.sqrt(np.mean(w**2)), np.sqrt(np.mean((u**2).sum(axis=1)))
    if turn < MIN_YAW_RATE_RAD_S or speed < MIN_SPEED_M_S:
        raise EstimationError(
            f"{name}: the vehicle turned at {turn:.3f} rad/s and drove at {speed:.3f} m/s RMS, too little to "
            "calibrate its wheels; record again with left and right turns, or give its parameters in the rig "
            "file."
        )


def _check_lateral_slip(name: str, slip: np.ndarray, motion: np.ndarray, forwards: np.ndarray) -> None:
    """Raises MotionContradictedError if no point of the vehicle moves along one axis only, as wheels force it to.

    slip (n,) [m/s]: lateral speed for the best axis; motion (n, 3): velocity [m/s] and yaw rate [rad/s]; forwards (n,):
    rate that the wheels measure. If the motion explains it, the vehicle moves sideways.
    """
    share = np.linalg.norm(slip) / np.linalg.norm(motion[:, :2])
    if share <= MAX_LATERAL_SLIP:
        return
    left = forwards - motion @ _robust_fit(motion, forwards)
    if np.linalg.norm(left) < MAX_LATERAL_SLIP * np.linalg.norm(forwards):
        raise MotionContradictedError(
            f"{name}: its speed fits the motion along one axis, but the vehicle moves sideways as well, by "
            f"{share:.0%} of its speed. Drives with mecanum or omni wheels are not supported; give its odometry as a "
            "sensor of type: pose with kind: relative."
        )
    raise MotionContradictedError(
        f"{name}: the vehicle drives along none of its axes, its lateral slip would be {100 * share:.0f} % of its "
        "speed; check that the sensor that shows its motion is on this vehicle, and how its poses are written."
    )


def _check_independence(name: str, w: np.ndarray, ahead: np.ndarray) -> None:
    """Raises EstimationError if speed and yaw rate are proportional, as on a single arc."""
    a, b = ahead / np.linalg.norm(ahead), w / np.linalg.norm(w)
    if 1.0 - abs(a @ b) < MIN_INDEPENDENCE:
        raise EstimationError(
            f"{name}: the vehicle drove a single arc, so the parameters of its wheels are unobservable; record "
            "again with left and right turns, or give its parameters in the rig file."
        )


def _correlate(imu: ImuData, turn: np.ndarray, name: str, rates: WheelRates) -> float:
    """Time offset [s] at the peak of the correlation of the IMU's yaw rate `turn` (N,) with that of the wheels.

    Raises EstimationError if the correlation is low or negative.
    """
    grid = np.arange(int(imu.seconds[-1] * CORRELATION_HZ) + 1) / CORRELATION_HZ
    known = clear_of(imu.gaps, grid, grid)
    middle = 0.5 * (rates.start + rates.end)
    wheels = np.arange(int(middle[-1] * CORRELATION_HZ) + 1) / CORRELATION_HZ
    near = np.diff(middle, append=middle[-1]) < rates.longest_step_s
    covered = (np.interp(wheels, middle, near.astype(float)) > 0.99) & (wheels >= middle[0])
    turning = np.interp(wheels, middle, rates.turn)
    turned = np.interp(grid, imu.seconds, turn)
    if rates.longest_step_s > MAX_RATE_STEP_S:  # average the yaw rate over windows as long as those of the wheels
        count = max(1, round(float(np.median(rates.end - rates.start)) * CORRELATION_HZ))
        turned = np.convolve(turned, np.full(count, 1.0 / count), "same")
    best, opposite = (
        best_shift((sign * turned, known), (turning, covered), MIN_OVERLAP_S * CORRELATION_HZ) for sign in (1.0, -1.0)
    )
    # Rates that repeat themselves match with either sign where few of them overlap; reversed ones match as many.
    most, least = (min(len(wheels), len(grid) - p.samples) - max(0, -p.samples) for p in (best, opposite))
    alone = best.correlation <= MIN_CORRELATION or least >= SAME_OVERLAP * most
    if alone and opposite.correlation > MIN_CORRELATION and opposite.score > best.score:
        raise ReversedYawError(f"{name} turns in the opposite direction to {imu.name}: {REVERSED_YAW[rates.kind]}.")
    if not best.correlation > MIN_CORRELATION:
        if np.std(turned[known]) < MIN_RATE_VARIATION * abs(np.mean(turned[known])):
            raise EstimationError(
                f"{name}: the yaw rate was nearly constant, so the time offset is unobservable; record again "
                "with left and right turns, or give its time_offset in the rig file."
            )
        raise EstimationError(
            f"the yaw rate of {name} does not match that of {imu.name} at any time offset "
            f"({correlation_in_words(best.largest)}); check that both come from the same recording and overlap "
            "in time."
        )
    return best.samples / CORRELATION_HZ
