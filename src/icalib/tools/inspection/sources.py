"""Finds the topics that are sensors, and names the sensors."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import PurePosixPath

from icalib.data.images.unreadable import VIDEO_FILE
from icalib.data.recordings import TopicInfo
from icalib.tools.inspection.facts import CameraSource, SensorSource, Sources
from icalib.tools.inspection.kinds import inspectors

# Parts of topic names that are the content, not the sensor. Those of other kinds of sensors are their `plain_names`.
_WHAT = (
    r"image(_(raw|color|mono|rect|rect_raw|rect_color))?|compressed|raw|camera_info|data(_raw)?|sample"
    r"|(data|corners|tracks)\.csv"
)
_UNNAMEABLE = re.compile(r"[^A-Za-z0-9_-]+")
Key = tuple[str, ...]


def find_sources(topics: Sequence[TopicInfo]) -> Sources:
    """The sensors among the topics with messages, each under a unique name derived from its topic."""
    filled = [t for t in topics if t.count]
    depth = [t for t in filled if t.kind == "image" and "depth" in t.name.lower()]
    camera_topics = {
        kind: _by_key([t for t in filled if t.kind == kind and t not in depth])
        for kind in ("image", "corners", "tracks", "camera info")
    }
    kinds = inspectors()
    others = {"imu": ("imu",)} | {kind: inspector.topic_kinds for kind, inspector in kinds.items()}
    prefixes = {"imu": "imu"} | {kind: inspector.prefix for kind, inspector in kinds.items()}
    named_topics = [(t, what) for what, kinds in others.items() for t in filled if t.kind in kinds]
    keys = sorted({*camera_topics["image"], *camera_topics["corners"], *camera_topics["tracks"]})
    names = _names([(k, "cam") for k in keys] + [(_key(t), prefixes[what]) for t, what in named_topics])
    cameras = tuple(_camera(n, k, camera_topics) for n, k in zip(names, keys, strict=False))
    left_out = {t.name: "depth images" for t in depth}
    left_out |= {other: f"the images of {c.name} once more" for c in cameras for other in c.others}
    named = [(name, *of) for name, of in zip(names[len(keys) :], named_topics, strict=True)]
    imus = {name: t for name, t, kind in named if kind == "imu"}
    return Sources(cameras, imus, left_out, {n: SensorSource(kind, t) for n, t, kind in named if kind != "imu"})


@cache
def _plain_names() -> re.Pattern[str]:
    return re.compile("|".join(f"({names})" for names in (_WHAT, *(k.plain_names for k in inspectors().values()))))


def _camera(name: str, key: Key, camera_topics: Mapping[str, Mapping[Key, list[TopicInfo]]]) -> CameraSource:
    """The camera with the key `key`. Among several topics of its images, unrectified ones go first, then those with
    most messages, then short names, which are of uncompressed images."""
    same = sorted(camera_topics["image"].get(key, []), key=lambda t: ("rect" in t.name, -t.count, len(t.name)))
    corners, tracks, info = (camera_topics[kind].get(key, [None])[0] for kind in ("corners", "tracks", "camera info"))
    images = same[0] if same else None
    topic = corners or images or tracks
    assert topic is not None  # the key is of one of them
    return CameraSource(name, topic, images, corners, info, tuple(t.name for t in same[1:]), tracks)


def _by_key(topics: list[TopicInfo]) -> dict[Key, list[TopicInfo]]:
    groups: dict[Key, list[TopicInfo]] = {}
    for topic in topics:
        groups.setdefault(_key(topic), []).append(topic)
    return groups


def _key(topic: TopicInfo) -> Key:
    ending = PurePosixPath(topic.name).suffix if topic.type == VIDEO_FILE else ".csv"
    return tuple(p.removesuffix(ending) for p in topic.name.split("/") if p and not _plain_names().fullmatch(p))


def _names(sensors: list[tuple[Key, str]]) -> list[str]:
    """Unique names from the last parts of the sensors' keys, as few as make the names differ."""
    longest = max((len(key) for key, _ in sensors), default=1)
    names: list[str] = []
    for length in range(1, longest + 1):
        names = [_name(key[-length:], kind) for key, kind in sensors]
        if len(set(names)) == len(names):
            return names
    return [f"{name}_{k}" if name in names[:k] else name for k, name in enumerate(names)]


def _name(parts: Key, kind: str) -> str:
    name = _UNNAMEABLE.sub("_", "_".join(parts)).strip("_-")
    if not name:
        return f"{kind}0"
    return name if name[0].isalpha() else f"{kind}_{name}"
