"""What a bag holds beside images and IMU readings, in arrays: camera parameters, poses, twists, joints, points."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from icalib.data.messages.clouds import PointCloud
from icalib.data.messages.livox import LivoxCloud
from icalib.errors import RecordingError


class HasMessages(Protocol):
    """The part of a bag that is needed here; see `BagRecording`."""

    root: Path

    def messages(self, topic: str, kind: str, convert: Callable[[Any], Any] = ...) -> Iterator[tuple[int, Any]]: ...


@dataclass(frozen=True)
class CameraInfo:
    """What the driver says of its camera: resolution (width, height) px, distortion model as ROS calls it, K (3, 3)."""

    resolution: tuple[int, int]
    model: str
    distortion: np.ndarray
    K: np.ndarray


@dataclass(frozen=True)
class PoseMessages:
    """Poses T_frame_body: stamps_ns (N,) int64, position (N, 3) m, rotation (N, 3, 3), NaN where there is no unit
    quaternion."""

    frame: str
    stamps_ns: np.ndarray
    position: np.ndarray
    rotation: np.ndarray


@dataclass(frozen=True)
class TwistStream:
    """Velocities in the axes of `frame`: stamps_ns (N,) int64, linear (N, 3) m/s, angular (N, 3) rad/s."""

    frame: str
    stamps_ns: np.ndarray
    linear: np.ndarray
    angular: np.ndarray


@dataclass(frozen=True)
class OdometryStream:
    """Poses of the body in the odometry's frame, and its velocities in its own axes, at the same instants."""

    pose: PoseMessages
    twist: TwistStream


@dataclass(frozen=True)
class JointStream:
    """Joints by name: stamps_ns (N,) int64; position [rad or m], velocity, effort (N, names), NaN where not sent."""

    names: tuple[str, ...]
    stamps_ns: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


def read_camera_info(bag: HasMessages, topic: str) -> CameraInfo:
    """The first CameraInfo of `topic`. Raises RecordingError as `BagRecording.messages`."""
    _, m = next(bag.messages(topic, "camera info"))
    d, k = (m.D, m.K) if hasattr(m, "K") else (m.d, m.k)  # ROS 1, ROS 2
    return CameraInfo((m.width, m.height), m.distortion_model, np.array(d), np.array(k).reshape(3, 3))


def read_poses(bag: HasMessages, topic: str) -> PoseMessages:
    """All PoseStamped, PoseWithCovarianceStamped or TransformStamped of `topic`. Raises RecordingError as
    `BagRecording.messages`, and for a frame that changes."""
    stamps_ns, found = _all(bag, topic, "pose")
    if found and hasattr(found[0], "child_frame_id"):
        _frame(bag, topic, found, lambda m: m.child_frame_id)
    return _poses(bag, topic, _frame(bag, topic, found), stamps_ns, [_pose_of(m) for m in found])


@dataclass(frozen=True)
class _Placed:
    """A transform by the names of a pose."""

    position: Any
    orientation: Any


def _pose_of(message: Any) -> Any:
    if hasattr(message, "transform"):
        return _Placed(message.transform.translation, message.transform.rotation)
    return message.pose.pose if hasattr(message.pose, "pose") else message.pose


def read_twists(bag: HasMessages, topic: str) -> TwistStream:
    """All TwistStamped of `topic`. Raises RecordingError as `BagRecording.messages`, and for a frame that changes."""
    stamps_ns, found = _all(bag, topic, "twist")
    return _twists(_frame(bag, topic, found), stamps_ns, [m.twist for m in found])


def read_odometry(bag: HasMessages, topic: str) -> OdometryStream:
    """All Odometry of `topic`. Raises RecordingError as `BagRecording.messages`, and for a frame that changes."""
    stamps_ns, found = _all(bag, topic, "odometry")
    pose = _poses(bag, topic, _frame(bag, topic, found), stamps_ns, [m.pose.pose for m in found])
    body = _frame(bag, topic, found, lambda m: m.child_frame_id)
    return OdometryStream(pose, _twists(body, stamps_ns, [m.twist.twist for m in found]))


def read_odometry_twists(bag: HasMessages, topic: str) -> TwistStream:
    """The velocities of all Odometry of `topic`, whatever its poses are. Raises RecordingError as `read_twists`."""
    stamps_ns, found = _all(bag, topic, "odometry")
    return _twists(_frame(bag, topic, found, lambda m: m.child_frame_id), stamps_ns, [m.twist.twist for m in found])


def read_joints(bag: HasMessages, topic: str) -> JointStream:
    """All JointState of `topic`; a message may name some of the joints only. Raises RecordingError as
    `BagRecording.messages`, and for an array that is not as long as the names."""
    stamps_ns, found = _all(bag, topic, "joints")
    names = tuple(dict.fromkeys(name for m in found for name in m.name))
    column = {name: k for k, name in enumerate(names)}
    values = np.full((3, len(found), len(names)), np.nan)
    for row, m in enumerate(found):
        there = [column[name] for name in m.name]
        for quantity, array in enumerate((m.position, m.velocity, m.effort)):
            if len(array) not in (0, len(there)):
                raise RecordingError(
                    f"{bag.root} {topic}: the message at {stamps_ns[row]} ns has {len(there)} joints, but "
                    f"{len(array)} values; correct the driver."
                )
            if len(array):
                values[quantity, row, there] = array
    return JointStream(names, stamps_ns, *values)


def point_clouds(bag: HasMessages, topic: str) -> Iterator[PointCloud]:
    """The PointCloud2, or Livox's CustomMsg, of `topic`, one at a time; those shorter than their points are left out as
    damaged messages. Raises RecordingError as `BagRecording.messages`."""
    for stamp_ns, (frame, points, height) in bag.messages(topic, "points", _points_of):
        yield PointCloud(stamp_ns, frame, points, height)


def _points_of(message: Any) -> tuple[str, np.ndarray, int]:
    """Frame, points and rows of a message. Raises ValueError where it is shorter than its points."""
    m = message
    if isinstance(m, LivoxCloud):
        return m.header.frame_id, m.points, 1
    if len(m.data) < m.row_step * m.height or m.row_step < m.point_step * m.width:
        raise ValueError(f"{m.width * m.height} points do not fit {len(m.data)} bytes")
    kind = _point_type(m)
    rows = m.data[: m.row_step * m.height].reshape(m.height, m.row_step)[:, : m.point_step * m.width]
    points = np.ascontiguousarray(rows).reshape(-1).view(kind) if rows.size else np.empty(0, kind)
    return m.header.frame_id, points, m.height


_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # of PointField


def _point_type(message: Any) -> np.dtype:
    """Raises ValueError where the fields do not fit a point."""
    order = ">" if message.is_bigendian else "<"
    unknown = [f.name for f in message.fields if f.datatype not in _FIELD_TYPES]
    if unknown or message.point_step < 1:
        raise ValueError(f"its point fields cannot be read: {', '.join(unknown) or 'they have 0 bytes'}")
    formats = [(order + _FIELD_TYPES[f.datatype], (f.count,) if f.count > 1 else ()) for f in message.fields]
    return np.dtype(
        {
            "names": [f.name for f in message.fields],
            "formats": formats,
            "offsets": [f.offset for f in message.fields],
            "itemsize": message.point_step,
        }
    )


def _all(bag: HasMessages, topic: str, kind: str) -> tuple[np.ndarray, list[Any]]:
    found = list(bag.messages(topic, kind))
    return np.array([stamp_ns for stamp_ns, _ in found], np.int64), [message for _, message in found]


def _frame(
    bag: HasMessages, topic: str, found: list[Any], of: Callable[[Any], str] = lambda m: m.header.frame_id
) -> str:
    frames = list(dict.fromkeys(of(m) for m in found))
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
    """(N, 3, 3) of quaternions (N, 4) of about unit length; NaN where they are not `good` (N,)."""
    xyzw = np.where(good[:, None], xyzw, np.nan)
    return rotations(xyzw / np.linalg.norm(xyzw, axis=1)[:, None])


def rotations(xyzw: np.ndarray) -> np.ndarray:
    """(N, 3, 3) of unit quaternions (N, 4)."""
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
