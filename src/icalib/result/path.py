"""Where a result has its body at any instant, on which clock: for what is shown beside the recording."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.geometry import so3
from icalib.geometry.small import hermite
from icalib.result.calibration import Calibration, RecordingSpan

_EDGE_S = 1.0  # data this long before and after the span of the result belong to it


@dataclass(frozen=True)
class Clock:
    """Converts raw stamps of one sensor to seconds of the result. offset_s: time offset, which is added to the stamps
    to get the body's clock; span: the recording."""

    span: RecordingSpan
    offset_s: float

    @classmethod
    def of(cls, c: Calibration, span: RecordingSpan, sensor: str) -> Clock:
        group = c.group_or_none(sensor, "time_offset")
        return cls(span, 0.0) if group is None else cls.with_offset(c, span, group.value)

    @classmethod
    def with_offset(cls, c: Calibration, span: RecordingSpan, offset_s: np.ndarray) -> Clock:
        """That of a sensor with one time offset, or one for each recording."""
        return cls(span, float(offset_s[c.recordings.index(span) if len(offset_s) > 1 else 0]))

    def seconds(self, stamps_ns: np.ndarray) -> np.ndarray:
        """(n,) seconds of the result from int64 stamps [ns]. Whole nanoseconds are subtracted first, so that no digit
        is lost."""
        since = stamps_ns - np.int64(self.span.origin_ns) + np.int64(round(1e9 * self.offset_s))
        return self.span.start + 1e-9 * since.astype(np.float64)

    def within(self, seconds: np.ndarray) -> np.ndarray:
        """(n,) bool: whether `seconds` (n,) are within the recording, or less than _EDGE_S outside."""
        return (seconds > self.span.start - _EDGE_S) & (seconds < self.span.end + _EDGE_S)


LONGEST_STEP_S = 0.5  # longest interval between keyframes in which poses are interpolated
_AT_KEYFRAME_S = 1e-6  # an instant this close to a keyframe has its pose


@dataclass(frozen=True)
class CubicPath:
    """Cubic Hermite interpolation between K keyframes: of positions, and of the rotation vector from each keyframe to
    the next.

    The slopes at a keyframe are those of the parabola through it and its neighbours; the slope of the rotation is the
    angular rate in the body's axes. seconds: on the clock of the result. usable (K - 1,) bool: whether poses in the
    interval are known.
    """

    seconds: np.ndarray  # (K,)
    rotation: np.ndarray  # (K, 3, 3) R_world_body
    position: np.ndarray  # (K, 3) m, world
    turn: np.ndarray  # (K - 1, 3) rad
    rate: np.ndarray  # (K, 3) rad/s
    slope: np.ndarray  # (K, 3) m/s
    usable: np.ndarray

    @classmethod
    def of(cls, c: Calibration) -> CubicPath:
        path = c.trajectory
        if len(path.seconds) == 1:  # twice, too far apart to be used between them
            rotation, position = (np.repeat(x, 2, axis=0) for x in (path.rotation, path.position))
            path = replace(path, seconds=path.seconds + [0.0, 1.0], rotation=rotation, position=position)
        step = np.diff(path.seconds)
        usable = (np.diff(c.recording_of(path.seconds)) == 0) & (step <= LONGEST_STEP_S)
        between = np.einsum("kji,kjl->kil", path.rotation[:-1], path.rotation[1:])
        turn = so3.log_many(np.ascontiguousarray(between))
        rate = _slopes(turn / step[:, None], step, usable)
        slope = _slopes(np.diff(path.position, axis=0) / step[:, None], step, usable)
        return cls(path.seconds, path.rotation, path.position, turn, rate, slope, usable)

    def at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_world_body (n, 3, 3), p_world_body (n, 3) m at `seconds` (n,) of the result, and (n,) bool: which of them
        are known. The others are those of the nearest keyframe."""
        last = max(len(self.seconds) - 2, 0)
        k = np.clip(np.searchsorted(self.seconds, seconds, side="right") - 1, 0, last)
        h = self.seconds[k + 1] - self.seconds[k]
        s = np.clip((seconds - self.seconds[k]) / h, 0.0, 1.0)
        nearest = np.where(s < 0.5, k, k + 1)
        at_keyframe = np.abs(seconds - self.seconds[nearest]) <= _AT_KEYFRAME_S
        inside = self.usable[k] & (seconds >= self.seconds[0]) & (seconds <= self.seconds[-1])
        s = np.where(inside, s, np.round(s))[:, None]
        turn = self.turn[k]
        # The rate at the later keyframe as a derivative of the rotation vector: inverse right Jacobian, second order.
        far = self.rate[k + 1]
        far = far + 0.5 * np.cross(turn, far) + np.cross(turn, np.cross(turn, far)) / 12.0
        phi = hermite(s, turn, h[:, None] * self.rate[k], h[:, None] * far)
        chord = self.position[k + 1] - self.position[k]
        displacement = hermite(s, chord, h[:, None] * self.slope[k], h[:, None] * self.slope[k + 1])
        R = self.rotation[k] @ so3.exp_many(np.ascontiguousarray(phi))
        return R, self.position[k] + displacement, inside | at_keyframe


def _slopes(between: np.ndarray, step: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """(K, 3) slopes at the keyframes, from the mean slopes `between` (K - 1, 3) over steps (K - 1,) s; those that are
    not `usable` have no weight."""
    weight = np.zeros((2, len(step) + 1))  # of the intervals before and after each keyframe
    weight[0, 1:], weight[1, :-1] = usable, usable
    i = np.flatnonzero((weight > 0.0).all(axis=0))
    weight[0, i], weight[1, i] = step[i], step[i - 1]
    padded = np.zeros((2, len(step) + 1, 3))
    padded[0, 1:], padded[1, :-1] = between, between
    total = np.maximum(weight.sum(axis=0), np.finfo(float).tiny)
    return (weight[:, :, None] * padded).sum(axis=0) / total[:, None]
