"""What a recording holds, and which part of it is a sensor's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Protocol

from icalib.data.images.unreadable import type_not_read
from icalib.errors import RecordingError
from icalib.rig import Camera

_MAX_LISTED = 20
KINDS = {
    "sensor_msgs/msg/Image": "image",
    "sensor_msgs/msg/CompressedImage": "image",
    "sensor_msgs/msg/CameraInfo": "camera info",
    "sensor_msgs/msg/Imu": "imu",
    "sensor_msgs/msg/PointCloud2": "points",
    "livox_ros_driver/msg/CustomMsg": "points",
    "livox_ros_driver2/msg/CustomMsg": "points",
    "livox_interfaces/msg/CustomMsg": "points",
    "sensor_msgs/msg/JointState": "joints",
    "nav_msgs/msg/Odometry": "odometry",
    "geometry_msgs/msg/TwistStamped": "twist",
    "geometry_msgs/msg/PoseStamped": "pose",
    "geometry_msgs/msg/PoseWithCovarianceStamped": "pose",
    "geometry_msgs/msg/TransformStamped": "pose",
    "tf2_msgs/msg/TFMessage": "transforms",
    "tf/msg/tfMessage": "transforms",
}


@dataclass(frozen=True)
class TopicInfo:
    """One stream of a recording.

    name: what `topic` (of a folder's tables: `path`) of a sensor in the rig file may be. type: of its messages, or what
    it is in a folder. kind: image, camera info, imu, points, joints, odometry, twist, pose, transforms, corners,
    tracks, wheels; empty for what icalib does not read. first_ns, last_ns: when the first and last message were
    received in a bag, the first and last stamp in a folder; None where there are no messages.
    """

    name: str
    type: str
    kind: str
    count: int
    first_ns: int | None
    last_ns: int | None


def choose_topic(where: str, topics: Sequence[TopicInfo], kind: str, sensor: str, given: str | None) -> TopicInfo:
    """The topic of `kind` that is `sensor`'s: the one `given`, else the only one with the sensor's name in its own,
    else the only one.

    Raises RecordingError naming the recording (`where`) and listing what there is.
    """
    if given is not None:
        return _given(where, topics, kind, given)
    found = [t for t in topics if t.kind == kind and t.count]
    named = [t for t in found if sensor in (*t.name.split("/"), PurePosixPath(t.name).stem)]
    candidates = named or found
    if len(candidates) == 1:
        return candidates[0]
    if not candidates:
        _refuse_unreadable(f"{where} has no {kind} for {sensor}", topics, kind)
        raise RecordingError(
            f"{where} has no {kind} for {sensor}; {listing(topics)}; record it, or correct the rig file."
        )
    names = ", ".join(t.name for t in candidates)
    raise RecordingError(f"{where}: {sensor} may be any of {names}; set `topic` of {sensor} in the rig file.")


class HasImages(Protocol):
    """The part of a recording that `image_topics` needs."""

    def image_topic(self, camera: Camera) -> str: ...


def image_topics(recording: HasImages, cameras: Sequence[Camera]) -> dict[str, str]:
    """The topic of each camera's images, by the camera's name. Raises RecordingError where two would share one."""
    chosen: dict[str, str] = {}
    for camera in cameras:
        topic = recording.image_topic(camera)
        for other, taken in chosen.items():
            if taken == topic:
                raise RecordingError(
                    f"{camera.name} and {other} both match {topic}; set `topic` of each in the rig file."
                )
        chosen[camera.name] = topic
    return chosen


def find_topic(where: str, topics: Sequence[TopicInfo], name: str) -> TopicInfo:
    """The topic `name`, with or without its leading slash. Raises RecordingError listing the topics that there are."""
    for topic in topics:
        if topic.name.lstrip("/") == name.lstrip("/"):
            return topic
    raise RecordingError(f"{where} has no topic {name}; {listing(topics)}; correct the topic.")


def listing(topics: Sequence[TopicInfo]) -> str:
    """The topics with their types, for a sentence."""
    if not topics:
        return "it holds no topics"
    more = f" and {len(topics) - _MAX_LISTED} more" if len(topics) > _MAX_LISTED else ""
    return "it holds " + ", ".join(f"{t.name} ({t.type})" for t in topics[:_MAX_LISTED]) + more


def _refuse_unreadable(missing: str, topics: Sequence[TopicInfo], kind: str) -> None:
    """Raises RecordingError where one of `topics` holds what is `missing`, of `kind`, in a form that is not read."""
    for topic in topics:
        if (held := type_not_read(topic.type)) and held[0] == kind:
            raise RecordingError(f"{missing}: {topic.name} ({topic.type}) holds {held[1]}.")


def _given(where: str, topics: Sequence[TopicInfo], kind: str, given: str) -> TopicInfo:
    topic = find_topic(where, topics, given)
    if topic.kind != kind:
        _refuse_unreadable(f"{where} has no {kind} in {given}", [topic], kind)
        raise RecordingError(f"{where}: {given} is {topic.type}, not {kind}; {listing(topics)}; correct `topic`.")
    if not topic.count:
        raise RecordingError(f"{where}: {given} holds no messages; record again with that sensor running.")
    return topic
