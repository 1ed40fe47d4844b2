"""Finds cameras among the topics of a recording."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from icalib.data.recordings import TopicInfo
from icalib.sensors.camera.inspect.facts import CameraSource
from icalib.sensors.camera.spec import Camera
from icalib.tools.inspection.kinds import Key, topic_key

Groups = Mapping[str, Mapping[Key, list[TopicInfo]]]  # topics by their kind, and by camera


def depth_images(topics: Sequence[TopicInfo]) -> list[TopicInfo]:
    """Topics of depth images, which show no target."""
    return [t for t in topics if t.kind == "image" and "depth" in t.name.lower()]


def camera_sources_of(topics: Sequence[TopicInfo]) -> Iterator[tuple[Key, CameraSource]]:
    """Yields the cameras by the parts of their topics that name them, sorted."""
    depth = depth_images(topics)
    groups = {
        kind: _by_key([t for t in topics if t.kind == kind and t not in depth])
        for kind in ("image", "corners", "tracks", "camera info")
    }
    for key in sorted({*groups["image"], *groups["corners"], *groups["tracks"]}):
        yield key, _camera(key, groups)


def _camera(key: Key, groups: Groups) -> CameraSource:
    """The camera with the key `key`. Among several topics of its images, unrectified ones go first, then those with
    most messages, then short names, which are of uncompressed images."""
    same = sorted(groups["image"].get(key, []), key=lambda t: ("rect" in t.name, -t.count, len(t.name)))
    corners, tracks, info = (groups[kind].get(key, [None])[0] for kind in ("corners", "tracks", "camera info"))
    images = same[0] if same else None
    topic = corners or images or tracks
    assert topic is not None  # the key is of one of them
    return CameraSource(Camera.sensor_type, topic, images, corners, info, tuple(t.name for t in same[1:]), tracks)


def _by_key(topics: list[TopicInfo]) -> dict[Key, list[TopicInfo]]:
    groups: dict[Key, list[TopicInfo]] = {}
    for topic in topics:
        groups.setdefault(topic_key(topic), []).append(topic)
    return groups
