"""Findings on a recording: what is wrong or missing for a calibration, and what to do."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.data.recordings import TopicInfo
from icalib.motion.axes import axis_words, other_axes
from icalib.tools.inspection.facts import CameraSource, Finding, ImuFacts, Inspection, TargetView, Timing
from icalib.tools.inspection.kinds import inspectors, moving, rolls
from icalib.tools.inspection.sensors import missing_sensors
from icalib.tools.inspection.timing import overlap_s
from icalib.tools.inspection.unread import unread

STILL_RAD_S = 0.03  # RMS rate below which the IMU is at rest
WEAK_RAD_S = 0.1  # RMS rate about one axis: below it, parameters about this axis are weakly observable
SECOND_AXIS = 0.05  # smallest ratio of the second principal rate to the first; `calibrate` refuses less
WEAK_M_S2 = 0.3  # RMS of the specific force about its mean, below which a warning is given
FASTEST_RAD_S = 12.0  # largest rate of a rig that is turned by hand
DEGREE = np.pi / 180.0
LIKELIER = 0.7  # rates are in deg/s if the spread of gravity is less than this times that for rad/s,
EXPLAINED = 0.95  # and less than this times the spread without rotation
CONTRARY = 1.2  # a spread of more than this times that without rotation shows that the rates contradict gravity
SHORT_S, LEAST_SHARE = 20.0, 0.3  # shortest recording without a warning; share of images with the target
FEWEST_IMAGES, SLOWEST_IMAGES_HZ = 21, 0.5  # with an IMU or wheels: 20 pairs of images at most 2 s apart
FEWEST_STILLS, FEW_STILLS = 2, 10  # cameras alone: images to estimate a lens at all, and to estimate it well
FLAT_DEG = 15.0  # a warning is given if the 90th percentile of the tilt is below
EMPTY_EDGE = 0.5  # an edge of the image counts as empty if a larger share of its cells is
_ORDER = ("problem", "warning", "hint")


def findings(inspection: Inspection) -> tuple[Finding, ...]:
    """All findings: problems, then warnings, then hints."""
    every = [
        *missing_sensors(inspection),
        *unread(inspection),
        *(f for inspector in inspectors().values() for f in inspector.findings(inspection)),
        *_broken(inspection),
        *_few_stills(inspection),
        *_imu(inspection),
        *_clocks(inspection),
        *_streams(inspection),
        *_target(inspection),
    ]
    return tuple(sorted(every, key=lambda f: _ORDER.index(f.severity)))


def _broken(inspection: Inspection) -> Iterator[Finding]:
    """Findings on cameras and IMUs that cannot be used: problems if no other camera or IMU remains, else warnings."""
    reasons = [reason for c in inspection.sources.cameras if (reason := _unfit(inspection, c))]
    is_fatal = len(reasons) == len(inspection.sources.cameras)
    yield from (Finding("problem" if is_fatal else "warning", reason) for reason in reasons)
    for name, topic in inspection.sources.imus.items():
        stream = inspection.stream(topic)
        if stream.problem:
            is_fatal = inspection.imu is None or inspection.imu == name
            yield Finding("problem" if is_fatal else "warning", stream.problem)
    for name, images in inspection.images.items():
        if 0 < images.damaged < images.decoded:
            yield Finding(
                "warning",
                f"{name}: {images.damaged} of {images.decoded} sampled images cannot be decoded and are "
                "ignored; check the disk and the network of the recorder.",
            )


def _unfit(inspection: Inspection, camera: CameraSource) -> str:
    """Why `calibrate` would refuse the camera; "" if it would not."""
    stream, view, name = inspection.stream(camera.topic), inspection.views.get(camera.name), camera.name
    timing = stream.timing
    if stream.problem or timing is None:
        return stream.problem
    if view is not None and view.problem:
        return view.problem
    fewest, advice = _fewest_images(inspection)
    if timing.count < fewest:
        return f"{name} has {timing.count} images, too few; {advice}."
    if inspection.sources.imus and timing.rate_hz and timing.rate_hz < SLOWEST_IMAGES_HZ:
        return f"{name} takes {timing.rate_hz:.2g} images per second, too few to follow its motion; record 10 to 30."
    if view is not None and view.seen < fewest:
        return f"{name} sees the target in {view.seen} images, too few; keep it in view, and {advice}."
    return ""


def _fewest_images(inspection: Inspection) -> tuple[int, str]:
    """Number of images that `calibrate` requires of a camera, and advice on how to record them."""
    if inspection.sources.imus or rolls(inspection):
        return FEWEST_IMAGES, "record for 30 to 90 s, with 10 to 30 images per second"
    return FEWEST_STILLS, "take 20 to 60 images of the target from all sides"


def _few_stills(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on cameras alone with enough images for a calibration, but too few for a good one."""
    if _fewest_images(inspection)[0] != FEWEST_STILLS:
        return
    for c in inspection.sources.cameras:
        timing, view = inspection.stream(c.topic).timing, inspection.views.get(c.name)
        count = view.seen if view is not None and not view.problem else timing.count if timing else 0
        if FEWEST_STILLS <= count < FEW_STILLS:
            yield Finding(
                "warning",
                f"{c.name} has few images{' with the target' if view else ''} ({count}); take 20 to 60 from all sides.",
            )


def _imu(inspection: Inspection) -> Iterator[Finding]:
    if inspection.imu is None or inspection.imus[inspection.imu].problem:
        return
    facts, name = inspection.imus[inspection.imu], inspection.imu
    yield from (Finding("warning", _capital(note)) for note in facts.notes)
    fast = max(*map(abs, facts.gyro_min), *map(abs, facts.gyro_max))
    radians, degrees, none = facts.gravity_spread or (0.0, 0.0, 0.0)
    if degrees < LIKELIER * radians and degrees < EXPLAINED * none:
        yield Finding(
            "problem",
            f"{name}: the angular rates look like deg/s, for gravity rotates accordingly in the accelerometer; "
            "set gyro_unit: deg/s in the rig file.",
        )
        return
    if radians > CONTRARY * none:
        yield Finding(
            "warning",
            f"{name}: the rotation of gravity in the accelerometer contradicts the angular rates; check that "
            "they are in rad/s, and that the driver gives both sensors in the same axes.",
        )
    if fast > FASTEST_RAD_S:
        yield Finding(
            "warning",
            f"{name} turns at up to {fast:.1f} rad/s ({fast / DEGREE:.0f} deg/s), which blurs images; turn the "
            "rig more slowly, or check that the driver sends rad/s.",
        )
    yield from _motion(inspection, name, facts)


def _motion(inspection: Inspection, name: str, facts: ImuFacts) -> Iterator[Finding]:
    strongest, second, weakest = facts.principal_rms
    if strongest < STILL_RAD_S:
        yield Finding(
            "problem",
            f"{name} hardly moves ({strongest:.3f} rad/s RMS); record again while turning the rig about all "
            f"three axes{' in front of the target' if inspection.sources.cameras else ''}.",
        )
    elif second < SECOND_AXIS * strongest or second < STILL_RAD_S:
        # Rotations of cameras are found from rotations of the rig alone; those of other sensors from its path as well.
        is_fatal = not moving(inspection)
        rest = other_axes(name, facts.principal[0])
        yield Finding(
            "problem" if is_fatal else "warning",
            f"{name} turns about {axis_words(name, facts.principal[0])} only ({strongest:.2f} rad/s RMS; "
            f"{second:.2f} and {weakest:.2f} about the perpendicular axes), so some parameters are "
            "unobservable; "
            f"{'drive over ramps' if rolls(inspection) else f'turn the rig about {rest} as well'}.",
        )
    else:
        for rms, direction in zip(facts.principal_rms, facts.principal, strict=True):
            if rms < WEAK_RAD_S:
                yield Finding(
                    "warning",
                    f"Hardly any rotation about {axis_words(name, direction)} ({rms:.2f} rad/s RMS); turn the rig "
                    "about it as well.",
                )
    if strongest >= STILL_RAD_S and max(facts.accel_std) < WEAK_M_S2:
        yield Finding(
            "warning",
            f"Hardly any acceleration of {name} ({max(facts.accel_std):.2f} m/s^2 RMS about the mean); shake "
            "the rig briskly back and forth, along all three axes.",
        )


def _clocks(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on cameras whose stamps overlap little or not at all with those of the IMU."""
    imu = _imu_timing(inspection)
    if imu is None or inspection.imu is None:
        return
    for c in inspection.sources.cameras:
        stream = inspection.stream(c.topic)
        if stream.timing is None:
            continue
        common = overlap_s(stream.timing, imu)
        duration = stream.timing.duration_s
        if common <= 0.0:
            yield _apart(c, inspection.imu, inspection.sources.imus[inspection.imu], -common)
        elif common < 0.8 * duration:
            yield Finding(
                "warning",
                f"{inspection.imu} was running during {common:.1f} s of the {duration:.1f} s of {c.name}, and images "
                "without readings are ignored; start and stop both together.",
            )


def _apart(camera: CameraSource, imu: str, topic: TopicInfo, apart_s: float) -> Finding:
    """A warning on stamps that are apart_s seconds apart. The reception times in a bag are of one clock, and show
    whether camera and IMU ran at the same time."""
    spans = [(t.first_ns or 0, t.last_ns or 0) for t in (camera.topic, topic)]
    together = min(last for _, last in spans) > max(first for first, _ in spans)
    says = f"The stamps of {camera.name} and {imu} do not overlap, they are {_span(apart_s)} apart"
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


def _streams(inspection: Inspection) -> Iterator[Finding]:
    named = {t.name for t in inspection.sources.imus.values()}  # notes on IMUs name the jumps already
    for stream in inspection.streams:
        if stream.timing is not None and stream.timing.jumps and stream.topic.name not in named:
            yield Finding(
                "warning",
                f"{stream.topic.name}: the clock jumps forward; the longest part between jumps is used, "
                f"{stream.timing.duration_s:.1f} s, unless --from and --to choose another.",
            )
    imu = _imu_timing(inspection)
    if imu is not None and imu.rate_hz and imu.duration_s < SHORT_S:
        yield Finding("warning", f"The IMU ran for {imu.duration_s:.1f} s; record for 30 to 90 s.")
    if imu is not None and imu.gaps:
        yield Finding("warning", f"{inspection.imu} has {_gaps(imu)}; check the load of the recorder and the bus.")
    for c in inspection.sources.cameras:
        timing = inspection.stream(c.topic).timing
        # Images without the target leave gaps in a table of corners, which are no gaps of the camera.
        if timing is not None and timing.gaps and not c.corners:
            yield Finding("hint", f"{c.name} has {_gaps(timing)}.")


def _gaps(t: Timing) -> str:
    return (
        f"{t.gaps} gap{'s' * (t.gaps > 1)}, the longest of {t.longest_gap_s or 0.0:.3f} s at "
        f"{t.longest_gap_at_s or 0.0:.2f} s"
    )


def _imu_timing(inspection: Inspection) -> Timing | None:
    return inspection.stream(inspection.sources.imus[inspection.imu]).timing if inspection.imu else None


def _target(inspection: Inspection) -> Iterator[Finding]:
    if inspection.target is None:
        if not any(c.images for c in inspection.sources.cameras):
            return
        yield from _unknown_target(inspection)
        return
    for v in inspection.views.values():
        if not v.problem:
            yield from _view(v)


def _unknown_target(inspection: Inspection) -> Iterator[Finding]:
    """Hints if no target is known: what the images show, and to give a target."""
    if inspection.without_target:
        yield Finding(
            "hint",
            "A few images of each camera show no tags and no checkerboard, so the draft tracks points of the scene "
            "(tracks: images). If there is a target, give it with --target FILE.",
        )
        return
    for camera, words in inspection.shown.items():
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
            "undetermined there; move the target there as well.",
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


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:] if sentence[:1].isalpha() else sentence
