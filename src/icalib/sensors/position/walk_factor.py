"""A slow offset of the fixes: a random walk of each axis of the frame, represented by its values at knots.

    b(t) = (1 - a) b_j + a b_(j+1),  a = (t - t_j) / S,  b_0 = 0        between knots t_j, S apart
    r_j = (b_(j+1) - b_j) / (q sqrt(S))                                q: density of the walk [m/sqrt(s)]

The increments between knots are exactly those of a random walk. Between two knots a walk is a Brownian bridge. Its
variance q^2 S a (1 - a) about the line is added to that of each fix, and its correlation is neglected (the FITC
approximation of Gaussian processes; Snelson and Ghahramani 2006). The origin of the frame absorbs b_0.

The offsets at knots are calibration parameters. An offset in the state of each keyframe would be exact, but it would
enlarge the blocks of every rig.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np

from icalib.model.frames import frame_of
from icalib.motion.factor import FactorKey, RowFactor, Whitened
from icalib.motion.imu_data import ImuData
from icalib.motion.row_sums import Into, RobustNoise, add_rows
from icalib.motion.sweep import EstimatedMotion
from icalib.motion.time_offsets import instants
from icalib.optim.arrowhead import Piece
from icalib.optim.rows import KEYFRAME_PAIR_DIM, Rows
from icalib.optim.state import Entry, Key, Layout, State
from icalib.rig.scene import FRAME_OFFSET
from icalib.sensors.position.stream import PositionStream

# Knots of all recordings together. Each adds 3 calibration parameters, which take 7 MB for an hour at 5 Hz. Knots are
# 1.3 s apart in a recording of 60 s, 75 s in one of an hour.
MAX_KNOTS = 48
MIN_KNOTS = 4  # in each recording
SLOW_OFFSET = "slow offset"


def knot_keys(sensor: str, recording: int, n_recordings: int) -> list[Key]:
    """Keys of the offsets at the knots of one recording, without the first knot, where the offset is 0."""
    count = max(MIN_KNOTS, MAX_KNOTS // n_recordings)
    frame = frame_of(sensor, recording)
    return [(f"{frame} at knot {j}", FRAME_OFFSET.name) for j in range(1, 1 + count)]


def knot_entries(sensor: str, n_recordings: int) -> list[Entry]:
    """Entries of the layout for the knots of all recordings."""
    return [FRAME_OFFSET.entry(owner) for k in range(n_recordings) for owner, _ in knot_keys(sensor, k, n_recordings)]


class _Segment(NamedTuple):
    """Time between two knots. begin: s since the first stamp; duration [s]; left, right: keys of the offsets at the
    knots; left is None for the first knot, where the offset is 0."""

    recording: int
    begin: float
    duration: float
    left: Key | None
    right: Key


@dataclass(frozen=True)
class OffsetWalk:
    """The slow offset of n fixes. density: q [m/sqrt(s)]; segments: of all recordings, in order of time; segment (n,):
    number of the segment of each fix, increasing; share (n,): a in 0 to 1, the position of each fix in its segment."""

    density: float
    segments: tuple[_Segment, ...]
    segment: np.ndarray
    share: np.ndarray
    layout: Layout

    @classmethod
    def of(cls, stream: PositionStream, at: np.ndarray, density: float, layout: Layout) -> OffsetWalk:
        """The offset at instants `at` (n,), s since the first stamp of `stream`. Knots are equally spaced from the
        first fix of a recording to its last."""
        n_recordings = len(stream.joins_ns) + 1
        firsts = np.searchsorted(stream.stamps_ns, stream.joins_ns)
        segments: list[_Segment] = []
        for k, seconds in enumerate(np.split(stream.seconds, firsts)):
            keys = knot_keys(stream.name, k, n_recordings)
            edges = np.linspace(seconds[0], seconds[-1], len(keys) + 1)
            before = [None, *keys[:-1]]
            segments += [_Segment(k, *x) for x in zip(edges[:-1], np.diff(edges), before, keys, strict=True)]
        begins = np.array([s.begin for s in segments])
        segment = np.maximum(np.searchsorted(begins, at, side="right") - 1, 0)
        durations = np.array([s.duration for s in segments])
        share = np.clip((at - begins[segment]) / durations[segment], 0.0, 1.0)
        return cls(density, tuple(segments), segment, share, layout)

    @cached_property
    def columns(self) -> np.ndarray:
        """(s, 6) calibration columns of the knots at the begin and end of each segment, -1 for the first knot."""
        none = np.full(3, -1)
        pairs = ((s.left, s.right) for s in self.segments)
        rows = [[none if key is None else self.layout.columns(*key) for key in pair] for pair in pairs]
        return np.array(rows).reshape(-1, 6)

    def knots(self, state: State) -> np.ndarray:
        """(s, 2, 3) m: the offsets at the begin and end of each segment."""
        zero, values = np.zeros(3), state.values
        return np.array([[zero if s.left is None else values[s.left], values[s.right]] for s in self.segments])

    @property
    def bridge_variance(self) -> np.ndarray:
        """(n,) m^2: variance of the walk about the line between knots at each fix, the same for each axis."""
        durations = np.array([s.duration for s in self.segments])[self.segment]
        return self.density**2 * durations * self.share * (1.0 - self.share)

    def offsets(self, block: slice, state: State) -> np.ndarray:
        """(n, 3) m: offsets of the fixes `block`."""
        before, after = self.knots(state)[self.segment[block]].transpose(1, 0, 2)
        share = self.share[block, None]
        return (1.0 - share) * before + share * after

    def weights(self, block: slice) -> np.ndarray:
        """(n, 3, 6) derivatives of the offsets of the fixes `block` by the knots before and after."""
        share = self.share[block, None, None]
        return np.concatenate([(1.0 - share) * np.eye(3), share * np.eye(3)], axis=2)

    def stretches(self, block: slice) -> Iterator[tuple[slice, np.ndarray]]:
        """For each segment with fixes of `block`: the slice of these fixes, relative to block.start, and the
        calibration columns (6,) of the segment."""
        segment = self.segment[block]
        edges = [0, *(np.flatnonzero(np.diff(segment)) + 1).tolist(), len(segment)]
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            if a < b:
                yield slice(a, b), self.columns[segment[a]]


@dataclass(frozen=True)
class OffsetWalkFactor(RowFactor):
    """Random-walk prior on the slow offset of one sensor: the increment over each of s segments. seconds (s,): ends of
    the segments, on the sensor's clock since its first stamp; interval (s,): number of the keyframe interval to which
    each row is added, increasing."""

    units: ClassVar[Mapping[str, str]] = {SLOW_OFFSET: "m"}

    name: str
    walk: OffsetWalk
    seconds: np.ndarray
    interval: np.ndarray

    @classmethod
    def build(cls, stream: PositionStream, motion: EstimatedMotion, density: float, layout: Layout) -> OffsetWalkFactor:
        """Each row belongs to the keyframe interval at the end of its segment, so that a part of a recording contains
        the rows of its segments."""
        walk, state = OffsetWalk.of(stream, np.zeros(0), density, layout), motion.state
        seconds = np.array([s.begin + s.duration for s in walk.segments])
        recording = np.array([s.recording for s in walk.segments])
        ends = np.array([*state.starts[1:], len(state.seconds)])[recording]
        before = np.searchsorted(state.seconds, instants(stream, state.values, seconds)) - 1
        interval = np.clip(before, np.array(state.starts)[recording], ends - 2)
        return cls(stream.name, walk, seconds, interval)

    @property
    def key(self) -> FactorKey:
        return self.name, SLOW_OFFSET

    @property
    def kinds(self) -> dict[str, slice]:
        """See `Factor`."""
        return {SLOW_OFFSET: slice(0, 3)}

    def with_imu(self, imu: ImuData, state: State) -> OffsetWalkFactor:
        """This factor unchanged: it does not depend on the motion."""
        del imu, state
        return self

    def output(self) -> Whitened:
        """Empty arrays for `accumulate` to fill."""
        return Whitened.empty(len(self.seconds), 3)

    def times(self, state: State) -> np.ndarray:
        """See `RowFactor`."""
        offset = state.values[self.name, "time_offset"]
        recording = np.array([s.recording for s in self.walk.segments])
        return self.seconds + offset[recording if len(offset) > 1 else 0]

    @property
    def sigma(self) -> np.ndarray:
        """(s,) standard deviations of the increments [m]."""
        return self.walk.density * np.sqrt([s.duration for s in self.walk.segments])

    def raw(self, out: Whitened) -> np.ndarray:
        """(s, 3) increments [m]."""
        return out.residual * self.sigma[:, None]

    def raw_sigma(self) -> np.ndarray:
        """(s, 3) standard deviations of `raw` [m]."""
        return np.tile(self.sigma[:, None], (1, 3))

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`."""
        into, knots = Into(piece, out, sums, curved), self.walk.knots(state)
        increments, whitening = knots[:, 1] - knots[:, 0], np.eye(3) / self.sigma[:, None, None]
        J = np.zeros((1 if sums else 0, 3, KEYFRAME_PAIR_DIM + 6))
        J[:, :, KEYFRAME_PAIR_DIM:] = np.concatenate([-np.eye(3), np.eye(3)], axis=1)
        cost = 0.0
        first, last = (int(j) for j in np.searchsorted(self.interval, [piece.first, piece.last]))
        for j in range(first, last):
            row = slice(j, j + 1)
            noise = RobustNoise(whitening[row], "none", 1.0)
            rows = Rows(increments[row], J)
            cost += add_rows(rows, row, self.interval[row], self.walk.columns[j], noise, into)
        return cost
