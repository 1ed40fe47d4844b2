"""IMU readings prepared for integration: times, noise of each interval, gaps."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.ndimage import uniform_filter1d

from icalib.base.compiled import njit
from icalib.data.measurements import ImuStream, Measurements, Part
from icalib.data.stamps import usual_step
from icalib.geometry import so3
from icalib.geometry.small import mul3, polynomial_means, tmul3
from icalib.geometry.targets.base import BOARD
from icalib.optim.state import Key, Layout, State
from icalib.rig import ImuNoise, ImuSensor, Rig, scene
from icalib.sensors.imu.spec import ACCEL_DELAY, EFFECTS, SIZE_EFFECT
from icalib.sensors.parameter import ParameterSpec
from icalib.sensors.sensor import Sampling

SAME_INSTANT_S = 1e-6  # s: on a common grid of stamps, rounding must not decide which of two instants is nearer
MIN_GAP_S, MIN_GAP_PERIODS = 0.01, 3.0  # an interval longer than both, seconds and periods, is a gap
# Correlation time of rate and specific force within a gap. Their unknown variation there has their variance over the
# recording.
MOTION_CORRELATION_S = 0.1
# see `_is_dense`: jumping rates at 20 Hz move a time offset by a whole step, steady rates at 100 Hz by 0.6 ms
MAX_DENSE_PERIOD_S = 0.025
CUBIC, QUINTIC = 4, 6  # readings that a polynomial of this degree passes through


def clear_of(gaps: Iterable[tuple[float, float]], start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(n,) whether each span from `start` to `end` (n,) overlaps none of `gaps`, all in seconds."""
    clear = np.ones(len(start), dtype=bool)
    for a, b in gaps:
        clear &= (end <= a) | (start >= b)
    return clear


@dataclass(frozen=True)
class ImuData:
    """Readings on the IMU clock, seconds since its first stamp; gyro [rad/s], accel [m/s^2] (N, 3).

    sampling: `instantaneous` readings are samples at their stamps; an `interval-mean` is that of the interval which
    ends at its stamp. variance (N - 1, 3): squared noise densities of each interval: gyroscope, accelerometer, and
    deviation of the specific force from its mean within the interval. walk (2,): squared densities of the bias random
    walks. gaps: (start, end) of intervals without readings. seams: (end, begin) between joined recordings, where
    nothing is known.
    forwards: True if biases of a keyframe apply until the next one, so that motion is propagated forwards only. This is
    so if the readings are an assumption on the motion, whose biases change much between keyframes.

    unit: parameter whose value is the unit of length of an assumed motion: the scale of the sensor that shows the
    motion; None for metres. Noise in metres would pull every length towards zero, because residuals of a shorter motion
    are smaller.
    """

    name: str
    seconds: np.ndarray
    gyro: np.ndarray
    accel: np.ndarray
    variance: np.ndarray
    walk: np.ndarray
    gaps: tuple[tuple[float, float], ...]
    seams: tuple[tuple[float, float], ...] = ()
    forwards: bool = False
    unit: Key | None = None
    sampling: Sampling = "instantaneous"

    def unit_length(self, state: State) -> float:
        """The unit of length [m] at `state`."""
        return 1.0 if self.unit is None else float(state.values[self.unit][0])

    def unit_columns(self, layout: Layout) -> np.ndarray:
        """Calibration column (1,) of the unit of length, -1 if it is fixed; (0,) for metres."""
        if self.unit is None:
            return np.zeros(0, dtype=np.int64)
        return layout.columns(*self.unit) if layout.has(*self.unit) else np.full(1, -1)

    @cached_property
    def signals(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rates [rad/s] and specific forces [m/s^2] (N, 3) at the stamps, and means (N - 1, 6) of both over the
        intervals between them. Each is that of a polynomial through CUBIC readings, one-sided at ends and gaps."""
        readings = np.hstack([self.gyro, self.accel])
        if self.sampling == "instantaneous":
            return self.gyro, self.accel, self._means_of_samples(readings, CUBIC)
        inside = ~self._is_gap
        means = np.where(inside[:, None], readings[1:], 0.5 * (readings[1:] + readings[:-1]))
        # Values in the middles of intervals: means without their second-order part.
        middles, k = means.copy(), 1 + np.flatnonzero(inside[:-2] & inside[1:-1] & inside[2:])
        middles[k] -= (means[k - 1] - 2.0 * means[k] + means[k + 1]) / 24.0
        values = self._values_between(readings, middles)
        return values[:, :3].copy(), values[:, 3:].copy(), means

    def interpolation_error(self) -> np.ndarray:
        """(N - 1, 2) estimated RMS error of `signals` in the mean rate [rad/s] and force [m/s^2] of each interval: the
        difference to a polynomial through QUINTIC readings, averaged over the axes. Noise adds 4 % of its own size."""
        if self.sampling == "interval-mean":
            return np.zeros((len(self.seconds) - 1, 2))
        gyro, accel, means = self.signals
        error = (self._means_of_samples(np.hstack([gyro, accel]), QUINTIC) - means) ** 2
        return np.sqrt(error.reshape(-1, 2, 3).mean(axis=2))

    @cached_property
    def _is_gap(self) -> np.ndarray:
        """(N - 1,) whether each interval is a gap or seam."""
        out = np.zeros(len(self.seconds) - 1, dtype=bool)
        middles = [0.5 * (begin + end) for begin, end in (*self.gaps, *self.seams)]
        out[self.interval(np.array(middles))] = True
        return out

    def _runs(self) -> tuple[np.ndarray, np.ndarray]:
        """First and last reading (N,) of the run without gaps that each reading belongs to."""
        starts = np.concatenate([[0], 1 + np.flatnonzero(self._is_gap)])
        run = np.searchsorted(starts, np.arange(len(self.seconds)), side="right") - 1
        return starts[run], np.append(starts[1:], len(self.seconds))[run] - 1

    def _means_of_samples(self, values: np.ndarray, count: int) -> np.ndarray:
        """Means (N - 1, 6) over the intervals of polynomials through `count` samples values (N, 6); linear in gaps."""
        first, last = (x[:-1].copy() for x in self._runs())
        gap = np.flatnonzero(self._is_gap)
        first[gap], last[gap] = gap, gap + 1
        out, spans = np.empty((len(values) - 1, 6)), np.stack([self.seconds[:-1], self.seconds[1:]], axis=1)
        polynomial_means(self.seconds, values, spans, first, last, count, out)
        return out

    def _values_between(self, readings: np.ndarray, middles: np.ndarray) -> np.ndarray:
        """Values (N, 6) at the stamps of polynomials through `middles` (N - 1, 6), the values in the middles of
        intervals. A run of one reading has its value in `readings` (N, 6)."""
        first, last = self._runs()
        several = np.flatnonzero(last > first)
        out, t = np.empty((len(several), 6)), self.seconds
        spans = np.stack([t[several], t[several]], axis=1)
        polynomial_means(0.5 * (t[:-1] + t[1:]), middles, spans, first[several], last[several] - 1, CUBIC, out)
        values = readings.copy()
        values[several] = out
        return values

    def covers(self, start: np.ndarray, end: np.ndarray) -> np.ndarray:
        """(n,) whether each span from `start` to `end` (n,) seconds lies within the recording and outside its gaps."""
        inside = (start >= self.seconds[0]) & (end <= self.seconds[-1])
        return inside & clear_of(self.gaps, start, end)

    @classmethod
    def build(
        cls, stream: ImuStream, noise: ImuNoise, forwards: bool = False, sampling: Sampling = "instantaneous"
    ) -> ImuData:
        """Readings of `stream`; forwards, sampling: see the class.

        Noise includes what interpolation between readings misses (`interpolation_error`). In gaps it includes the
        variance of the readings over the recording, as the motion in a gap is unknown, and the bias random walk.
        """
        t = stream.seconds
        dt = np.diff(t)
        # Columns as in `ImuData`. The density is that of white noise in continuous time, within an interval, too: noise
        # that is constant between readings makes slow readings stiff, and the normal equations singular in numbers.
        variance = np.tile([noise.gyro**2, noise.accel**2, noise.accel**2], (len(dt), 1))
        gap = dt > max(MIN_GAP_S, MIN_GAP_PERIODS * _period(t))
        data = cls(
            stream.name,
            t,
            np.ascontiguousarray(stream.gyro),
            np.ascontiguousarray(stream.accel),
            variance,
            np.array([noise.gyro_walk**2, noise.accel_walk**2]),
            tuple(zip(t[:-1][gap], t[1:][gap], strict=True)),
            forwards=forwards,
            sampling=sampling,
        )
        error = data.interpolation_error() ** 2 * dt[:, None]
        variance += error[:, [0, 1, 1]]
        gyro, accel = stream.gyro.var(axis=0).sum() / 3.0, stream.accel.var(axis=0).sum() / 3.0
        # A first-order process of this correlation time and variance, as white noise of the same density.
        variance[gap] += 2.0 * MOTION_CORRELATION_S * np.array([gyro, accel, accel])
        # Biases are constant within an integration step; their random walk over a gap becomes white noise.
        walked = np.array([noise.gyro_walk, noise.accel_walk, noise.accel_walk]) * dt[gap][:, None]
        variance[gap] += walked**2 / 3.0
        return data

    def at_pace(self, pace: float) -> ImuData:
        """The same readings on a clock that counts `pace` seconds for each of the IMU's."""
        gaps, seams = ((tuple((pace * a, pace * b) for a, b in spans)) for spans in (self.gaps, self.seams))
        return replace(self, seconds=pace * self.seconds, gaps=gaps, seams=seams)

    def interval(self, seconds: np.ndarray) -> np.ndarray:
        """Index (n,) of the reading interval of each time; the first or last one for times outside."""
        return np.clip(np.searchsorted(self.seconds, seconds, side="right") - 1, 0, len(self.seconds) - 2)

    def rotation_sigma(self, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
        """Standard deviation (n,) [rad, about each axis] of the rotation error from gyroscope noise between `begin` and
        `end` (n,) [s]; negative if `end` is earlier."""
        dt = np.diff(self.seconds)
        variance = np.concatenate([[0.0], np.cumsum(self.variance[:, 0] * dt)])
        a, b = (np.interp(t, self.seconds, variance) for t in (begin, end))
        return np.copysign(np.sqrt(np.abs(b - a)), end - begin)


def _period(seconds: np.ndarray) -> float:
    """Period [s] of the readings: the median step, or the mean one if readings come in bursts with far shorter
    steps."""
    median, usual = float(np.median(np.diff(seconds))), usual_step(seconds)
    return usual if median < 0.5 * usual else median


def imu_data(rig: Rig, measurements: Measurements) -> ImuData | None:
    """Readings of the rig's IMU, real or assumed; None if it has none."""
    if rig.imu is None or measurements.imu is None:
        return None
    forwards = rig.assumes_motion and (bool(rig.lidars) or _is_dense(measurements))
    imu, unit = ImuData.build(measurements.imu, rig.imu.noise, forwards, rig.imu.sampling), _unit(rig)
    return imu if unit is None else replace(imu, unit=unit)  # a copy computes its signals anew


def _unit(rig: Rig) -> Key | None:
    """See `ImuData`: the scale of the sensor whose poses are those of the body."""
    if not rig.assumes_motion:
        return None
    if rig.moves_by_poses:
        return rig.poses[0].name, "scale"
    return (BOARD, scene.SIZE.name) if rig.has_target else None


def _is_dense(measurements: Measurements) -> bool:
    """True if the poses of a rig without an IMU are at most MAX_DENSE_PERIOD_S apart.

    Assumed rates are then constant from each keyframe to the next and jump there, see `ImuData.forwards`. With sparser
    poses, such jumps would shift time offsets.
    """
    return float(np.median(np.diff(measurements.reference.seconds))) <= MAX_DENSE_PERIOD_S


def joined_imu_data(rig: Rig, parts: Sequence[Part], joined: Measurements) -> ImuData | None:
    """As `imu_data`, for joined recordings. The noise within gaps follows from the motion of each recording."""
    imus = [(p, imu) for p in parts if (imu := imu_data(rig, p.measurements)) is not None]
    return _joined(imus, joined.imu) if imus and joined.imu is not None else None


def further_imu_data(imu: ImuSensor, parts: Sequence[Part], joined: Measurements) -> ImuData:
    """Readings of an IMU after the first, in all `parts` of joined recordings."""
    built: list[tuple[Part, ImuData]] = []
    for part in parts:
        stream = part.measurements.streams[imu.name]
        assert isinstance(stream, ImuStream)
        built.append((part, ImuData.build(stream, imu.noise, False, imu.sampling)))
    stream = joined.streams[imu.name]
    assert isinstance(stream, ImuStream)
    return _joined(built, stream)


def _joined(imus: Sequence[tuple[Part, ImuData]], stream: ImuStream) -> ImuData:
    """The readings `imus` of each recording as one. stream: the same readings on the joined clock."""
    first = imus[0][1]
    if len(imus) < 2:
        return first
    seconds = stream.seconds
    begins = [float(seconds[p.rows[stream.key].start]) for p, _ in imus]
    # The interval between two recordings has a variance, too, but no factor uses it.
    variance = np.concatenate([np.vstack([imu.variance, imu.variance[-1:]]) for _, imu in imus])[:-1]
    gaps = tuple((a + begin, b + begin) for begin, (_, imu) in zip(begins, imus, strict=True) for a, b in imu.gaps)
    last = np.cumsum([len(imu.seconds) for _, imu in imus])[:-1] - 1
    seams = tuple((float(seconds[i]), float(seconds[i + 1])) for i in last)
    gyro, accel = np.ascontiguousarray(stream.gyro), np.ascontiguousarray(stream.accel)
    model = first.walk, gaps, seams, first.forwards, first.unit, first.sampling
    return ImuData(stream.name, seconds, gyro, accel, variance, *model)


# Scale-misalignment model of IMU readings, in the axes of the gyroscope.
#
#     gyro  = M_g w + A_g f + b_g + noise      w: angular rate, f: specific force, both in the IMU frame
#     accel = M_a C f + b_a + noise            M: lower triangular, C = Exp(r): gyroscope to accelerometer axes
#
# The IMU frame has its origin at the accelerometer and the axes of the gyroscope. Its x axis is the one that the
# gyroscope's x axis measures, because M_g is lower triangular. Kalibr's frame has the axes of the accelerometer
# instead, rotated by C.
#
# Intrinsics are 24 numbers (`INTRINSICS_LABELS` of `sensors.imu.spec`), zero for an ideal IMU: M_a - I (xx yx yy zx zy
# zz), M_g - I (same), r (3), A_g (row-major 9).

_LOWER_ROW = np.array([0, 1, 1, 2, 2, 2])
_LOWER_COLUMN = np.array([0, 0, 1, 0, 1, 2])


@njit(cache=True, nogil=True)
def _lower_inverse(m):
    """Inverse (3, 3) of a lower triangular matrix (3, 3)."""
    inv = np.zeros((3, 3))
    for i in range(3):
        inv[i, i] = 1.0 / m[i, i]
    inv[1, 0] = -m[1, 0] * inv[0, 0] * inv[1, 1]
    inv[2, 1] = -m[2, 1] * inv[1, 1] * inv[2, 2]
    inv[2, 0] = -(m[2, 0] * inv[0, 0] + m[2, 1] * inv[1, 0]) * inv[2, 2]
    return inv


@njit(cache=True, nogil=True)
def correction_matrices(intrinsics):
    """Matrices F, G, H that invert the model: f = F (accel - b_a), w = G (gyro - b_g) + H (accel - b_a); and G A_g."""
    ma, mg = np.eye(3), np.eye(3)
    for n in range(6):
        ma[_LOWER_ROW[n], _LOWER_COLUMN[n]] += intrinsics[n]
        mg[_LOWER_ROW[n], _LOWER_COLUMN[n]] += intrinsics[6 + n]
    F, G = tmul3(so3.exp(intrinsics[12:15]), _lower_inverse(ma)), _lower_inverse(mg)
    GA = mul3(G, intrinsics[15:24].reshape((3, 3)))
    return F, G, -mul3(GA, F), GA


# Effects on the readings, which are linear in their parameters. All are in the axes of the gyroscope; misalignments of
# the axes change them by their size, which is neglected.
#
# size_effect: each axis of an accelerometer is at a place of its own. The IMU frame has its origin at the x axis; the y
# and z axes are at r_y and r_z [m], so that axis i reads e_i^T (f + dw/dt x r_i + w x (w x r_i)).
# accel_delay [s]: the accelerometer measures this long before the stamps, f(t - d).
# low_pass [s^2]: of both sensors. A filter of Gaussian response sigma reads x + sigma^2 / 2 x'' to second order; a lag
# belongs to the clock.

# Mean of readings before they are differentiated twice: white noise would be most of that, and regression on noise
# finds too small a filter. It takes 14 % from a motion of 3 Hz.
SMOOTH_S = 0.1


def reading_effect(imu: ImuData, effect: ParameterSpec, gyro_bias: np.ndarray) -> np.ndarray:
    """(N, 6, m): derivative of the readings, gyroscope and accelerometer, by the m parameters of one of EFFECTS, zero
    across gaps. gyro_bias (3,) rad/s."""
    J = np.zeros((len(imu.gyro), 6, effect.size))
    if effect is SIZE_EFFECT:
        w = np.ascontiguousarray(imu.gyro - gyro_bias)
        W = so3.hat_many(w)
        lever = so3.hat_many(np.ascontiguousarray(_slope(imu, w))) + W @ W
        J[:, 4, :3], J[:, 5, 3:] = lever[:, 1], lever[:, 2]
    elif effect is ACCEL_DELAY:
        J[:, 3:, 0] = -_slope(imu, imu.accel)
    else:
        J[:, :, 0] = _bend(imu, np.hstack([imu.gyro, imu.accel]))
    return J


def _slope(imu: ImuData, x: np.ndarray) -> np.ndarray:
    """(N, m) difference quotients of x (N, m) by time; zero across gaps, where they say nothing."""
    slope = np.gradient(x, imu.seconds, axis=0)
    for begin, end in (*imu.gaps, *imu.seams):
        slope[(imu.seconds >= begin) & (imu.seconds <= end)] = 0.0
    return slope


def _bend(imu: ImuData, x: np.ndarray) -> np.ndarray:
    """(N, m) second derivative of smoothed x (N, m) by time; zero near gaps."""
    count = max(round(SMOOTH_S / float(np.median(np.diff(imu.seconds)))), 1)
    bend = _slope(imu, _slope(imu, uniform_filter1d(x, count, axis=0, mode="nearest")))
    for begin, end in (*imu.gaps, *imu.seams):
        bend[(imu.seconds >= begin - SMOOTH_S) & (imu.seconds <= end + SMOOTH_S)] = 0.0
    return bend


def without_effects(imu: ImuData, state: State, gyro_bias: np.ndarray) -> ImuData:
    """The readings without the effects in `state`: those of sensors that measure at one place and at their stamps."""
    for effect in EFFECTS:
        if (value := state.values.get((imu.name, effect.name))) is None:
            continue
        if effect is ACCEL_DELAY:  # differences would amplify noise
            later = imu.seconds + value[0]
            imu = replace(imu, accel=np.stack([np.interp(later, imu.seconds, x) for x in imu.accel.T], axis=1))
        else:
            off = reading_effect(imu, effect, gyro_bias) @ value
            imu = replace(imu, gyro=imu.gyro - off[:, :3], accel=imu.accel - off[:, 3:])
    return imu


# Sentences for messages: axes about which a body rotated, and about which it hardly did.

# RMS rate about an axis over that about the strongest one: below it, rotation about the axis is too weak
WEAK_AXIS_RATIO = 0.1
NAMED_AXIS_COSINE = 0.9  # component of a unit vector: above it, the direction is called by the axis' name
MIN_KEYFRAMES_FOR_AXES = 2  # keyframes with a rotation between them


def hardly_turned(seconds: np.ndarray, rotation: np.ndarray, body: str) -> str:
    """Words for the axes about which `body` hardly rotated, such as "the y and z axes of imu0"; empty if it rotated
    about all three.

    seconds (K,), rotation (K, 3, 3) R_world_body: its keyframes. Backward steps in time, between recordings, are
    ignored.
    """
    if len(seconds) < MIN_KEYFRAMES_FOR_AXES:
        return ""
    step = np.diff(seconds)
    turn = so3.log_many(np.ascontiguousarray(np.swapaxes(rotation[:-1], 1, 2) @ rotation[1:]))
    rate = turn[step > 0.0] / np.sqrt(step[step > 0.0])[:, None]
    squares, axes = np.linalg.eigh(rate.T @ rate)
    weak = np.sqrt(np.maximum(squares, 0.0)) < WEAK_AXIS_RATIO * np.sqrt(max(squares[-1], 0.0))
    if not weak.any():
        return ""
    return axis_words(body, axes[:, 0]) if weak.sum() == 1 else other_axes(body, axes[:, -1])


def axis_words(body: str, direction: np.ndarray | tuple[float, float, float]) -> str:
    """Words for a unit vector (3,) in the axes of `body`: "the z axis of imu0" if it is close to an axis."""
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > NAMED_AXIS_COSINE:
        return f"the {'xyz'[k]} axis of {body}"
    return f"the direction {_numbers(direction)} in the axes of {body}"


def other_axes(body: str, direction: np.ndarray | tuple[float, float, float]) -> str:
    """Words for the two axes perpendicular to a unit vector (3,) in the axes of `body`, such as "the x and y axes of
    imu0"."""
    k = int(np.argmax(np.abs(direction)))
    if abs(direction[k]) > NAMED_AXIS_COSINE:
        return f"the {' and '.join(c for c in 'xyz' if c != 'xyz'[k])} axes of {body}"
    return f"two axes perpendicular to the direction {_numbers(direction)} in the axes of {body}"


def _numbers(direction: np.ndarray | tuple[float, float, float]) -> str:
    return f"({', '.join(f'{x:.2f}' for x in direction)})"


# Intervals between stamps over which a sensor that integrates (wheels, odometry) is compared with the motion.

MAX_INTERVAL_S = 0.5  # the approximations within an interval hold up to this length


@dataclass(frozen=True)
class StampIntervals:
    """n intervals between stamps `first` and `last` (n,), indices of a sensor's stamps. The first stamp belongs to
    `keyframe` (n,), sorted, the last one to the next keyframe."""

    first: np.ndarray
    last: np.ndarray
    keyframe: np.ndarray


def choose_intervals(imu: ImuData, keyframes: np.ndarray, starts: tuple[int, ...], times: np.ndarray) -> StampIntervals:
    """Intervals between the stamps nearest to neighbouring keyframes; `times` (N,): stamps on the IMU clock.

    If keyframes are denser than stamps, neighbours may share a stamp. The interval to the next stamp then belongs to
    the two keyframes about its middle. No interval leaves the IMU's recording, touches a gap in it, or crosses the
    first keyframes `starts` of recordings. If motion is propagated forwards only (see `ImuData`), the stamp is the
    first after the keyframe.
    """
    after = np.clip(np.searchsorted(times, keyframes), 1, len(times) - 1)
    is_before = keyframes - times[after - 1] < times[after] - keyframes + SAME_INSTANT_S
    near = after if imu.forwards else after - is_before
    a, b = times[near[:-1]], times[near[1:]]
    good = (a < b) & _usable(imu, a, b)
    good[np.array(starts[1:], dtype=np.int64) - 1] = False
    keyframe = np.flatnonzero(good)
    return StampIntervals(near[keyframe], near[keyframe + 1], keyframe)


def pose_intervals(imu: ImuData, keyframes: np.ndarray, starts: tuple[int, ...], times: np.ndarray) -> StampIntervals:
    """All intervals between neighbouring stamps `times` (N,) on the IMU clock, each at the two keyframes about its
    middle. None leaves the IMU's recording, touches a gap in it, or lies beyond the keyframes or between recordings."""
    a, b = times[:-1], times[1:]
    middle = 0.5 * (a + b)
    good = _usable(imu, a, b) & (middle > keyframes[0]) & (middle < keyframes[-1])
    keyframe = np.searchsorted(keyframes, middle) - 1
    good &= ~np.isin(keyframe + 1, starts)
    k = np.flatnonzero(good)
    return StampIntervals(k, k + 1, keyframe[k])


def _usable(imu: ImuData, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(n,) whether each interval is short, and lies within one recording of the IMU and outside its gaps."""
    return (end - start <= MAX_INTERVAL_S) & imu.covers(start, end) & clear_of(imu.seams, start, end)
