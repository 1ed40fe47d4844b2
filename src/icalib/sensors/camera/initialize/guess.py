"""What a first guess is: where the solver starts."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from icalib.data.measurements import CornerStream, Measurements, TrackStream
from icalib.geometry.targets.base import BOARD
from icalib.initialize.steps.target_poses import TargetPoses
from icalib.optim.state import Key


@dataclass(frozen=True)
class CameraGuess:
    """params (P,); offset: t_body - t_cam, each since its clock's first stamp [s]; T_body_cam; poses in the board
    frame."""

    params: np.ndarray
    offset: float
    rotation: np.ndarray
    position: np.ndarray
    poses: TargetPoses


@dataclass(frozen=True)
class Guess:
    """Where the solver starts. R_world_board: world z is up, its origin the scene's; its x axis horizontal in the
    scene. Without an IMU the world is the scene. scene: poses of the target's bodies in it, where there are several."""

    cameras: dict[str, CameraGuess]
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    R_world_board: np.ndarray
    scene: dict[Key, np.ndarray] = field(default_factory=dict)

    def values(self) -> dict[Key, np.ndarray]:
        """The lasting parameters by sensor and name."""
        out: dict[Key, np.ndarray] = self.scene | {(BOARD, "tilt"): self.R_world_board}
        for name, c in self.cameras.items():
            out[name, "rotation"], out[name, "translation"] = c.rotation, c.position
            out[name, "time_offset"] = np.array([c.offset])
            out[name, "intrinsics"], out[name, "distortion"] = c.params[:4], c.params[4:]
        return out

    def biases(self, n: int) -> np.ndarray:
        """(n, 6) the biases, the same at all keyframes."""
        return np.tile(np.concatenate([self.gyro_bias, self.accel_bias]), (n, 1))

    def body_poses(self, measurements: Measurements) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Instants (n,) on the body's clock, increasing, R_world_body (n, 3, 3), p_world_body (n, 3), as the images of
        all cameras show them."""
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
        order = order[np.diff(t[order], prepend=-np.inf) > 1e-4]
        return t[order], np.concatenate(rotations)[order], np.concatenate(positions)[order]


def relative_offset(value: np.ndarray, stream: CornerStream | TrackStream, measurements: Measurements) -> float:
    """A raw time offset (1,) as one between clocks that each start at their first stamp."""
    return float(value[0]) + (stream.origin_ns - measurements.origin_ns) * 1e-9
