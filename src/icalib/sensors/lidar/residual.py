"""Points of one LiDAR on planes (paper (23)-(26)).

residual = n . (p_world_lidar(t) + R_world_lidar(t) x) - d of each point x at its own instant t. Of (24) and (25) this
is the form that keeps its sign on both sides of the plane. What a factor holds are moments of the points
(`take_moments`), taken once a pass: robust weights, like the association with planes, stay as they are while the solver
runs. Its residuals are the four of each plane in a bin that stand for all points there (`kernels`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.motion.clocks import by_clock, instants, offset_at
from icalib.motion.factor import FactorKey, RowFactor, Whitened
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import assign_keyframes
from icalib.motion.sensor_pose import Kinematics, SensorPose
from icalib.motion.sweep import Motion as ImuMotion
from icalib.optim.arrowhead import Piece, in_parallel
from icalib.optim.planes import Planes
from icalib.optim.state import Key, Layout, State
from icalib.rig import Scheme
from icalib.sensors.lidar import kernels
from icalib.sensors.lidar.binning import BIN_S, Associated, LidarNoise, Moments, take_moments
from icalib.sensors.lidar.kernels import ROWS, Bins

CHUNK = 512  # bins at a time: what a chunk needs stays in the cache


@dataclass(frozen=True)
class LidarFactor(RowFactor):
    """All scans of one LiDAR. `keyframe` (n,), increasing: the keyframe that each bin of `moments` hangs on; walked
    (n,), turned (E, 3, 4), slope (E, 3): see `Bins`, at the state that the pass starts from; planes: keys of the values
    that the rows of the moments' planes have in a state."""

    name: str
    moments: Moments
    keyframe: np.ndarray
    walked: np.ndarray
    turned: np.ndarray
    slope: np.ndarray
    planes: tuple[Key, ...]
    imu: ImuData
    gravity: float
    scheme: Scheme
    layout: Layout
    n_keyframes: int

    @classmethod
    def build(
        cls,
        stream: LidarStream,
        plane: np.ndarray,
        planes: tuple[Key, ...],
        motion: ImuMotion,
        noise: LidarNoise,
        layout: Layout,
        scheme: Scheme = "inertial",
        bin_s: float = BIN_S,
    ) -> LidarFactor:
        """The factor of a pass that starts from `motion`. plane (N,) int32: index into `planes` of each point, -1:
        none. Raises EstimationError where no point is left."""
        values = np.array([motion.state.values[p] for p in planes])
        moments = take_moments(Associated(stream, plane, values), motion, noise, bin_s)
        times = instants(stream, motion.state.values, moments.seconds)
        keyframe = assign_keyframes(scheme, motion.state.seconds, times)
        n_keyframes = len(motion.state.seconds)
        walked = motion.imu.turned_by_noise(motion.state.seconds[keyframe], times)
        if scheme != "inertial":
            walked[:] = 0.0
        entries = len(moments.plane)
        factor = cls(
            stream.name, moments, keyframe, walked, np.zeros((entries, 3, ROWS), np.float32),
            np.zeros((entries, 3), np.float32), planes, motion.imu, motion.gravity, scheme, layout, n_keyframes,
        )  # fmt: skip
        factor._turn_by_noise(motion.state)
        return factor

    def _turn_by_noise(self, state: State) -> None:
        """Fills `turned` and `slope`, on two threads."""

        def turn(ends: tuple[int, int]) -> None:
            for bins, at, columns, planes in self._chunks(state, *ends):
                kernels.turn_by_noise(bins, at, columns, planes)

        middle = len(self.keyframe) // 2
        in_parallel(turn, [(0, middle), (middle, len(self.keyframe))])

    @cached_property
    def _of_planes(self) -> np.ndarray:
        """(P, 3) calibration columns of each plane."""
        return np.array([self.layout.block(*p).columns for p in self.planes])

    @property
    def key(self) -> FactorKey:
        return self.name, "points"

    @property
    def kinds(self) -> dict[str, slice]:
        """See `RowFactor`."""
        return {"points": slice(0, ROWS)}

    def output(self) -> Whitened:
        """Empty rows (E, 4) for `accumulate` to fill; the moments hold the robust weights."""
        return Whitened.without_loss(len(self.moments.plane), ROWS)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`. `curved` changes nothing: within a pass weights are constant."""
        del curved
        into, total = piece.sums(sums), 0.0
        for bins, at, columns, planes in self._chunks(state, *self._bins_of(piece)):
            total += kernels.accumulate(bins, at, columns, planes, into, out.residual)
        return total

    def count(self, out: Whitened, kind: str) -> int:
        """The points: their chi^2 is that of the rows, exactly."""
        del out, kind
        return int(self.moments.count.sum())

    def times(self, state: State) -> np.ndarray:
        """(E,) the middle of the bin of each plane's rows."""
        at = self.moments.seconds + offset_at(state, self.name, self.keyframe)
        return np.repeat(at, np.diff(self.moments.start))

    def rms(self, out: Whitened, kind: str) -> tuple[float, str]:
        """Of the points' distances to their planes, weighted as they are."""
        del kind
        weight = float((self.moments.root[:, 0] ** 2).sum())
        return float(np.sqrt((out.residual**2).sum() / weight)), "m"

    def _chunks(self, state: State, b0: int, b1: int) -> Iterator[tuple[Bins, SensorPose, np.ndarray, Planes]]:
        """Bins b0..b1 by the chunk, with the LiDAR's poses, their calibration columns (c,), and the planes."""
        planes, m = Planes.of(self.planes, state, self._of_planes), self.moments
        kinematics = Kinematics(self.name, self.layout, self.imu, self.gravity, self.scheme)
        for columns, a, b in self._stretches(state, kinematics, b0, b1):
            keyframe = self.keyframe[a:b]
            bins = Bins(
                keyframe, self.walked[a:b], m.start[a : b + 1], m.plane, m.root, m.slant, self.turned, self.slope
            )
            yield bins, SensorPose.at(kinematics, m.seconds[a:b], keyframe, state), columns, planes

    def _stretches(
        self, state: State, kinematics: Kinematics, b0: int, b1: int
    ) -> Iterator[tuple[np.ndarray, int, int]]:
        """Bins b0..b1 by the chunk, each with the calibration columns (c,) of its pose."""
        for clock, own in by_clock(state, self.name, self.keyframe[b0:b1]):
            columns = kinematics.columns(clock)
            first, last = b0 + own.start, b0 + own.stop
            # Bins on one side of a keyframe stay together.
            sides = np.flatnonzero(np.diff(2 * self.keyframe[first:last] + (self.walked[first:last] >= 0.0))) + 1
            sides = np.append(sides, last - first)
            ends = sides[np.searchsorted(sides, np.arange(CHUNK, last - first, CHUNK))]
            for a, b in pairwise(np.unique([0, *ends, last - first])):
                yield columns, first + int(a), first + int(b)

    def _bins_of(self, piece: Piece) -> tuple[int, int]:
        """The bins that belong to `piece`: keyframes from first to before last, the chain's very last keyframe
        included."""
        stop = piece.last + 1 if piece.last == self.n_keyframes - 1 else piece.last
        b0, b1 = np.searchsorted(self.keyframe, [piece.first, stop])
        return int(b0), int(b1)
