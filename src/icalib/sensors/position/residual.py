"""The factor of a position sensor: each fix at its own instant against the trajectory of the IMU.

    e = R_world_frame^T (p_world_imu + R_world_imu p_imu_sensor - p_world_frame) - p_frame_sensor

at the instant of the fix on the IMU's clock. The trajectory is carried to that instant by the IMU's readings; fixes are
never interpolated. Parameters: the sensor's blocks translation (p_imu_sensor) and time_offset; of its frame in each
recording frame_yaw or frame_rotation, and frame_translation, or the tilt of the target: see `frame`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from icalib.motion.factor import FactorKey, RowFactor, Whitened
from icalib.motion.imu_data import ImuData
from icalib.motion.row_sums import Into, RobustNoise, add_rows, rows_by_recording
from icalib.motion.sensor_pose import Kinematics, SensorPose, rows_at
from icalib.motion.sweep import EstimatedMotion
from icalib.motion.time_offsets import offset_at
from icalib.optim.arrowhead import Piece
from icalib.optim.rows import Rows
from icalib.optim.state import Layout, State
from icalib.sensors.position.frame import PositionFrame
from icalib.sensors.position.stream import PositionStream

# Fixes further from all keyframes are left out. The noise of an accelerometer of 0.01 m/s^2/sqrt(Hz), a poor one, moves
# a position by 1 mm over this time; the row does not count it.
NEAR_KEYFRAME_S = 0.3


KINDS = {"horizontal": slice(0, 2), "vertical": slice(2, 3)}


@dataclass(frozen=True)
class PositionNoise:
    """Standard deviations of x and y (`horizontal`) and of z (`vertical`) of the frame: times those of the stream's
    covariances, or in metres where it has none. loss: robust loss of each whitened row, and where it bends, in
    standard deviations."""

    horizontal: float
    vertical: float
    loss: str = "none"
    loss_scale: float = 2.5

    @property
    def sizes(self) -> np.ndarray:
        """(3,) of each row."""
        return np.array([self.horizontal, self.horizontal, self.vertical])


@dataclass(frozen=True)
class PositionFactor(RowFactor):
    """n fixes of one sensor. frame: whose frame they are in, see `frame_owner`; keyframe (n,): of each, in order; root
    (n, 3, 3): see `PositionStream`."""

    units: ClassVar[Mapping[str, str]] = {"horizontal": "m", "vertical": "m"}

    name: str
    frame: str
    seconds: np.ndarray  # (n,) since the first stamp on the sensor's clock
    position: np.ndarray  # (n, 3) m
    root: np.ndarray
    keyframe: np.ndarray
    starts: tuple[int, ...]  # the first keyframe of each recording
    n_keyframes: int
    imu: ImuData
    gravity: float
    noise: PositionNoise
    layout: Layout

    @classmethod
    def build(
        cls, stream: PositionStream, motion: EstimatedMotion, noise: PositionNoise, layout: Layout, frame: str
    ) -> PositionFactor:
        """The fixes near keyframes and outside gaps of the IMU; their keyframes stay while the solver runs. The
        covariances of `stream` are the weights: see `model.weighted`."""
        state, (k, keyframe) = motion.state, motion.near_keyframes(stream, NEAR_KEYFRAME_S)
        return cls(
            stream.name, frame, stream.seconds[k], stream.position[k], stream.root[k], keyframe, state.starts,
            len(state.seconds), motion.imu, motion.gravity, noise, layout,
        )  # fmt: skip

    @property
    def key(self) -> FactorKey:
        return self.name, "positions"

    @property
    def kinds(self) -> dict[str, slice]:
        """See `Factor`."""
        return KINDS

    def output(self) -> Whitened:
        """Empty arrays for `accumulate` to fill."""
        return Whitened.empty(len(self.seconds), 3)

    def times(self, state: State) -> np.ndarray:
        """See `RowFactor`."""
        return self.seconds + offset_at(state, self.name, self.keyframe)

    def raw(self, out: Whitened) -> np.ndarray:
        """(n, 3) residuals in the frame's axes [m]."""
        return np.linalg.solve(self.root, (self.noise.sizes * out.residual)[:, :, None])[:, :, 0]

    def raw_sigma(self) -> np.ndarray:
        """(n, 3) m in the frame's axes."""
        return np.sqrt(((np.linalg.inv(self.root) * self.noise.sizes) ** 2).sum(axis=2))

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`."""
        into, parts = (
            Into(piece, out, sums, curved),
            rows_by_recording(self.keyframe, self.starts, self.n_keyframes, piece),
        )
        return sum(self._of_recording(k, own, state, into) for k, own in parts)

    def _of_recording(self, recording: int, own: slice, state: State, into: Into) -> float:
        """Adds the fixes `own`, of one recording."""
        frame, keyframe = PositionFrame.of(self.frame, recording, state.values), self.keyframe[own]
        kinematics = Kinematics.of(self)
        at = SensorPose.at(kinematics, self.seconds[own], keyframe, state, into.sums)
        rows = _rows(self.position[own], frame, at, into.sums)
        columns = [kinematics.columns(recording), frame.columns(self.layout)]
        noise = RobustNoise(self.root[own] / self.noise.sizes[:, None], self.noise.loss, self.noise.loss_scale)
        interval = rows.on_intervals(keyframe, self.n_keyframes)
        return add_rows(rows, own, interval, np.concatenate(columns), noise, into)


def _rows(measured: np.ndarray, frame: PositionFrame, at: SensorPose, jacobians: bool) -> Rows:
    """Rows of residuals (n, 3) m of `measured` fixes (n, 3), by the calibration parameters of the sensor's pose, then
    those of the frame."""
    n, inside = len(measured), frame.inward(at.position)
    if not jacobians:
        return rows_at(inside - measured, (), (at,), np.zeros((0, 3, 0)))
    J_pose = np.concatenate([np.zeros((n, 3, 3)), frame.rotation.T @ at.rotation], axis=2)
    return rows_at(inside - measured, (J_pose,), (at,), frame.jacobian(inside))
