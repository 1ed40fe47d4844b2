"""Finds cameras in a recording for `icalib inspect`: images, tables of corners and tracks, and what they show."""

from __future__ import annotations

import dataclasses
from base64 import b64encode
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from rich.table import Table
from rich.text import Text

from icalib.data.recordings import BagRecording, Recording, TopicInfo
from icalib.detection.images import spread_images
from icalib.errors import RecordingError
from icalib.report.figures import coverage
from icalib.report.page import Plot
from icalib.report.pictures import Drawing, squares
from icalib.sensors.camera.inspect.facts import (
    CameraFacts,
    CameraSource,
    TargetView,
    camera_lines,
    camera_sources,
    camera_views,
    patterns,
    read_images,
    resolution_of,
    target_in,
    target_view,
    without_target,
)
from icalib.sensors.camera.read import CameraInfo, read_camera_info
from icalib.sensors.camera.spec import Camera
from icalib.sensors.sensor import Sensor
from icalib.tools.inspection.console import GRID, coverage_map, empty_borders, plain_table
from icalib.tools.inspection.facts import (
    Draft,
    Facts,
    Finding,
    Inspection,
    Key,
    KindInspector,
    Printout,
    Progress,
    Sources,
    Timing,
    imu_timing,
    inertial,
    overlap_s,
    plain,
    problem_of,
    rolls,
    topic_key,
    words_on_gaps,
)

# Findings on cameras: images, clocks, and the target as they see it.

LEAST_SHARE = 0.3  # share of images with the target
FEWEST_IMAGES, SLOWEST_IMAGES_HZ = 21, 0.5  # with an IMU or wheels: 20 pairs of images at most 2 s apart
FEWEST_STILLS, FEW_STILLS = 2, 10  # cameras alone: images to estimate a lens at all, and to estimate it well
FLAT_DEG = 15.0  # a warning is given if the 90th percentile of the tilt is below


def refused(inspection: Inspection) -> Iterator[Finding]:
    """Cameras that `calibrate` would refuse: problems if no other camera remains, else warnings."""
    cameras = camera_sources(inspection)
    reasons = [reason for name in cameras if (reason := _unfit(inspection, name))]
    is_fatal = len(reasons) == len(cameras)
    yield from (Finding("problem" if is_fatal else "warning", reason) for reason in reasons)


def poor(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on damaged and on few images."""
    for name in camera_sources(inspection):
        images = inspection.facts[name].images
        if images is not None and 0 < images.damaged < images.decoded:
            yield Finding(
                "warning",
                f"{name}: {images.damaged} of {images.decoded} sampled images cannot be decoded and are "
                "ignored; check the disk and the network of the recorder.",
            )
    yield from _few_stills(inspection)


def _unfit(inspection: Inspection, name: str) -> str:
    """Why `calibrate` would refuse the camera; "" if it would not."""
    stream, view = inspection.stream(camera_sources(inspection)[name].topic), inspection.facts[name].view
    timing = stream.timing
    if stream.problem or timing is None:
        return stream.problem
    if view is not None and view.problem:
        return view.problem
    fewest, advice = _fewest_images(inspection, timing)
    if inertial(inspection) and timing.rate_hz and timing.rate_hz < SLOWEST_IMAGES_HZ:
        return (
            f"{name} takes {timing.rate_hz:.2g} images per second, too few to follow its motion; record 10 to 30, or "
            f"remove {' and '.join(inertial(inspection))} from the rig file to calibrate the lens from stills."
        )
    if timing.count < fewest:
        return f"{name} has {timing.count} images, too few; {advice}."
    if view is not None and view.seen < fewest:
        return f"{name} sees the target in {view.seen} images, too few; keep it in view, and {advice}."
    return ""


def _fewest_images(inspection: Inspection, timing: Timing) -> tuple[int, str]:
    """Number of images that `calibrate` requires of a camera, and advice on how to record them. Images that are seconds
    apart are stills, also beside joints, which may be those of an arm that stops."""
    stills = timing.rate_hz is None or timing.rate_hz < SLOWEST_IMAGES_HZ
    if inertial(inspection) or (rolls(inspection) and not stills):
        return FEWEST_IMAGES, "record for 30 to 90 s, with 10 to 30 images per second"
    return FEWEST_STILLS, "take 20 to 60 images of the target from all sides"


def _few_stills(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on cameras alone with enough images for a calibration, but too few for a good one."""
    for name, camera in camera_sources(inspection).items():
        timing, view = inspection.stream(camera.topic).timing, inspection.facts[name].view
        if timing is None or _fewest_images(inspection, timing)[0] != FEWEST_STILLS:
            continue
        count = view.seen if view is not None and not view.problem else timing.count
        if FEWEST_STILLS <= count < FEW_STILLS:
            yield Finding(
                "warning",
                f"{name} has few images{' with the target' if view else ''} ({count}); take 20 to 60 from all sides.",
            )


def clocks(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on cameras whose stamps overlap little or not at all with those of the IMU."""
    imu = imu_timing(inspection)
    if imu is None or inspection.imu is None:
        return
    for name, camera in camera_sources(inspection).items():
        stream = inspection.stream(camera.topic)
        if stream.timing is None:
            continue
        common = overlap_s(stream.timing, imu)
        duration = stream.timing.duration_s
        if common <= 0.0:
            topics = camera.topic, inspection.sources.sensors[inspection.imu].topic
            yield _apart((name, inspection.imu), topics, -common)
        elif common < 0.8 * duration:
            yield Finding(
                "warning",
                f"{inspection.imu} was running during {common:.1f} s of the {duration:.1f} s of {name}, and images "
                "without readings are ignored; start and stop both together.",
            )


def _apart(names: tuple[str, str], topics: tuple[TopicInfo, TopicInfo], apart_s: float) -> Finding:
    """A warning on stamps of two sensors that are apart_s seconds apart. The reception times in a bag are of one clock,
    and show whether both ran at the same time."""
    spans = [(t.first_ns or 0, t.last_ns or 0) for t in topics]
    together = min(last for _, last in spans) > max(first for first, _ in spans)
    says = f"The stamps of {names[0]} and {names[1]} do not overlap, they are {_span(apart_s)} apart"
    if together:
        return Finding(
            "warning",
            f"{says}, but the messages were received together. Leave time_offset free and it is estimated; "
            "have both drivers stamp with one clock if the stamps are used elsewhere.",
        )
    return Finding(
        "warning",
        f"{says}. If both recorded the same motion, leave time_offset free and it is estimated; else record "
        "both at the same time.",
    )


def _span(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 1e4 else f"{seconds / 86400.0:.1f} days"


def gaps(inspection: Inspection) -> Iterator[Finding]:
    """Hints on gaps between images."""
    for name, camera in camera_sources(inspection).items():
        timing = inspection.stream(camera.topic).timing
        # Images without the target leave gaps in a table of corners, which are no gaps of the camera.
        if timing is not None and timing.gaps and not camera.corners:
            yield Finding("hint", f"{name} has {words_on_gaps(timing)}.")


def target(inspection: Inspection) -> Iterator[Finding]:
    """What cameras see of the target; hints if it is unknown."""
    if inspection.target is None:
        if not any(camera.images for camera in camera_sources(inspection).values()):
            return
        yield from _unknown_target(inspection)
        return
    for v in camera_views(inspection).values():
        if not v.problem:
            yield from _view(v)


def _unknown_target(inspection: Inspection) -> Iterator[Finding]:
    """Hints if no target is known: what the images show, and to give a target."""
    if without_target(inspection):
        yield Finding(
            "hint",
            "A few images of each camera show no tags and no checkerboard, so the draft tracks points of the scene "
            "(tracks: images). If there is a target, give it with --target FILE.",
        )
        return
    for camera, words in patterns(inspection).items():
        if words:
            yield Finding("hint", f"A few images of {camera} show {words}.")
    yield Finding("hint", "No target is known, so the images were not searched for it; give --target FILE.")


def _view(v: TargetView) -> Iterator[Finding]:
    if v.images and v.seen < LEAST_SHARE * v.images:
        yield Finding(
            "warning",
            f"{v.camera} sees the target in {v.seen} of {v.images} images ({v.seen / v.images:.0%}); keep it in view.",
        )
    empty = empty_borders(v.cells) if v.cells else ()
    if empty:
        yield Finding(
            "warning",
            f"{v.camera} never sees the target at the {', '.join(empty)} of the image, so the lens is "
            "extrapolated there; move the target there as well.",
        )
    if v.tilt_deg and v.tilt_deg[2] < FLAT_DEG:
        yield Finding(
            "warning",
            f"{v.camera} sees the target nearly from the front only (tilts up to about {v.tilt_deg[2]:.0f} "
            "deg); tilt it by up to 45 deg, or the focal length is weakly determined.",
        )


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
        "use": refused,
        "quality": poor,
        "clock": clocks,
        "gaps": gaps,
        "target": target,
    }

    def sources(self, topics: Sequence[TopicInfo]) -> Iterator[tuple[Key, CameraSource]]:
        return camera_sources_of(topics)

    def joined(self, recording: Recording, sources: Sources) -> Sources:
        """The sources; depth images, and further topics with the images of a camera, are left out."""
        depth = {t.name: "depth images" for t in depth_images(recording.topics()) if t.count}
        cameras = sources.of(Camera.sensor_type).items()
        again = {topic: f"the images of {name} once more" for name, camera in cameras for topic in camera.others}
        return dataclasses.replace(sources, left_out={**sources.left_out, **depth, **again})

    def read(self, recording: Recording, name: str, source: CameraSource) -> Facts:
        """Reads all images, and CameraInfo."""
        stream, images = read_images(recording, source.images) if source.images else (None, None)
        return Facts(CameraFacts(images, _info(recording, source)), stream)

    def searched(self, recording: Recording, inspection: Inspection, progress: Progress) -> Inspection:
        """Adds the views of a known target, or else words on the target in a few images."""
        cameras = camera_sources(inspection)
        readable = {n: c for n, c in cameras.items() if c.corners or (c.images and not problem_of(inspection, n))}
        if inspection.target is None:
            topics = {n: c.images.name for n, c in readable.items() if c.images and not c.corners}
            looks = {n: target_in(spread_images(recording, topic)) for n, topic in topics.items()}
            seen = {n: dataclasses.replace(inspection.facts[n], pattern=words) for n, words in looks.items()}
        else:
            seen = _with_views(recording, inspection, readable, progress)
        return dataclasses.replace(inspection, facts={**inspection.facts, **seen})

    def draft(self, inspection: Inspection, active: bool) -> Draft:
        """Lines of the cameras that can be read. They need the target if it is known, or a camera is without tracks."""
        usable = {n: c for n, c in camera_sources(inspection).items() if not problem_of(inspection, n)}
        tracks_scene = without_target(inspection)
        needed = any(c.tracks is None and not (tracks_scene and c.images) for c in usable.values())
        lines = (line for name, camera in usable.items() for line in camera_lines(inspection, name, camera))
        return Draft(lines, needs_target=bool(usable) and (inspection.target is not None or needed))

    def figures(self, inspection: Inspection, name: str) -> dict[str, Any]:
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

    def printout(self, inspection: Inspection) -> Printout:
        """Views of the target, their coverage of the images, and notes on the search."""
        if not (views := camera_views(inspection)):
            return Printout()
        notes = [note for view in views.values() for note in view.notes]
        return Printout(target=[target_table(inspection), *coverage_maps(inspection)], notes=notes)

    def pictures(self, inspection: Inspection) -> tuple[list[Plot], list[Drawing]]:
        """Coverage of the image of each camera, and images in which the target was found."""
        plots, drawings = [], []
        for name, view in camera_views(inspection).items():
            size = resolution_of(inspection, name, camera_sources(inspection)[name])
            if size is None or view.cells is None:
                continue
            drawn = coverage(np.array(view.cells), size)
            plots.append(Plot(f"coverage-{name}", drawn, f"{name}: corners over the image"))
            for k, (jpeg, uv) in enumerate(view.images_seen):
                words, image = f"{name}: {len(uv)} corners of the target", b64encode(jpeg).decode()
                drawings.append(Drawing(size, words, [squares(uv, size[0])], [], f"seen-{name}-{k}", image))
        return plots, drawings


INSPECTOR = CameraInspector()


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
