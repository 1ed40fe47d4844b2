"""CameraInfo messages of ROS: resolution and intrinsics that a camera driver states."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.messages import HasMessages


@dataclass(frozen=True)
class CameraInfo:
    """Intrinsics that a driver states.

    resolution: (width, height) px; model: ROS name of the distortion model; distortion (n,): its coefficients; K (3, 3)
    px: camera matrix."""

    resolution: tuple[int, int]
    model: str
    distortion: np.ndarray
    K: np.ndarray


def read_camera_info(bag: HasMessages, topic: str) -> CameraInfo:
    """The first CameraInfo message of `topic`. Raises RecordingError as `BagRecording.messages` does."""
    _, m = next(bag.messages(topic, "camera info"))
    d, k = (m.D, m.K) if hasattr(m, "K") else (m.d, m.k)  # ROS 1, ROS 2
    return CameraInfo((m.width, m.height), m.distortion_model, np.array(d), np.array(k).reshape(3, 3))
