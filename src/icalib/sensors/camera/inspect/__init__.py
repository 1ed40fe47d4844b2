"""Finds cameras in a recording for `icalib inspect`: images, tables of corners and tracks, and what they show."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

from rich.table import Table
from rich.text import Text

from icalib.data.recordings import BagRecording, Recording, TopicInfo
from icalib.detection.images.image_work import spread_images
from icalib.errors import RecordingError
from icalib.sensors.camera.inspect import findings
from icalib.sensors.camera.inspect.draft import camera_lines
from icalib.sensors.camera.inspect.facts import (
    CameraFacts,
    CameraSource,
    ImageFacts,
    camera_sources,
    camera_views,
    without_target,
)
from icalib.sensors.camera.inspect.images import read_images
from icalib.sensors.camera.inspect.sources import camera_sources_of, depth_images
from icalib.sensors.camera.inspect.tables import coverage_maps, target_table
from icalib.sensors.camera.inspect.views import GRID, resolution_of, target_in, target_view
from icalib.sensors.camera.read.camera_info import CameraInfo, read_camera_info
from icalib.sensors.camera.spec import Camera
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.facts import Inspection, SensorSource, StreamFacts
from icalib.tools.inspection.kinds import Key, KindInspector, Progress, plain, problem_of
from icalib.tools.inspection.timing import imu_timing, overlap_s


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
