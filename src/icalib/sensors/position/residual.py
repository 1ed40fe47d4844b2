"""The factor of a position sensor: difference between the trajectory of the IMU and each fix.

    e = R_world_frame^T (p_world_imu + R_world_imu p_imu_sensor - p_world_frame) - p_frame_sensor

at the instant of the fix on the IMU's clock. The IMU's readings propagate the trajectory to that instant; fixes are
never interpolated. Parameters: translation (p_imu_sensor) and time_offset of the sensor, and those of its frame in each
recording. These are frame_yaw or frame_rotation with frame_translation, or the tilt of the target: see `frame`. A slow
offset of the fixes adds to e: see `walk_factor`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from icalib.motion.factor import FactorKey, FitKey, RawSize, RowFactor, Whitened, output_at
from icalib.motion.imu_data import ImuData
from icalib.motion.row_sums import Into, RobustNoise, add_rows, rows_by_recording
from icalib.motion.sensor_pose import Kinematics, SensorPose, rows_at
from icalib.motion.sweep import EstimatedMotion
from icalib.motion.time_offsets import offset_at
from icalib.optim.arrowhead import Piece
from icalib.optim.rows import Rows
from icalib.optim.state import Layout, State
from icalib.sensors.position.fix_errors import bursts_of, outliers_of, rms
from icalib.sensors.position.frame import PositionFrame
from icalib.sensors.position.stream import PositionStream
from icalib.sensors.position.walk_factor import OffsetWalk

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
        """See `Factor`."""
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
