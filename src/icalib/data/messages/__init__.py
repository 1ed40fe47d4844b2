"""Readers of ROS messages that several kinds of sensors use.

Arrays of poses, odometry and twists from ROS messages, for several kinds of sensors.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from icalib.errors import RecordingError


class HasMessages(Protocol):
    """Interface to the messages of a bag; see `BagRecording`."""

    root: Path

    def messages(self, topic: str, kind: str, convert: Callable[[Any], Any] = ...) -> Iterator[tuple[int, Any]]: ...


@dataclass(frozen=True)
class PoseMessages:
    """Poses T_frame_body: stamps_ns (N,) int64, position (N, 3) m, rotation (N, 3, 3) R_frame_body. Rotations are NaN
    for messages without a unit quaternion."""

    frame: str
    stamps_ns: np.ndarray
    position: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class TwistStream:
    """Velocities in coordinates of `frame`: stamps_ns (N,) int64, linear (N, 3) m/s, angular (N, 3) rad/s."""

    frame: str
    stamps_ns: np.ndarray
    linear: np.ndarray
    angular: np.ndarray


def read_poses(bag: HasMessages, topic: str, kind: str = "pose") -> PoseMessages:
    """All PoseStamped, PoseWithCovarianceStamped, TransformStamped or (kind "odometry") Odometry of `topic`. Raises
    RecordingError as `BagRecording.messages`, and if a frame changes."""
    stamps_ns, messages = all_messages(bag, topic, kind)
    if messages and hasattr(messages[0], "child_frame_id"):
        _frame(bag, topic, messages, lambda m: m.child_frame_id)
    return _poses(bag, topic, _frame(bag, topic, messages), stamps_ns, [pose_of(m) for m in messages])


@dataclass(frozen=True)
class _Placed:
    """A transform with the field names of geometry_msgs/Pose."""

    position: Any
    orientation: Any


def pose_of(message: Any) -> Any:
    """The geometry_msgs/Pose of a message of one of these types."""
    if hasattr(message, "transform"):
        return _Placed(message.transform.translation, message.transform.rotation)
    return message.pose.pose if hasattr(message.pose, "pose") else message.pose


def poses_and_twists(bag: HasMessages, topic: str, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Unchecked poses (N, 7) x, y, z [m] and quaternion x, y, z, w, and twists (N, 6) [m/s, rad/s] of a topic of poses
    or odometry; twists are zero where messages have none. Raises RecordingError as `BagRecording.messages`."""
    _, messages = all_messages(bag, topic, kind)
    poses = [pose_of(m) for m in messages]
    twists = [m.twist.twist if hasattr(m, "twist") else None for m in messages]
    rows = [(*_xyz(p.position), *_xyz(p.orientation), p.orientation.w) for p in poses]
    speeds = [(*_xyz(t.linear), *_xyz(t.angular)) if t else (0.0,) * 6 for t in twists]
    return np.array(rows).reshape(-1, 7), np.array(speeds).reshape(-1, 6)


def read_twists(bag: HasMessages, topic: str, kind: str = "twist") -> TwistStream:
    """All TwistStamped, or velocities of all Odometry (kind "odometry"), of `topic`; poses are not checked. Raises
    RecordingError as `BagRecording.messages`, and for a frame that changes."""
    stamps_ns, messages = all_messages(bag, topic, kind)
    frame = _frame(bag, topic, messages, lambda m: getattr(m, "child_frame_id", m.header.frame_id))
    return _twists(frame, stamps_ns, [getattr(m.twist, "twist", m.twist) for m in messages])


def all_messages(bag: HasMessages, topic: str, kind: str) -> tuple[np.ndarray, list[Any]]:
    """(N,) int64 stamps [ns] and N messages of `topic`. Raises RecordingError as `BagRecording.messages`."""
    stamped = list(bag.messages(topic, kind))
    return np.array([stamp_ns for stamp_ns, _ in stamped], np.int64), [message for _, message in stamped]


def _frame(
    bag: HasMessages, topic: str, messages: list[Any], of: Callable[[Any], str] = lambda m: m.header.frame_id
) -> str:
    frames = list(dict.fromkeys(of(m) for m in messages))
    if len(frames) > 1:
        raise RecordingError(
            f"{bag.root} {topic} mixes the frames {', '.join(frames)}; record each under its own name."
        )
    return frames[0] if frames else ""


def _poses(bag: HasMessages, topic: str, frame: str, stamps_ns: np.ndarray, poses: list[Any]) -> PoseMessages:
    position = np.array([_xyz(p.position) for p in poses]).reshape(-1, 3)
    xyzw = np.array([(*_xyz(p.orientation), p.orientation.w) for p in poses]).reshape(-1, 4)
    good = np.abs(np.linalg.norm(xyzw, axis=1) - 1.0) < 1e-3
    if 2 * (~good).sum() > len(good):
        raise RecordingError(
            f"{bag.root} {topic}: the orientation at {stamps_ns[np.argmin(good)]} ns is not a unit quaternion, "
            "nor are most others; correct the publisher."
        )
    return PoseMessages(frame, stamps_ns, position, unit_rotations(xyzw, good))


def unit_rotations(xyzw: np.ndarray, good: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotation matrices of quaternions xyzw (N, 4), normalized first; NaN where `good` (N,) is False."""
    xyzw = np.where(good[:, None], xyzw, np.nan)
    return rotations(xyzw / np.linalg.norm(xyzw, axis=1)[:, None])


def rotations(xyzw: np.ndarray) -> np.ndarray:
    """(N, 3, 3) rotation matrices of unit quaternions xyzw (N, 4)."""
    x, y, z, w = xyzw.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def _twists(frame: str, stamps_ns: np.ndarray, twists: list[Any]) -> TwistStream:
    linear = np.array([_xyz(t.linear) for t in twists]).reshape(-1, 3)
    angular = np.array([_xyz(t.angular) for t in twists]).reshape(-1, 3)
    return TwistStream(frame, stamps_ns, linear, angular)


def _xyz(v: Any) -> tuple[float, float, float]:
    return v.x, v.y, v.z
