"""Factors of measured poses, from motion capture or the odometry of another program.

`AbsolutePoseFactor`: each pose at its measurement time, in a frame that is static in each recording.
`RelativePosesFactor`: relative poses over intervals that are close to those between keyframes; the frame may drift.

Parameters of the sensor are rotation, translation (R_imu_sensor, p_imu_sensor), time_offset, scale (1,), the ratio of
true to measured lengths, and position_rotation (3,), by which positions are turned against rotations. The frame of
each recording has frame_rotation and frame_translation (R_world_frame, p_world_frame). Position residuals are
R predicted / scale - measured. With predicted - scale * measured instead, scale would multiply the noise, and the
estimated scale would be too small.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from icalib.data.measurements import PoseStream
from icalib.geometry import so3
from icalib.model.sensor_model import FRAME, frame_of
from icalib.motion.factor import (
    FactorKey,
    Frame,
    Into,
    PoseResiduals,
    RobustNoise,
    RowFactor,
    Whitened,
    absolute_residuals,
    add_rows,
    in_chunks,
    relative_residuals,
    rows_by_recording,
)
from icalib.motion.imu_data import ImuData, StampIntervals, choose_intervals
from icalib.motion.poses import MERGED_WITHIN_S, EstimatedMotion, instants, offset_at, slices_by_clock
from icalib.motion.sensor_pose import Kinematics, SensorPose, rows_at
from icalib.optim.arrowhead import Piece
from icalib.optim.rows import Rows
from icalib.optim.state import Layout, State
from icalib.sensors.pose.spec import POSE_SCALE, POSITION_ROTATION

# Longest propagation from the nearest keyframe to a pose. Poses farther off are not used, as the noise of the
# propagation is not modelled.
MAX_POSE_PROPAGATION_S = 0.05
POSE_KINDS = {"rotation": slice(0, 3), "position": slice(3, 6)}
POSITION_ERRORS = (POSE_SCALE, POSITION_ROTATION)
POSE_UNITS = {"rotation": "rad", "position": "m"}


@dataclass(frozen=True)
class PoseNoise:
    """Noise of measured poses on each axis: standard deviations of absolute poses [rad, m], or random-walk densities of
    relative poses [rad/sqrt(s), m/sqrt(s)]. loss: robust loss of each whitened row; loss_scale: its scale in standard
    deviations."""

    rotation: float
    position: float
    loss: str = "none"
    loss_scale: float = 2.5


class PoseFactor(RowFactor, ABC):
    """Common base of both factors: n measurements with three rows of rotation and three of position each. name: name of
    the sensor."""

    units: ClassVar[Mapping[str, str]] = POSE_UNITS

    name: str
    rotation: np.ndarray
    position: np.ndarray
    noise: PoseNoise
    layout: Layout

    @property
    @abstractmethod
    def sigma(self) -> np.ndarray:
        """(n, 6) standard deviation of each row [rad, m]."""

    @property
    def key(self) -> FactorKey:
        """See `Factor`."""
        return self.name, "poses"

    @property
    def kinds(self) -> dict[str, slice]:
        """See `Factor`."""
        return POSE_KINDS

    @property
    def position_columns(self) -> np.ndarray:
        """(4,) calibration columns of the errors of positions, in the order of `POSITION_ERRORS`."""
        return self.layout.columns(self.name, *(spec.name for spec in POSITION_ERRORS))

    def output(self) -> Whitened:
        """Empty arrays for `accumulate` to fill."""
        return Whitened.empty(len(self.rotation), 6)

    @property
    @abstractmethod
    def instants(self) -> np.ndarray:
        """(n,) times of the measurements [s], on the sensor's clock since its first stamp."""

    @property
    @abstractmethod
    def keyframes(self) -> np.ndarray:
        """(n,) index of the keyframe of each measurement; the first of two for relative poses."""

    def times(self, state: State) -> np.ndarray:
        """See `RowFactor`."""
        return self.instants + offset_at(state, self.name, self.keyframes, self.instants)

    def raw(self, out: Whitened) -> np.ndarray:
        """(n, 6) residuals [rad, m]."""
        return out.residual * self.sigma

    def raw_sigma(self) -> np.ndarray:
        """(n, 6) standard deviations [rad, m]."""
        return self.sigma

    @abstractmethod
    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`."""


@dataclass(frozen=True)
class AbsolutePoseFactor(PoseFactor):
    """n poses of one sensor in its frame, see `absolute_residuals`. keyframe (n,), increasing: index of the keyframe
    from which each pose is propagated. imu: None if all poses were taken at keyframes that no IMU connects. gravity
    [m/s^2]."""

    name: str
    seconds: np.ndarray  # (n,) since the first stamp on the sensor's clock
    rotation: np.ndarray  # (n, 3, 3) R_frame_sensor
    position: np.ndarray  # (n, 3) p_frame_sensor [m]
    keyframe: np.ndarray
    starts: tuple[int, ...]  # the first keyframe of each recording
    n_keyframes: int
    imu: ImuData | None
    gravity: float
    noise: PoseNoise
    layout: Layout

    @classmethod
    def build(cls, stream: PoseStream, motion: EstimatedMotion, noise: PoseNoise, layout: Layout) -> AbsolutePoseFactor:
        """Factor of the poses near keyframes. Poses in IMU gaps that are not bridged are not used."""
        state, (k, keyframe) = motion.state, motion.near_keyframes(stream, MAX_POSE_PROPAGATION_S)
        return cls(
            stream.name, stream.seconds[k], stream.rotation[k], stream.position[k], keyframe, state.starts,
            len(state.seconds), motion.imu, motion.gravity, noise, layout,
        )  # fmt: skip

    @classmethod
    def at_keyframes(
        cls, stream: PoseStream, state: State, starts: tuple[int, ...], noise: PoseNoise, layout: Layout
    ) -> AbsolutePoseFactor:
        """Factor of the poses that were taken at keyframes, without an IMU. starts: index of the first keyframe of each
        recording."""
        times = instants(stream, state.values)
        keyframe = np.searchsorted(0.5 * (state.seconds[1:] + state.seconds[:-1]), times)
        k = np.flatnonzero(np.abs(times - state.seconds[keyframe]) <= MERGED_WITHIN_S)
        return cls(
            stream.name, stream.seconds[k], stream.rotation[k], stream.position[k], keyframe[k], starts,
            len(state.seconds), None, 0.0, noise, layout,
        )  # fmt: skip

    @property
    def instants(self) -> np.ndarray:
        """See `PoseFactor`."""
        return self.seconds

    @property
    def keyframes(self) -> np.ndarray:
        """See `PoseFactor`."""
        return self.keyframe

    @property
    def sigma(self) -> np.ndarray:
        """See `PoseFactor`."""
        return np.tile(np.repeat([self.noise.rotation, self.noise.position], 3), (len(self.seconds), 1))

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`."""
        into, parts = (
            Into(piece, out, sums, curved),
            rows_by_recording(self.keyframe, self.starts, self.n_keyframes, piece),
        )
        return sum(self._add_recording(k, block, state, into) for k, block in parts)

    def _add_recording(self, recording: int, block: slice, state: State, into: Into) -> float:
        """Add the rows of the poses `block` of one recording. Returns their cost."""
        frame = frame_of(self.name, recording)
        v, keyframe, kinematics = state.values, self.keyframe[block], Kinematics.of(self)
        at = SensorPose.at(kinematics, self.seconds[block], keyframe, state, into.sums)
        residuals = absolute_residuals(
            at.rotation,
            at.position,
            Frame(v[frame, FRAME[0]], v[frame, FRAME[1]]),
            self.rotation[block],
            _true_positions(self, state, block),
            into.sums,
        )
        rows = _rows(residuals, (at,), self, state, block)
        columns = [kinematics.columns(recording), self.layout.columns(frame, *FRAME), self.position_columns]
        interval = rows.on_intervals(keyframe, self.n_keyframes)
        return add_rows(rows, block, interval, np.concatenate(columns), _noise(self, block), into)


@dataclass(frozen=True)
class RelativePosesFactor(PoseFactor):
    """n relative poses of one sensor, see `relative_residuals`, each between two stamps close to two consecutive
    keyframes. Their noise is a random walk: independent, with a variance proportional to the duration."""

    name: str
    seconds: np.ndarray  # (N,) since the first stamp on the sensor's clock
    intervals: StampIntervals
    rotation: np.ndarray  # (n, 3, 3) rotation from the first to the last pose, in axes of the first
    position: np.ndarray  # (n, 3) displacement in axes of the sensor at the first pose [m]
    imu: ImuData
    gravity: float
    noise: PoseNoise
    layout: Layout

    @classmethod
    def build(
        cls, stream: PoseStream, motion: EstimatedMotion, noise: PoseNoise, layout: Layout
    ) -> RelativePosesFactor:
        """Factor of the relative poses between stamps that are chosen by the time offset and the keyframes of
        `motion`."""
        state, seconds = motion.state, stream.seconds
        times = instants(stream, state.values)
        intervals = choose_intervals(motion.imu, state.seconds, state.starts, times)
        R0, R1 = stream.rotation[intervals.first], stream.rotation[intervals.last]
        displacement = stream.position[intervals.last] - stream.position[intervals.first]
        position = np.einsum("nji,nj->ni", R0, displacement)
        rotation = np.ascontiguousarray(R0.transpose(0, 2, 1) @ R1)
        return cls(stream.name, seconds, intervals, rotation, position, motion.imu, motion.gravity, noise, layout)

    @property
    def instants(self) -> np.ndarray:
        """(n,) starts of the intervals, on the sensor's clock [s]."""
        return self.seconds[self.intervals.first]

    @property
    def keyframes(self) -> np.ndarray:
        """See `PoseFactor`."""
        return self.intervals.keyframe

    @property
    def sigma(self) -> np.ndarray:
        """See `PoseFactor`."""
        duration = self.seconds[self.intervals.last] - self.seconds[self.intervals.first]
        return np.sqrt(duration)[:, None] * np.repeat([self.noise.rotation, self.noise.position], 3)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`."""
        low, high = (int(k) for k in np.searchsorted(self.intervals.keyframe, [piece.first, piece.last]))
        into, cost = Into(piece, out, sums, curved), 0.0
        for clock, part in slices_by_clock(state, self.name, self.intervals.keyframe[low:high]):
            for some in in_chunks(slice(low + part.start, low + part.stop)):
                cost += self._add_interval_rows(clock, some, state, into)
        return cost

    def _add_interval_rows(self, clock: int, block: slice, state: State, into: Into) -> float:
        """Add the rows of the relative poses `block`, all with time offset number `clock`. Returns their cost."""
        first, last, keyframe = (x[block] for x in (self.intervals.first, self.intervals.last, self.intervals.keyframe))
        kinematics = Kinematics.of(self)
        a = SensorPose.at(kinematics, self.seconds[first], keyframe, state, into.sums)
        b = SensorPose.at(kinematics, self.seconds[last], keyframe + 1, state, into.sums)
        residuals = relative_residuals(
            (a.rotation, b.rotation),
            (a.position, b.position),
            self.rotation[block],
            _true_positions(self, state, block),
            into.sums,
        )
        columns = np.append(kinematics.columns(clock), self.position_columns)
        rows = _rows(residuals, (a, b), self, state, block)
        return add_rows(rows, block, keyframe, columns, _noise(self, block), into)


def _turn(factor: PoseFactor, state: State) -> np.ndarray:
    """(3,) rotation vector of the positions against the rotations."""
    return state.values.get((factor.name, POSITION_ROTATION.name), np.zeros(3))


def _true_positions(factor: PoseFactor, state: State, block: slice) -> np.ndarray:
    """(n, 3) the measured positions `block`, as they are without their errors [m]."""
    scale, R = state.values[factor.name, POSE_SCALE.name][0], so3.exp(_turn(factor, state))
    return scale * factor.position[block] @ R


def _rows(
    residuals: PoseResiduals, ends: tuple[SensorPose, ...], factor: PoseFactor, state: State, block: slice
) -> Rows:
    """Rows of R predicted / scale - measured, from `residuals`, which are predicted - R^T scale * measured. Their
    calibration parameters are those of the poses at both `ends`, then frame and errors of positions."""
    scale, turn = float(state.values[factor.name, POSE_SCALE.name][0]), _turn(factor, state)
    to_measured, n = so3.exp(turn) / scale, len(residuals.J_frame)
    residuals.residual[:, 3:] = residuals.residual[:, 3:] @ to_measured.T
    J_further = np.zeros((n, 6, residuals.J_frame.shape[2] + 4))
    J_further[:, :, :-4] = residuals.J_frame
    for J in (J_further, *residuals.J_pose):
        J[:, 3:] = to_measured @ J[:, 3:]
    if n:
        predicted = residuals.residual[:, 3:] + factor.position[block]
        J_further[:, 3:, -4] = -predicted / scale
        J_further[:, 3:, -3:] = -so3.hat_many(predicted) @ so3.right_jacobian(-turn)
    return rows_at(residuals.residual, residuals.J_pose, ends, J_further)


def _noise(factor: PoseFactor, block: slice) -> RobustNoise:
    """Noise of the measurements `block`."""
    whitening = np.eye(6) / factor.sigma[block][:, :, None]
    return RobustNoise(whitening, factor.noise.loss, factor.noise.loss_scale)
