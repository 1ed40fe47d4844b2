"""The factor of a position sensor, the random walk of its errors, and how large they are."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.special import ndtr
from scipy.stats import chi2

from icalib.model.sensor_model import frame_of
from icalib.motion.factor import (
    FactorKey,
    FitKey,
    Into,
    RawSize,
    RobustNoise,
    RowFactor,
    Whitened,
    add_rows,
    output_at,
    rows_by_recording,
)
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import EstimatedMotion, instants, offset_at
from icalib.motion.sensor_pose import Kinematics, SensorPose, rows_at
from icalib.optim.arrowhead import Piece
from icalib.optim.rows import KEYFRAME_PAIR_DIM, Rows
from icalib.optim.state import Entry, Key, Layout, State
from icalib.rig.scene import FRAME_OFFSET
from icalib.sensors.position.frame import PositionFrame
from icalib.sensors.position.read import MAX_GAP_STEPS, MIN_OUTLIER_M, MIN_STEP_M
from icalib.sensors.position.stream import PositionStream

# The factor of a position sensor: difference between the trajectory of the IMU and each fix.
#
#     e = R_world_frame^T (p_world_imu + R_world_imu p_imu_sensor - p_world_frame) - p_frame_sensor
#
# at the instant of the fix on the IMU's clock. The IMU's readings propagate the trajectory to that instant; fixes are
# never interpolated. Parameters: translation (p_imu_sensor) and time_offset of the sensor, and those of its frame in
# each recording. These are frame_yaw or frame_rotation with frame_translation, or the tilt of the target: `frame.py`.
# A slow offset of the fixes adds to e: see `OffsetWalkFactor`.

# Fixes further from every keyframe are left out, because residuals neglect the propagated IMU noise. A poor
# accelerometer, of 0.01 m/s^2/sqrt(Hz), adds 1 mm to a position over this time.
NEAR_KEYFRAME_S = 0.3
MAX_REJECTED_SHARE = 0.5  # of the fixes of a sensor; with more, the median that bursts are measured from is a burst's


KINDS = {"horizontal": slice(0, 2), "vertical": slice(2, 3)}


@dataclass(frozen=True)
class PositionNoise:
    """Noise of fixes along x and y (`horizontal`) and z (`vertical`) of the frame: factors on the standard deviations
    of the stream's covariances, or standard deviations [m] if the stream has none. loss: robust loss of each whitened
    row; loss_scale: residual at which it departs from the square, in standard deviations."""

    horizontal: float
    vertical: float
    loss: str = "none"
    loss_scale: float = 2.5

    @property
    def sizes(self) -> np.ndarray:
        """(3,) horizontal, horizontal, vertical."""
        return np.array([self.horizontal, self.horizontal, self.vertical])


@dataclass(frozen=True)
class PositionFactor(RowFactor):
    """n fixes of one sensor. frame: owner of their frame, see `frame_owner`; keyframe (n,): number of the keyframe of
    each fix, increasing; whitening (n, 3, 3): W [1/m] with W^T W the inverse of the covariance; used (n,) bool: False
    for outliers; walk: the slow offset of the fixes, None without any."""

    units: ClassVar[Mapping[str, str]] = {"horizontal": "m", "vertical": "m"}

    name: str
    frame: str
    seconds: np.ndarray  # (n,) since the first stamp on the sensor's clock
    position: np.ndarray  # (n, 3) m
    whitening: np.ndarray
    used: np.ndarray
    keyframe: np.ndarray
    starts: tuple[int, ...]  # the first keyframe of each recording
    n_keyframes: int
    imu: ImuData
    gravity: float
    noise: PositionNoise
    layout: Layout
    walk: OffsetWalk | None = None

    @classmethod
    def build(
        cls, stream: PositionStream, motion: EstimatedMotion, noise: PositionNoise, layout: Layout, frame: str
    ) -> PositionFactor:
        """The factor of the fixes near keyframes and outside gaps of the IMU. The keyframe of each fix does not change
        while the solver runs. The covariances of `stream` give the weights, see `model.weighted`."""
        state, (k, keyframe) = motion.state, motion.near_keyframes(stream, NEAR_KEYFRAME_S)
        whitening, used = stream.root[k] / noise.sizes[:, None], np.ones(len(keyframe), dtype=bool)
        return cls(
            stream.name, frame, stream.seconds[k], stream.position[k], whitening, used, keyframe, state.starts,
            len(state.seconds), motion.imu, motion.gravity, noise, layout,
        )  # fmt: skip

    def with_slow_offset(self, stream: PositionStream, density: float) -> PositionFactor:
        """This factor with a slow offset, a random walk of `density` [m/sqrt(s)]; stream: all fixes of the sensor."""
        walk, root = OffsetWalk.of(stream, self.seconds, density, self.layout), np.linalg.inv(self.whitening)
        covariance = root @ root.transpose(0, 2, 1) + walk.bridge_variance[:, None, None] * np.eye(3)
        return replace(self, whitening=np.linalg.inv(np.linalg.cholesky(covariance)), walk=walk)

    def without_outliers(self, state: State, deviations: float) -> PositionFactor:
        """This factor with `used` False for fixes whose residuals at `state` are outliers, single or in bursts. Most of
        the fixes are no bursts: the trajectory or the noise is wrong then, and rejecting them would hide it."""
        out = output_at(self, state)
        raw = self.raw(out)
        single, burst = outliers_of(out.residual, raw, deviations), bursts_of(self.seconds, raw, self.raw_sigma())
        return replace(self, used=~(single | burst) if (single | burst).mean() <= MAX_REJECTED_SHARE else ~single)

    @property
    def key(self) -> FactorKey:
        return self.name, "positions"

    @property
    def kinds(self) -> dict[str, slice]:
        return KINDS

    def output(self) -> Whitened:
        """Empty arrays for `accumulate` to fill."""
        return Whitened.empty(len(self.seconds), 3)

    def times(self, state: State) -> np.ndarray:
        return self.seconds + offset_at(state, self.name, self.keyframe, self.seconds)

    def raw(self, out: Whitened) -> np.ndarray:
        """(n, 3) residuals in the frame's axes [m]."""
        return np.linalg.solve(self.whitening, out.residual[:, :, None])[:, :, 0]

    def raw_sigma(self) -> np.ndarray:
        """(n, 3) standard deviations of `raw` in the frame's axes [m]."""
        return np.sqrt((np.linalg.inv(self.whitening) ** 2).sum(axis=2))

    def count(self, out: Whitened, kind: str) -> int:
        """Number of scalar residuals of a kind in use."""
        return int((out.root[:, self.kinds[kind]] > 0.0).sum())

    def sizes(self, out: Whitened) -> dict[FitKey, RawSize]:
        """See `Factor`; the RMS is that of fixes in use."""
        raw, used = self.raw(out), out.root[:, 0] > 0.0
        return {
            (self.name, kind): RawSize(rms(raw[used][:, c]), "m", int((~used).sum())) for kind, c in self.kinds.items()
        }

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        into, parts = (
            Into(piece, out, sums, curved),
            rows_by_recording(self.keyframe, self.starts, self.n_keyframes, piece),
        )
        return sum(self._of_recording(k, block, state, into) for k, block in parts)

    def _of_recording(self, recording: int, block: slice, state: State, into: Into) -> float:
        """Adds the fixes `block`, all of one recording, to `into`; returns their cost."""
        frame, keyframe = PositionFrame.of(self.frame, recording, state.values), self.keyframe[block]
        kinematics = Kinematics.of(self)
        at = SensorPose.at(kinematics, self.seconds[block], keyframe, state, into.sums)
        rows = self._rows(block, frame, at, state, into.sums)
        columns = np.concatenate([kinematics.columns(recording), frame.columns(self.layout)])
        return self._add(rows, block, rows.on_intervals(keyframe, self.n_keyframes), columns, into)

    def _rows(self, block: slice, frame: PositionFrame, at: SensorPose, state: State, jacobians: bool) -> Rows:
        """Residuals (n, 3) m of the fixes `block`, with derivatives by the keyframes, then the calibration parameters
        of the sensor's pose, of the frame, and of the knots before and after each fix."""
        inside, walk = frame.inward(at.position), self.walk
        residual = inside - self.position[block]
        if walk is not None:
            residual += walk.offsets(block, state)
        if not jacobians:
            return rows_at(residual, (), (at,), np.zeros((0, 3, 0)))
        J_pose = np.concatenate([np.zeros((len(inside), 3, 3)), frame.rotation.T @ at.rotation], axis=2)
        J_calib = [frame.jacobian(inside)] if walk is None else [frame.jacobian(inside), walk.weights(block)]
        return rows_at(residual, (J_pose,), (at,), np.concatenate(J_calib, axis=2))

    def _add(self, rows: Rows, block: slice, interval: np.ndarray, columns: np.ndarray, into: Into) -> float:
        """Adds the rows `block`, outliers with weight 0, to `into`; returns their cost. columns: calibration columns
        that all rows share; interval: number of the keyframe interval of each row."""
        W, used, cost = self.whitening[block], self.used[block], 0.0
        weighted = np.where(used[:, None, None], W, 0.0)
        everything = [(slice(0, len(used)), np.zeros(0, dtype=np.int64))]
        for part, knots in everything if self.walk is None else self.walk.stretches(block):
            some = Rows(rows.residual[part], rows.J[part])
            where = slice(block.start + part.start, block.start + part.stop)
            noise = RobustNoise(weighted[part], self.noise.loss, self.noise.loss_scale)
            cost += add_rows(some, where, interval[part], np.concatenate([columns, knots]), noise, into)
        into.out.residual[block][~used] = np.einsum("nij,nj->ni", W[~used], rows.residual[~used])
        into.out.root[block][~used] = 0.0
        return cost


# A slow offset of the fixes: a random walk of each axis of the frame, represented by its values at knots.
#
#     b(t) = (1 - a) b_j + a b_(j+1),  a = (t - t_j) / S,  b_0 = 0        between knots t_j, S apart
#     r_j = (b_(j+1) - b_j) / (q sqrt(S))                                q: density of the walk [m/sqrt(s)]
#
# The increments between knots are exactly those of a random walk. Between two knots a walk is a Brownian bridge. Its
# variance q^2 S a (1 - a) about the line is added to that of each fix, and its correlation is neglected (the FITC
# approximation of Gaussian processes; Snelson and Ghahramani 2006). The origin of the frame absorbs b_0.
#
# The offsets at knots are calibration parameters. An offset in the state of each keyframe would be exact, but it would
# enlarge the blocks of every rig.

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
        return {SLOW_OFFSET: slice(0, 3)}

    def with_imu(self, imu: ImuData, state: State) -> OffsetWalkFactor:
        """This factor unchanged: it does not depend on the motion."""
        return self

    def output(self) -> Whitened:
        """Empty arrays for `accumulate` to fill."""
        return Whitened.empty(len(self.seconds), 3)

    def times(self, state: State) -> np.ndarray:
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


# Outliers, bursts of wrong fixes, and a slow random walk, found in the residuals of fixes.
#
# Some fixes do not fit the trajectory. They are single, or they come in bursts: consecutive fixes with a common
# offset, as between buildings.
#
# The first pass bounds their influence by Huber's loss, which is convex. Each later pass begins by rejecting fixes
# with large residuals, and is a least-squares fit to the rest. The median of the residuals gives their scale
# (reweighted least squares; Rousseeuw and Leroy, Robust Regression and Outlier Detection, 1987, section 1.2). A
# rejected fix is tested again before each pass.
#
# A long burst pulls the trajectory towards it, so that its residuals are small. The IMU does not let the trajectory
# jump between neighbouring fixes. Residuals therefore step by the whole offset at the begin and at the end of the
# burst.

MIN_STEP_SIGMAS = 6.0  # of a step of the residuals: noise exceeds it in 1 of 10^8 steps
STRUCTURE_LAG_S = 1.0  # longest lag: over longer ones the trajectory absorbs most of the slow errors


def outliers_of(whitened: np.ndarray, raw: np.ndarray, deviations: float) -> np.ndarray:
    """(n,) bool: True for outliers, by the residuals of the fixes, whitened (n, 3) and raw (n, 3) m.

    Horizontal and vertical residuals are scaled by the median of each group, so that the size of the noise need not be
    known. deviations: limit in standard deviations of a normal variable. The limit on chi^2 has the same probability.
    """
    rare, outliers = 2.0 * ndtr(-deviations), np.zeros(len(whitened), dtype=bool)
    for columns, freedom in ((slice(0, 2), 2), (slice(2, 3), 1)):
        squares = (whitened[:, columns] ** 2).sum(axis=1)
        typical = np.median(squares) / chi2.ppf(0.5, freedom) if len(squares) else 1.0
        far = np.linalg.norm(raw[:, columns], axis=1) > MIN_OUTLIER_M
        outliers |= far & (squares > typical * chi2.isf(rare, freedom))
    return outliers


def bursts_of(seconds: np.ndarray, raw: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """(n,) bool: True for fixes at `seconds` (n,) in bursts, which begin and end with a step of the residuals. raw,
    sigma (n, 3) m: residuals, and their standard deviations up to a common factor.

    The sum of the steps gives the offset of each fix from the first one. Between two gaps, fixes with an offset more
    than MIN_STEP_M from the median offset are in a burst.
    """
    wrong, dt = np.zeros(len(seconds), dtype=bool), np.diff(seconds)
    if not len(dt):
        return wrong
    moved = np.diff(raw, axis=0)
    size, expected = (moved**2).sum(axis=1), (sigma[1:] ** 2 + sigma[:-1] ** 2).sum(axis=1)
    typical = np.median(size / expected) * 3.0 / chi2.ppf(0.5, 3)
    gap = dt > MAX_GAP_STEPS * np.median(dt)
    is_step = (size > MIN_STEP_M**2) & (size > MIN_STEP_SIGMAS**2 * typical * expected) & ~gap
    offset = np.cumsum(np.vstack([np.zeros(3), np.where(is_step[:, None], moved, 0.0)]), axis=0)
    for fixes in np.split(np.arange(len(seconds)), np.flatnonzero(gap) + 1):
        wrong[fixes] = np.linalg.norm(offset[fixes] - np.median(offset[fixes], axis=0), axis=1) > MIN_STEP_M
    return wrong


def random_walk_of(seconds: np.ndarray, raw: np.ndarray) -> float:
    """Density q [m/sqrt(s)] of the random walk in residuals `raw` (n, 3) m at `seconds` (n,), beside white noise.
    Residuals that are NaN are ignored. The result is too small by a fifth, as the trajectory absorbs some of a walk.

    q follows from the structure function D(h) = <(r(t + h) - r(t))^2> = 2 sigma^2 + q^2 h, at the lags h of one fix and
    of STRUCTURE_LAG_S.
    """
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else STRUCTURE_LAG_S
    longer = max(2, round(STRUCTURE_LAG_S / step))
    if len(seconds) <= longer:
        return 0.0
    short, long = (float(np.nanmean((raw[k:] - raw[:-k]) ** 2)) for k in (1, longer))
    return float(np.sqrt(max(long - short, 0.0) / ((longer - 1) * step)))


def rms(x: np.ndarray) -> float:
    """Root mean square of all entries of `x`; 0 if `x` is empty."""
    return float(np.sqrt(np.mean(x**2))) if x.size else 0.0
