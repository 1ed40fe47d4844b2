"""The initial guess of cameras: calibration parameters, biases and camera poses."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from icalib.data.measurements import CornerStream, Measurements, TrackStream
from icalib.geometry.targets.base import BOARD
from icalib.optim.state import Key
from icalib.sensors.camera.initialize.boards.target_poses import TargetPoses

# s; images closer in time count as simultaneous. Clocks synchronised by hardware agree to microseconds, and no camera
# takes images at 10 kHz.
MIN_IMAGE_SPACING_S = 1e-4


@dataclass(frozen=True)
class CameraGuess:
    """Initial guess of one camera.

    params: (P,) intrinsics and distortion, in the order of the camera model.
    offset: t_body - t_camera [s], each clock counted from its first stamp.
    rotation, position: R_body_cam (3, 3) and p_body_cam (3,) [m].
    poses: T_target_cam of each image; T_world_cam for a guess from feature tracks.
    """

    params: np.ndarray
    offset: float
    rotation: np.ndarray
    position: np.ndarray
    poses: TargetPoses


@dataclass(frozen=True)
class Guess:
    """Initial guess of all cameras of a rig, for one recording.

    gyro_bias: (3,) [rad/s]; accel_bias: (3,) [m/s^2].
    R_world_board: (3, 3) attitude of the target; world z is up, and both frames have the same origin. The identity
    without an IMU, and for a guess from feature tracks.
    scene: poses T_target_body of the target's bodies as in a state, keyed by body and parameter; empty for one body.
    """

    cameras: dict[str, CameraGuess]
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    R_world_board: np.ndarray
    scene: dict[Key, np.ndarray] = field(default_factory=dict)

    def values(self) -> dict[Key, np.ndarray]:
        """The calibration parameters as in a state, keyed by sensor (or body) and parameter."""
        out: dict[Key, np.ndarray] = self.scene | {(BOARD, "tilt"): self.R_world_board}
        for name, c in self.cameras.items():
            out[name, "rotation"], out[name, "translation"] = c.rotation, c.position
            out[name, "time_offset"] = np.array([c.offset])
            out[name, "intrinsics"], out[name, "distortion"] = c.params[:4], c.params[4:]
        return out

    def biases(self, n: int) -> np.ndarray:
        """(n, 6) gyroscope and accelerometer biases, the same at all n keyframes."""
        return np.tile(np.concatenate([self.gyro_bias, self.accel_bias]), (n, 1))

    def body_poses(self, measurements: Measurements) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Poses of the body in the world, from the images of all cameras that have a pose.

        Returns instants (n,) [s] on the body's clock, strictly increasing, R_world_body (n, 3, 3) and p_world_body
        (n, 3) [m]. Images at most `MIN_IMAGE_SPACING_S` after another one are left out.
        """
        times, rotations, positions = [], [], []
        for stream in measurements.cameras:
            c = self.cameras[stream.name]
            ok = c.poses.ok
            R = c.poses.rotation[ok] @ c.rotation.T
            times.append(stream.seconds[ok] + c.offset)
            rotations.append(self.R_world_board @ R)
            positions.append((c.poses.position[ok] - R @ c.position) @ self.R_world_board.T)
        t = np.concatenate(times)
        order = np.argsort(t, kind="stable")
        order = order[np.diff(t[order], prepend=-np.inf) > MIN_IMAGE_SPACING_S]
        return t[order], np.concatenate(rotations)[order], np.concatenate(positions)[order]


def relative_offset(value: np.ndarray, stream: CornerStream | TrackStream, measurements: Measurements) -> float:
    """Converts a time offset `value` (1,) [s] between raw stamps to one between clocks counted from first stamps.

    The clocks are those of `stream` and of the body, whose first stamp is `measurements.origin_ns`.
    """
    return float(value[0]) + (stream.origin_ns - measurements.origin_ns) * 1e-9
