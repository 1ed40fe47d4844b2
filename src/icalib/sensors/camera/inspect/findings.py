"""Findings on cameras: images, clocks, and the target as they see it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.data.recordings import TopicInfo
from icalib.sensors.camera.inspect.facts import TargetView, camera_sources, camera_views, patterns, without_target
from icalib.tools.inspection.facts import Finding, Inspection, Timing, imu_timing, overlap_s, words_on_gaps
from icalib.tools.inspection.kinds import inertial, rolls

LEAST_SHARE = 0.3  # share of images with the target
FEWEST_IMAGES, SLOWEST_IMAGES_HZ = 21, 0.5  # with an IMU or wheels: 20 pairs of images at most 2 s apart
FEWEST_STILLS, FEW_STILLS = 2, 10  # cameras alone: images to estimate a lens at all, and to estimate it well
FLAT_DEG = 15.0  # a warning is given if the 90th percentile of the tilt is below
EMPTY_EDGE = 0.5  # an edge of the image counts as empty if a larger share of its cells is


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


def empty_borders(cells: tuple[tuple[int, ...], ...]) -> tuple[str, ...]:
    """Names of empty image regions, such as "top edge": edges along which most cells are empty, and empty corners on
    the remaining edges. cells: number of target corners in each cell, row by row."""
    grid = np.array(cells)
    edges = {"top": grid[0], "bottom": grid[-1], "left": grid[:, 0], "right": grid[:, -1]}
    empty = [name for name, line in edges.items() if (line == 0).mean() > EMPTY_EDGE]
    corners = [
        f"{rows} {cols} corner"
        for rows, i in (("top", 0), ("bottom", -1))
        for cols, j in (("left", 0), ("right", -1))
        if grid[i, j] == 0 and rows not in empty and cols not in empty
    ]
    return (*(f"{name} edge" for name in empty), *corners)
