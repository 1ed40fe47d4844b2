"""Finds cameras in a recording for `icalib inspect`: images, tables of corners and tracks, and what they show.

Finds cameras among the topics of a recording. Tables of cameras for the terminal.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

from rich.table import Table
from rich.text import Text

from icalib.data.recordings import BagRecording, Recording, TopicInfo
from icalib.detection.images import spread_images
from icalib.errors import RecordingError
from icalib.sensors.camera.inspect import findings
from icalib.sensors.camera.inspect.draft import camera_lines
from icalib.sensors.camera.inspect.facts import (
    GRID,
    CameraFacts,
    CameraSource,
    ImageFacts,
    camera_sources,
    camera_views,
    read_images,
    resolution_of,
    target_in,
    target_view,
    without_target,
)
from icalib.sensors.camera.read.camera_info import CameraInfo, read_camera_info
from icalib.sensors.camera.spec import Camera
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.console import plain_table
from icalib.tools.inspection.facts import Inspection, SensorSource, StreamFacts, imu_timing, overlap_s
from icalib.tools.inspection.kinds import Key, KindInspector, Progress, plain, problem_of, topic_key


class CameraInspector(KindInspector):
    """Finds cameras, and the target in their images. Several topics can be of one camera."""

    sensor: ClassVar[type[Sensor]] = Camera
    topic_kinds: ClassVar[tuple[str, ...]] = ("image", "corners", "tracks", "camera info")
    prefix: ClassVar[str] = "cam"
    plain_names: ClassVar[str] = (
        r"image(_(raw|color|mono|rect|rect_raw|rect_color))?|compressed|raw|camera_info|(corners|tracks)\.csv"
    )
    named_first: ClassVar[bool] = True
    is_certain: ClassVar[bool] = True
    alone: ClassVar[str] = "Cameras alone give intrinsics, and extrinsics of those that see the target together"
    sets_origin: ClassVar[bool] = True
    section: ClassVar[str] = "cameras"
    checks: ClassVar = {
        "use": findings.refused,
        "quality": findings.poor,
        "clock": findings.clocks,
        "gaps": findings.gaps,
        "target": findings.target,
    }

    def sources(self, topics: Sequence[TopicInfo]) -> Iterator[tuple[Key, CameraSource]]:
        """See `KindInspector`."""
        return camera_sources_of(topics)

    def left_out(self, topics: Sequence[TopicInfo], sensors: Mapping[str, SensorSource]) -> dict[str, str]:
        """Depth images, and further topics with the images of a camera."""
        cameras = [(name, camera) for name, camera in sensors.items() if isinstance(camera, CameraSource)]
        again = {topic: f"the images of {name} once more" for name, camera in cameras for topic in camera.others}
        return {t.name: "depth images" for t in depth_images(topics)} | again

    def read(self, recording: Recording, name: str, source: CameraSource) -> tuple[StreamFacts, ImageFacts]:
        """Reads all images."""
        assert source.images is not None  # it is the `read_topic`
        return read_images(recording, source.images)

    def facts(self, recording: Recording, name: str, source: CameraSource, content: ImageFacts | None) -> CameraFacts:
        """Facts on the images, and CameraInfo."""
        return CameraFacts(content, _info(recording, source))

    def searched(self, recording: Recording, inspection: Inspection, progress: Progress) -> dict[str, CameraFacts]:
        """Facts with the views of a known target, or else with words on the target in a few images."""
        facts: dict[str, CameraFacts] = dict(inspection.facts)
        cameras = camera_sources(inspection)
        readable = {n: c for n, c in cameras.items() if c.corners or (c.images and not problem_of(inspection, n))}
        if inspection.target is None:
            topics = {n: c.images.name for n, c in readable.items() if c.images and not c.corners}
            looks = {n: target_in(spread_images(recording, topic)) for n, topic in topics.items()}
            return {n: dataclasses.replace(facts[n], pattern=words) for n, words in looks.items()}
        return _with_views(recording, inspection, readable, progress)

    def draft(self, inspection: Inspection, active: bool) -> Iterator[str]:
        """Lines of the cameras that can be read."""
        for name, camera in _usable(inspection).items():
            yield from camera_lines(inspection, name, camera)

    def needs_target(self, inspection: Inspection) -> bool:
        """Whether the target is known, or a camera is without tracks."""
        cameras = _usable(inspection).values()
        tracks_scene = without_target(inspection)
        needed = any(c.tracks is None and not (tracks_scene and c.images) for c in cameras)
        return bool(cameras) and (inspection.target is not None or needed)

    def figures(self, inspection: Inspection, name: str) -> dict[str, Any]:
        """See `KindInspector`."""
        source, facts = camera_sources(inspection)[name], inspection.facts[name]
        camera, imu = inspection.stream(source.topic).timing, imu_timing(inspection)
        return {
            "images": source.images.name if source.images else None,
            "corners": source.corners.name if source.corners else None,
            "others": list(source.others),
            **plain(facts.images),
            "overlap_with_imu_s": overlap_s(camera, imu) if camera and imu else None,  # negative: the gap
            "camera_info": plain(facts.info) or None,
            "target": (plain(facts.view) | {"grid": list(GRID)}) if facts.view else None,
        }

    def target_tables(self, inspection: Inspection) -> Iterator[Table | Text]:
        """Views of the target, and their coverage of the images."""
        if camera_views(inspection):
            yield target_table(inspection)
            yield from coverage_maps(inspection)

    def notes(self, inspection: Inspection) -> Iterator[str]:
        """Notes on the search for the target."""
        return (note for view in camera_views(inspection).values() for note in view.notes)


INSPECTOR = CameraInspector()


def _usable(inspection: Inspection) -> dict[str, CameraSource]:
    """Cameras that can be read, by name."""
    return {name: c for name, c in camera_sources(inspection).items() if not problem_of(inspection, name)}


def _info(recording: Recording, camera: CameraSource) -> CameraInfo | None:
    """The camera's CameraInfo; None if it cannot be read."""
    if camera.info is None or not isinstance(recording, BagRecording):
        return None
    try:
        return read_camera_info(recording, camera.info.name)
    except (RecordingError, ValueError):
        return None


def _with_views(
    recording: Recording, inspection: Inspection, cameras: dict[str, CameraSource], progress: Progress
) -> dict[str, CameraFacts]:
    """Facts of the `cameras` by name, with their views of the target."""
    facts: dict[str, CameraFacts] = {}
    assert inspection.target is not None
    target = inspection.target.target
    for k, (name, camera) in enumerate(cameras.items()):
        what = f"finding the target in the images of {name}"

        def show(done: float, k: int = k, what: str = what) -> None:
            progress(what, (k + done) / len(cameras))

        show(0.0)
        view = target_view(recording, name, camera, target, resolution_of(inspection, name, camera), show)
        facts[name] = dataclasses.replace(inspection.facts[name], view=view)
    return facts


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


def target_table(inspection: Inspection) -> Table:
    """One row for each camera: number of images with the target, coverage of the image, tilts and distances."""
    table = plain_table(
        f"Target ({inspection.target.target.type} of {inspection.target.file})" if inspection.target else "",
        ("camera", "images", "with target", "corners", "cells covered", "tilt [deg]", "farthest / nearest"),
        right=1,
        caption=(
            "tilt: 10th to 90th percentile of the images; tilt and distances are rough, for the intrinsics are unknown."
        ),
    )
    for name, v in camera_views(inspection).items():
        share = f" ({v.seen / v.images:.0%})" if v.images else ""
        filled = sum(n > 0 for row in v.cells for n in row) if v.cells else None
        table.add_row(
            *map(
                Text,
                (
                    name,
                    "" if v.images is None else str(v.images),
                    f"{v.seen}{share}",
                    str(v.corners),
                    f"{filled} of {len(v.cells) * len(v.cells[0])}" if v.cells else "",
                    f"{v.tilt_deg[0]:.0f} to {v.tilt_deg[2]:.0f}" if v.tilt_deg else "",
                    f"{v.distance_ratio:.1f}" if v.distance_ratio else "",
                ),
            )
        )
    return table


def coverage_maps(inspection: Inspection) -> Iterator[Text]:
    """The number of corners in each part of the image of each camera, with a heading."""
    for name, view in camera_views(inspection).items():
        if view.cells:
            yield Text(f"Corners over the image of {name} (. none, 1 to 9 the share of the fullest cell):")
            yield Text(coverage_map(view.cells))


def coverage_map(cells: tuple[tuple[int, ...], ...]) -> str:
    """The grid of cells as lines of text."""
    most = max(max(row) for row in cells) or 1
    return "\n".join("  " + " ".join(_digit(n, most) for n in row) for row in cells)


def _digit(count: int, most: int) -> str:
    return str(max(1, round(9 * count / most))) if count else "."
