"""Poses that a sensor reports, motion capture or another program's odometry, against the motion of the IMU.

`AbsolutePoseFactor`: each pose at its own instant, in a frame that stands still in the world of each recording.
`RelativePosesFactor`: the way from one pose to another, about from node to node; their frame may drift.

The sensor's parameters are the blocks rotation, translation (R_imu_sensor, p_imu_sensor), time_offset, and scale (1,),
true lengths over reported ones. A position is predicted / scale - reported: the noise is that of what is reported, and
a scale on it would be drawn to where it makes the noise less. The frame has the blocks frame_rotation and
frame_translation (R_world_frame, p_world_frame), in each recording its own.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import numpy as np

from icalib.data.measurements import PoseStream
from icalib.model.frames import FRAME, frame_of
from icalib.motion.clocks import by_clock, instants, mounted_columns, offset_at
from icalib.motion.factor import FactorKey, RowFactor, Whitened
from icalib.motion.imu_data import ImuData
from icalib.motion.nodes import MERGED_WITHIN_S, usable
from icalib.motion.pose_rows import Frame, Mount, PoseRows, absolute_rows, add_chain_rule, relative_rows
from icalib.motion.poses import Poses, assign_nodes, poses_alone, poses_at, poses_of_nodes
from icalib.motion.row_sums import Into, RobustNoise, add_rows, in_chunks
from icalib.motion.stamp_intervals import StampIntervals, choose_intervals
from icalib.motion.sweep import Motion
from icalib.optim.arrowhead import Piece
from icalib.optim.interval_sums import Rows
from icalib.optim.state import NODE, Layout, State

NEAR_NODE_S = 0.05  # a pose further from all nodes is left out: the IMU alone would carry it there
KINDS = {"rotation": slice(0, 3), "position": slice(3, 6)}
UNITS = {"rotation": "rad", "position": "m"}


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of each axis, rad and m; of relative poses densities, rad/sqrt(s) and m/sqrt(s). The robust
    loss of each whitened row, and where it bends, in standard deviations."""

    rotation: float
    position: float
    loss: str = "none"
    loss_scale: float = 2.5


class _PoseFactor(RowFactor):
    """What both factors of poses share: three rows of rotation and three of position each. name: of the sensor."""

    units: ClassVar[dict[str, str]] = UNITS

    name: str
    rotation: np.ndarray

    @property
    def sigma(self) -> np.ndarray:
        """(n, 6) of each row."""
        raise NotImplementedError

    @property
    def key(self) -> FactorKey:
        return self.name, "poses"

    @property
    def kinds(self) -> dict[str, slice]:
        """See `Factor`."""
        return KINDS

    def output(self) -> Whitened:
        """Empty arrays for `accumulate` to fill."""
        return Whitened.empty(len(self.rotation), 6)

    def rms(self, out: Whitened, kind: str) -> tuple[float, str]:
        """Of the residuals of `kind`."""
        return _rms(out, self.sigma, KINDS[kind]), UNITS[kind]


@dataclass(frozen=True)
class AbsolutePoseFactor(_PoseFactor):
    """n poses of one sensor in its frame, see `pose_rows.absolute_rows`. node (n,), in order: of each; sigma: of its
    rotation [rad] and position [m]. imu: None where poses were taken at nodes, which nothing ties to each other."""

    name: str
    seconds: np.ndarray  # (n,) since the first stamp on the sensor's clock
    rotation: np.ndarray  # (n, 3, 3)
    position: np.ndarray  # (n, 3)
    node: np.ndarray
    starts: tuple[int, ...]  # the first node of each recording
    n_nodes: int
    imu: ImuData | None
    gravity: float
    noise: PoseNoise
    layout: Layout

    @classmethod
    def build(cls, stream: PoseStream, motion: Motion, noise: PoseNoise, layout: Layout) -> AbsolutePoseFactor:
        """Of the poses that lie near nodes; those in gaps of the IMU that are not bridged are left out."""
        state = motion.state
        times = instants(stream, state.values)
        node = assign_nodes("inertial", state.seconds, times, motion.imu.forwards)
        near = np.abs(times - state.seconds[node]) <= NEAR_NODE_S
        k = np.flatnonzero(near & usable(motion.imu, times, motion.max_gap_s))
        k = k[np.argsort(node[k], kind="stable")]
        return cls(
            stream.name, stream.seconds[k], stream.rotation[k], stream.position[k], node[k], state.starts,
            len(state.seconds), motion.imu, motion.gravity, noise, layout,
        )  # fmt: skip

    @classmethod
    def at_nodes(
        cls, stream: PoseStream, state: State, starts: tuple[int, ...], noise: PoseNoise, layout: Layout
    ) -> AbsolutePoseFactor:
        """Of the poses that were taken at a node, without an IMU; starts: the first node of each recording."""
        times = instants(stream, state.values)
        node = np.searchsorted(0.5 * (state.seconds[1:] + state.seconds[:-1]), times)
        k = np.flatnonzero(np.abs(times - state.seconds[node]) <= MERGED_WITHIN_S)
        return cls(
            stream.name, stream.seconds[k], stream.rotation[k], stream.position[k], node[k], starts,
            len(state.seconds), None, 0.0, noise, layout,
        )  # fmt: skip

    @property
    def instants(self) -> np.ndarray:
        """(n,) that the rows are at, on the sensor's clock."""
        return self.seconds

    @property
    def sigma(self) -> np.ndarray:
        """(n, 6) of each row."""
        return np.tile(np.repeat([self.noise.rotation, self.noise.position], 3), (len(self.seconds), 1))

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`."""
        cost, at = 0.0, np.minimum(self.node, self.n_nodes - 2)  # the sums take intervals: the last node is an end
        edges = np.searchsorted(self.node, (*self.starts, self.n_nodes))
        low, high = np.searchsorted(at, [piece.first, piece.last])
        for k in range(len(self.starts)):
            own = slice(max(int(edges[k]), int(low)), min(int(edges[k + 1]), int(high)))
            for some in in_chunks(own):
                cost += self._of_recording(k, some, at[some], state, Into(piece, out, sums, curved))
        return cost

    def _of_recording(self, recording: int, own: slice, at: np.ndarray, state: State, into: Into) -> float:
        """Adds the poses `own`, of one recording; at: the first node of the interval that each is added to."""
        frame = frame_of(self.name, recording)
        v, node = state.values, self.node[own]
        found = Frame(v[frame, FRAME[0]], v[frame, FRAME[1]])
        poses = _poses(self, self.seconds[own], node, state, into.sums)
        rows = absolute_rows(
            poses.rotation,
            poses.position,
            _mount(self.name, state),
            found,
            self.rotation[own],
            v[self.name, "scale"][0] * self.position[own],
            into.sums,
        )
        made = _chained(rows, _Scaling.of(self, state, own), (poses,))
        if into.sums:
            last = node > at
            made.J_next[last] = made.J_node[last]
            made.J_node[last] = 0.0
        columns = np.concatenate(
            [
                mounted_columns(self.layout, self.name, recording),
                self.layout.columns(frame, *FRAME),
                self.layout.columns(self.name, "scale"),
            ]
        )
        return _add(self, own, made, columns, at, into)


@dataclass(frozen=True)
class RelativePosesFactor(_PoseFactor):
    """n ways of one sensor, see `pose_rows.relative_rows`, each between two of its stamps about from node to node;
    duration (n,) s. Their noise is that of a random walk, and independent."""

    name: str
    seconds: np.ndarray  # (N,) stamps since the first on the sensor's clock
    intervals: StampIntervals
    rotation: np.ndarray  # (n, 3, 3)
    position: np.ndarray  # (n, 3)
    imu: ImuData
    gravity: float
    noise: PoseNoise
    layout: Layout

    @classmethod
    def build(cls, stream: PoseStream, motion: Motion, noise: PoseNoise, layout: Layout) -> RelativePosesFactor:
        """Chooses the stretches at the time offset and the nodes of the motion."""
        state, seconds = motion.state, stream.seconds
        times = instants(stream, state.values)
        found = choose_intervals(motion.imu, state.seconds, state.starts, times)
        R0, R1 = stream.rotation[found.first], stream.rotation[found.last]
        way = stream.position[found.last] - stream.position[found.first]
        position = np.einsum("nji,nj->ni", R0, way)
        rotation = np.ascontiguousarray(R0.transpose(0, 2, 1) @ R1)
        return cls(stream.name, seconds, found, rotation, position, motion.imu, motion.gravity, noise, layout)

    @property
    def instants(self) -> np.ndarray:
        """(n,) at which the stretches begin, on the sensor's clock."""
        return self.seconds[self.intervals.first]

    @property
    def sigma(self) -> np.ndarray:
        """(n, 6) of each row."""
        duration = self.seconds[self.intervals.last] - self.seconds[self.intervals.first]
        return np.sqrt(duration)[:, None] * np.repeat([self.noise.rotation, self.noise.position], 3)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`."""
        low, high = (int(k) for k in np.searchsorted(self.intervals.node, [piece.first, piece.last]))
        into, cost = Into(piece, out, sums, curved), 0.0
        for clock, part in by_clock(state, self.name, self.intervals.node[low:high]):
            for some in in_chunks(slice(low + part.start, low + part.stop)):
                cost += self._of_clock(clock, some, state, into)
        return cost

    def _of_clock(self, clock: int, own: slice, state: State, into: Into) -> float:
        """Adds the ways `own`, which go by one time offset."""
        first, last, node = (x[own] for x in (self.intervals.first, self.intervals.last, self.intervals.node))
        a = _poses(self, self.seconds[first], node, state, into.sums)
        b = _poses(self, self.seconds[last], node + 1, state, into.sums)
        rows = relative_rows(
            (a.rotation, b.rotation),
            (a.position, b.position),
            _mount(self.name, state),
            self.rotation[own],
            state.values[self.name, "scale"][0] * self.position[own],
            into.sums,
        )
        made = _chained(rows, _Scaling.of(self, state, own), (a, b))
        columns = np.append(mounted_columns(self.layout, self.name, clock), self.layout.columns(self.name, "scale"))
        return _add(self, own, made, columns, node, into)


PoseFactor = AbsolutePoseFactor | RelativePosesFactor


def _rms(out: Whitened, sigma: np.ndarray, rows: slice) -> float:
    return float(np.sqrt(np.mean((out.residual * sigma)[:, rows] ** 2)))


def _mount(name: str, state: State) -> Mount:
    return Mount(state.values[name, "rotation"], state.values[name, "translation"])


def _poses(factor: PoseFactor, seconds: np.ndarray, node: np.ndarray, state: State, jacobians: bool) -> Poses:
    if factor.imu is None:
        return poses_of_nodes(node, state)
    times = seconds + offset_at(state, factor.name, node)
    if not jacobians:
        return poses_alone(times, node, state, factor.imu, factor.gravity)
    imu_free = factor.layout.is_free(factor.imu.name, "intrinsics")
    return poses_at("inertial", times, node, state, factor.imu, factor.gravity, imu_free)


class _Scaling(NamedTuple):
    """True lengths over reported ones, and the positions (n, 3) m that are reported."""

    scale: float
    reported: np.ndarray

    @classmethod
    def of(cls, factor: PoseFactor, state: State, own: slice) -> _Scaling:
        return cls(float(state.values[factor.name, "scale"][0]), factor.position[own])


def _chained(rows: PoseRows, scaling: _Scaling, ends: tuple[Poses, ...]) -> Rows:
    """The rows, of reported positions times their scale, as rows of reported ones; by the nodes of each of their
    `ends`, and by the calibration parameters: mount, time, frame, scale, IMU intrinsics."""
    n, own = rows.J_mount.shape[0], rows.J_mount.shape[2]
    time = slice(own, own + 1)
    frame = slice(time.stop, time.stop + rows.J_frame.shape[2])
    imu = slice(frame.stop + 1, frame.stop + 1 + ends[0].J_imu.shape[2])
    J_calib = np.zeros((n, 6, imu.stop))
    J_calib[:, :, :own], J_calib[:, :, frame] = rows.J_mount, rows.J_frame
    J_nodes = np.zeros((2, n, 6, NODE))
    for J_pose, poses, J_node in zip(rows.J_pose, ends, J_nodes, strict=False):
        moved = poses.J_node, poses.J_imu, poses.rate, poses.velocity
        add_chain_rule(J_pose, moved, J_node, J_calib[:, :, own], J_calib[:, :, imu])
    for x in (rows.residual, *J_nodes, J_calib):
        x[:, 3:] /= scaling.scale
    if n:
        J_calib[:, 3:, frame.stop] = -(rows.residual[:, 3:] + scaling.reported) / scaling.scale
    return Rows(rows.residual, J_nodes[0], J_nodes[1], J_calib)


def _add(factor: PoseFactor, own: slice, rows: Rows, columns: np.ndarray, node: np.ndarray, into: Into) -> float:
    """Adds the rows `own`, each to the interval that begins at its `node`."""
    by = RobustNoise(np.eye(6) / factor.sigma[own][:, :, None], factor.noise.loss, factor.noise.loss_scale)
    return add_rows(rows, own, node, columns, factor.layout, factor.imu, by, into)
