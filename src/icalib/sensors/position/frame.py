"""The static frame in which a position sensor reports, in one recording.

It is a frame of this sensor, of another sensor, or of the target. The origin of the target's frame is that of the
world, so that it has no position parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.geometry.targets.base import BOARD
from icalib.model.sensor_model import frame_of
from icalib.optim.state import Key, Layout, in_recording
from icalib.rig.scene import FRAME_ROTATION, FRAME_TRANSLATION, FRAME_YAW, TILT
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.sensor import TARGET_FRAME


def frame_owner(sensor: PositionSensor) -> str:
    """Name of the sensor in whose frame `sensor` reports: its own name, another sensor's, or `TARGET_FRAME`."""
    return sensor.shared_frame or sensor.name


@dataclass(frozen=True)
class PositionFrame:
    """Pose of the frame in one recording: rotation R_world_frame (3, 3), position p_world_frame (3,) m. keys: parameter
    block of the rotation, then that of the position; the target's frame has the first only."""

    rotation: np.ndarray
    position: np.ndarray
    keys: tuple[Key, ...]

    @classmethod
    def of(cls, owner: str, recording: int, values: Mapping[Key, np.ndarray]) -> PositionFrame:
        """The frame of `owner` (see `frame_owner`) in a recording, from the `values` of a state."""
        if owner == TARGET_FRAME:
            key = in_recording(BOARD, recording), TILT.name
            return cls(values[key], np.zeros(3), (key,))
        frame = frame_of(owner, recording)
        levelled = (frame, FRAME_YAW.name) in values
        turn, origin = (frame, (FRAME_YAW if levelled else FRAME_ROTATION).name), (frame, FRAME_TRANSLATION.name)
        rotation = yaw_rotation(values[turn][0]) if levelled else values[turn]
        return cls(rotation, values[origin], (turn, origin))

    def columns(self, layout: Layout) -> np.ndarray:
        """(c,) columns of the frame's parameters among the calibration parameters; -1 for fixed ones."""
        return np.concatenate([layout.columns(*key) for key in self.keys])

    def inward(self, position: np.ndarray) -> np.ndarray:
        """(n, 3) m: world positions (n, 3) m, expressed in this frame."""
        return (position - self.position) @ self.rotation

    def jacobian(self, inside: np.ndarray) -> np.ndarray:
        """(n, 3, c) derivatives of `inward`, whose value is `inside` (n, 3), by the parameters of the frame. A rotation
        is perturbed on the right; the tilt of the target on the left, about x and y of the world."""
        J = so3.hat_many(np.ascontiguousarray(inside))
        name = self.keys[0][1]
        if name == TILT.name:
            return (J @ self.rotation.T)[:, :, :2]
        J_turn = J[:, :, 2:] if name == FRAME_YAW.name else J
        return np.concatenate([J_turn, np.tile(-self.rotation.T, (len(inside), 1, 1))], axis=2)


def yaw_rotation(yaw: float) -> np.ndarray:
    """(3, 3) rotation about z by `yaw` rad."""
    return so3.exp(np.array([0.0, 0.0, yaw]))
