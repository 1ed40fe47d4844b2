"""Wheels from rates and velocities: time offset by correlation, the rest linearly.

The frame of the wheels stands level here, its z along `up`; roll, pitch and height are left to the estimate. In the
plane across `up` the origin of the wheels, p_imu_wheel = l_1 e_1 + l_2 e_2, moves along e_1 alone:

    e_2 u + l_1 w = 0                      (no slip)      u, w: velocity and rate of the IMU across and along `up`
    r theta' = e_1 u - (l_2 -+ b/2) w      (right, left of a pair; b = 0 of the driven wheel of a steered vehicle)
    s_v v' = e_1 u - l_2 w,  s_w w' = w    (speed and yaw rate of a twist)
    v sin(d) = L w cos(d)                  (front axle; v = r theta', d: steering angle + offset)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.initialize.steps.contradicted_guesses import MotionContradictedError
from icalib.initialize.steps.cross_correlation import best_shift
from icalib.initialize.steps.rate_correlation import MAX_RATE_STEP_S, correlation_in_words, max_rate_step
from icalib.motion.imu_data import ImuData, clear_of
from icalib.motion.stamp_intervals import LONGEST_S
from icalib.rig import WheelKind, drive_names

GRID_HZ = 100.0
SHORTEST_OVERLAP_S = 4.0
LEAST_CORRELATION = 0.7
WINDOW_S = 0.1  # of a mean rate of the wheels: long against the steps of ticks
LEAST_WINDOWS = 20
LEAST_TURN_RAD_S = 0.03  # RMS
LEAST_SPEED_M_S = 0.05
STILL_SHARE = 0.02  # of the other wheel's rate
RADII_M = (0.005, 5.0)
SIDEWAYS = 0.25  # of the speed: wheels that skid in curves slip less
LEAST_SHARE = 0.02  # of speed and turning that does not go with the other
ROUNDS = 8
SCALES = 0.5, 2.0
KMH, DEGREE = 1.0 / 3.6, np.pi / 180.0
NEARLY = 0.1  # of a scale that is that of a unit
ONE_RATE = 0.5  # spread over mean
STEERS_RAD = 1.2  # offsets beyond are none

OPPOSITE: dict[WheelKind, str] = {
    "pair": "its left and right wheels are swapped, or both count backwards; swap its columns or joints, or set signs "
    "to [-1, -1] in the rig file",
    "twist": "its yaw rate must be positive to the left; set signs to [1, -1] in the rig file",
    "steered": (
        "its steering angle must be positive to the left and its wheel must turn forwards; correct the wrong sign "
        "with signs in the rig file, [1, -1] or [-1, 1]"
    ),
}


@dataclass(frozen=True)
class WheelRates:
    """Means from start to end (n,) s on the wheels' clock of the rates (n, m) of what `integrals_of` has, by kind: of a
    pair those of both wheels, rad/s, left and right."""

    start: np.ndarray
    end: np.ndarray
    rate: np.ndarray
    kind: WheelKind = "pair"
    longest_step_s: float = MAX_RATE_STEP_S

    @property
    def turning(self) -> np.ndarray:
        """(n, k) of which some sum is the yaw rate; of steered wheels to first order in their offset."""
        if self.kind == "pair":
            return self.rate
        if self.kind == "twist":
            return self.rate[:, 1:]
        return self.rate[:, :1] * np.concatenate(
            [np.ones((len(self.rate), 1)), self.rate[:, 2:3] / np.maximum(self.rate[:, 1:2], 1e-3)], axis=1
        )

    @property
    def turn(self) -> np.ndarray:
        """(n,) about what the yaw rate is, to scale."""
        return self.turning[:, -1] - (self.turning[:, 0] if self.kind == "pair" else 0.0)


@dataclass(frozen=True)
class DriveGuess:
    """R_imu_wheel, p_imu_wheel (3,) m across `up`; values of the groups of the wheels' kind, by name."""

    rotation: np.ndarray
    position: np.ndarray
    values: dict[str, np.ndarray]


def wheel_rates(name: str, seconds: np.ndarray, integrals: np.ndarray, kind: WheelKind = "pair") -> WheelRates:
    """Of the wheels `name`, over windows of about WINDOW_S, one from each of the stamps seconds (N,); integrals (N, m)
    as `integrals_of` has them. Raises EstimationError where there are hardly any."""
    a = np.arange(len(seconds))
    b = np.searchsorted(seconds, seconds + WINDOW_S - 1e-9)
    good = (b < len(seconds)) & (b > a)
    a, b = a[good], b[good]
    longest = max_rate_step(name, seconds, "readings", LONGEST_S)
    near = seconds[b] - seconds[a] <= longest
    a, b = a[near], b[near]
    if len(a) < LEAST_WINDOWS:
        raise EstimationError(
            f"{name}: only {len(a)} pairs of its {len(seconds)} readings are at most {longest:.3g} s apart, "
            f"and {LEAST_WINDOWS} are needed; record for longer."
        )
    span = seconds[b] - seconds[a]
    rate = (integrals[b] - integrals[a]) / span[:, None]
    _check_turning(name, rate, kind)
    return WheelRates(seconds[a], seconds[b], rate, kind, longest)


def _check_turning(name: str, rate: np.ndarray, kind: WheelKind) -> None:
    """Raises EstimationError where a wheel, or both, or the vehicle does not move."""
    if kind != "pair":
        if not np.abs(rate[:, 0]).max() > 0.0:
            raise EstimationError(
                f"{name}: the vehicle stood still according to its readings; check its topic or table, and "
                "that it drove."
            )
        return
    size = np.sqrt((rate**2).mean(axis=0))
    still = [which for which, own in zip(("left", "right"), size, strict=True) if own <= STILL_SHARE * size.max()]
    if still:
        raise EstimationError(
            f"{name}: the {' and the '.join(still)} wheel did not turn according to its readings; check the "
            "encoder, its column or joint, and that the vehicle drove. If joints have a position but no "
            "velocity, set measures to angles."
        )


def wheel_offset(imu: ImuData, up: np.ndarray, name: str, rates: WheelRates) -> float:
    """Seconds to add to the clock of the wheels `name` to get that of the IMU, both since their first stamps.

    From the rate about `up` (3,), upwards in the IMU's axes, and how the wheels turn. Raises EstimationError
    where they do not match at any shift.
    """
    axis = up / np.linalg.norm(up)
    turn = imu.gyro @ axis
    offset = _correlate(imu, turn, name, rates)
    angle = np.concatenate([[0.0], np.cumsum(0.5 * (turn[1:] + turn[:-1]) * np.diff(imu.seconds))])
    for _ in range(ROUNDS):
        start, end = rates.start + offset, rates.end + offset
        inside = imu.covers(start, end)
        start, end, rate = start[inside], end[inside], rates.turning[inside]
        mean = (np.interp(end, imu.seconds, angle) - np.interp(start, imu.seconds, angle)) / (end - start)
        slope = (np.interp(end, imu.seconds, turn) - np.interp(start, imu.seconds, turn)) / (end - start)
        # mean(offset + d) = mean + slope d = what the wheels say, and the gyro's bias.
        step = -_fit(np.column_stack([slope, rate, np.ones(len(rate))]), mean)[0]
        offset += float(np.clip(step, -0.02, 0.02))
        if abs(step) < 1e-6:
            break
    return offset


def drive_guess(
    name: str, wheel_rate: np.ndarray, rate: np.ndarray, velocity: np.ndarray, up: np.ndarray, kind: WheelKind = "pair"
) -> DriveGuess:
    """The drive `name` from mean rates of its wheels (n, m), see `WheelRates`, and the IMU's rate (n, 3) rad/s, without
    bias, and velocity (n, 3) m/s over the same spans, in the IMU's axes; up (3,): upwards in these.

    Raises EstimationError where the motion does not show it, or left and right or their signs are mixed up.
    """
    axis = up / np.linalg.norm(up)
    level = np.linalg.svd(axis[None])[2][1:]  # two axes across `up`
    if level[0] @ np.cross(level[1], axis) < 0.0:
        level = level[::-1]
    w, u = rate @ axis, velocity @ level.T
    _check_motion(name, w, u)
    e2, l1 = _no_slip(w, u)
    _check_sideways(name, u @ e2 + l1 * w, u)
    e1 = np.array([e2[1], -e2[0]])
    forwards = wheel_rate[:, :2].sum(axis=1) if kind == "pair" else wheel_rate[:, 0]
    if _fit(np.column_stack([u @ e1, w]), forwards)[0] < 0.0:  # forwards is where the wheels turn forwards
        e1, e2, l1 = -e1, -e2, -l1
    _check_arcs(name, w, u @ e1)
    l2, values = {"pair": _pair, "twist": _twist, "steered": _steered}[kind](name, w, u @ e1, wheel_rate)
    x, y = e1 @ level, e2 @ level
    return DriveGuess(np.stack([x, y, axis], axis=1), l1 * x + l2 * y, values)


def _pair(name: str, w: np.ndarray, ahead: np.ndarray, rate: np.ndarray) -> tuple[float, dict[str, np.ndarray]]:
    """l_2, radii, baseline."""
    left, right = (_fit(np.column_stack([ahead, w]), rate[:, k]) for k in range(2))
    if left[0] <= 0.0 or right[0] <= 0.0:
        raise EstimationError(
            f"{name}: its wheels count in opposite directions; set signs in the rig file, [1, -1] or [-1, 1], "
            "with -1 for the wheel that counts down as the vehicle drives forwards."
        )
    radii = np.array([1.0 / left[0], 1.0 / right[0]])
    _check_radii(name, radii)
    arm_left, arm_right = left[1] * radii[0], right[1] * radii[1]
    baseline = float(arm_right - arm_left)
    if baseline < 0.0:
        raise EstimationError(f"{name}: {OPPOSITE['pair']}.")
    return -0.5 * float(arm_left + arm_right), {"radii": radii, "baseline": np.array([baseline])}


def _twist(name: str, w: np.ndarray, ahead: np.ndarray, rate: np.ndarray) -> tuple[float, dict[str, np.ndarray]]:
    """l_2, scales."""
    along = _fit(np.column_stack([ahead, w]), rate[:, 0])
    # A bias of the gyro besides, which the yaw rate of the wheels does not have.
    turned = _fit(np.column_stack([w, np.ones(len(w))]), rate[:, 1])
    scales = 1.0 / np.array([along[0], turned[0]])
    for scale, unit, what, should in (
        (scales[0], KMH, "forward speed", "m/s, not km/h: multiply it by 1 / 3.6"),
        (scales[1], DEGREE, "yaw rate", "rad/s, not deg/s: multiply it by pi / 180"),
    ):
        if abs(scale / unit - 1.0) < NEARLY:
            raise EstimationError(f"{name}: its {what} must be in {should}.")
        if not SCALES[0] < scale < SCALES[1]:
            raise EstimationError(
                f"{name}: its {what} would have to be multiplied by {scale:.3g}; check its unit, and that it "
                "is from this vehicle."
            )
    return float(-along[1] * scales[0]), {"scales": scales}


def _steered(name: str, w: np.ndarray, ahead: np.ndarray, rate: np.ndarray) -> tuple[float, dict[str, np.ndarray]]:
    """l_2, radius, wheelbase, steering offset. v sin(d) = L w cos(d), with the offset t = tan(d) - tan(steering angle)
    to first order, and again from there."""
    turned = _fit(np.column_stack([ahead, w]), rate[:, 0])
    radius = 1.0 / turned[:1]
    _check_radii(name, radius)
    v, offset, base = radius[0] * rate[:, 0], 0.0, 0.0
    for _ in range(ROUNDS):
        c = rate[:, 1] * np.cos(offset) - rate[:, 2] * np.sin(offset)
        s = rate[:, 2] * np.cos(offset) + rate[:, 1] * np.sin(offset)
        base, step = _fit(np.column_stack([w * c, -(v * c + base * w * s)]), v * s)
        offset += float(np.arctan(step))
    if base < 0.0:
        raise EstimationError(
            f"{name}: its steering angle is positive to the right; change its sign with signs in the rig file."
        )
    if abs(offset) > STEERS_RAD or base == 0.0:
        raise EstimationError(
            f"{name}: its steering angle does not match the yaw rate of the vehicle; check that it is in "
            "radians, and that of the front wheels, not of the steering wheel."
        )
    found = radius, np.array([base]), np.array([offset])
    return float(-turned[1] * radius[0]), dict(zip(drive_names("steered"), found, strict=True))


def _check_radii(name: str, radii: np.ndarray) -> None:
    if radii.min() < RADII_M[0] or radii.max() > RADII_M[1]:
        which = " and ".join(f"{r:.3g}" for r in radii)
        raise EstimationError(
            f"{name}: its wheels would have radii of {which} m; check that it measures radians per second (not "
            "degrees or revolutions), or set its rate_unit or counts_per_turn in the rig file."
        )


def _fit(A: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Least squares, twice more without rows that stand far off: wheels that slipped."""
    weight, x = np.ones(len(b)), np.zeros(A.shape[1])
    for _ in range(3):
        x = np.linalg.lstsq(A * weight[:, None], b * weight, rcond=None)[0]
        size = np.abs(b - A @ x)
        weight = (size < 5.0 * np.median(size) + 1e-12).astype(float)
    return x


def _no_slip(w: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, float]:
    """e_2 (2,), a unit vector of either sign, and l_1 with e_2 u + l_1 w = 0: the direction in which (u, w) does not
    spread, w in units that make its spread like that of u."""
    scale = np.linalg.norm(u) / np.linalg.norm(w)
    rows, weight, x = np.column_stack([u, w * scale]), np.ones(len(w)), np.zeros(3)
    for _ in range(3):
        x = np.linalg.svd(rows * weight[:, None], full_matrices=False)[2][2]
        size = np.abs(rows @ x)
        weight = (size < 5.0 * np.median(size) + 1e-12).astype(float)
    length = np.linalg.norm(x[:2])
    return x[:2] / length, float(x[2] * scale / length)


def _check_motion(name: str, w: np.ndarray, u: np.ndarray) -> None:
    turn, speed = np.sqrt(np.mean(w**2)), np.sqrt(np.mean((u**2).sum(axis=1)))
    if turn < LEAST_TURN_RAD_S or speed < LEAST_SPEED_M_S:
        raise EstimationError(
            f"{name}: the vehicle turned at {turn:.3f} rad/s and drove at {speed:.3f} m/s RMS, too little to "
            "calibrate its wheels; record again with left and right turns, or give its parameters in the rig "
            "file."
        )


def _check_sideways(name: str, slip: np.ndarray, velocity: np.ndarray) -> None:
    """Raises MotionContradictedError where no point of the vehicle moves along one axis: slip (n,) m/s across the best
    one."""
    share = float(np.sqrt(np.mean(slip**2) / np.mean((velocity**2).sum(axis=1))))
    if share > SIDEWAYS:
        raise MotionContradictedError(
            f"{name}: the vehicle drives along none of its axes, its lateral slip would be {100 * share:.0f} % "
            "of its speed; check that the sensor that shows its motion is on this vehicle, and how its poses "
            "are written."
        )


def _check_arcs(name: str, w: np.ndarray, ahead: np.ndarray) -> None:
    """The vehicle must drive and turn apart from each other."""
    a, b = ahead / np.linalg.norm(ahead), w / np.linalg.norm(w)
    if 1.0 - abs(a @ b) < LEAST_SHARE:
        raise EstimationError(
            f"{name}: the vehicle drove a single arc, so the parameters of its wheels are unobservable; record "
            "again with left and right turns, or give its parameters in the rig file."
        )


def _correlate(imu: ImuData, turn: np.ndarray, name: str, rates: WheelRates) -> float:
    """Offset [s] at the peak of the correlation of the gyro's `turn` (N,) with how the wheels turn."""
    grid = np.arange(int(imu.seconds[-1] * GRID_HZ) + 1) / GRID_HZ
    known = clear_of(imu.gaps, grid, grid)
    middle = 0.5 * (rates.start + rates.end)
    wheels = np.arange(int(middle[-1] * GRID_HZ) + 1) / GRID_HZ
    near = np.diff(middle, append=middle[-1]) < rates.longest_step_s
    seen = (np.interp(wheels, middle, near.astype(float)) > 0.99) & (wheels >= middle[0])
    turning = np.interp(wheels, middle, rates.turn)
    turned = np.interp(grid, imu.seconds, turn)
    if rates.longest_step_s > MAX_RATE_STEP_S:  # over which the wheels' rates are means
        count = max(1, round(float(np.median(rates.end - rates.start)) * GRID_HZ))
        turned = np.convolve(turned, np.full(count, 1.0 / count), "same")
    found, opposite = (
        best_shift(sign * turned, known, turning, seen, SHORTEST_OVERLAP_S * GRID_HZ) for sign in (1.0, -1.0)
    )
    if opposite.correlation > max(found.correlation, LEAST_CORRELATION):
        raise EstimationError(f"{name} turns in the opposite direction to {imu.name}: {OPPOSITE[rates.kind]}.")
    if not found.correlation > LEAST_CORRELATION:
        if np.std(turned[known]) < ONE_RATE * abs(np.mean(turned[known])):
            raise EstimationError(
                f"{name}: the yaw rate was nearly constant, so the time offset is unobservable; record again "
                "with left and right turns, or give its time_offset in the rig file."
            )
        raise EstimationError(
            f"the yaw rate of {name} does not match that of {imu.name} at any time offset "
            f"({correlation_in_words(found.largest)}); check that both come from the same recording and overlap "
            "in time."
        )
    return found.samples / GRID_HZ
