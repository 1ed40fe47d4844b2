"""Findings on a recording: what is wrong or missing for a calibration, and what to do.

Findings on the set of recorded sensors: whether together they determine the motion, as `calibrate` requires. Topics of
sensors in formats that icalib does not read.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import get_args

from icalib.data.topics import listing, type_not_read
from icalib.tools.inspection.facts import Finding, Inspection
from icalib.tools.inspection.kinds import (
    Subject,
    dependent,
    independent,
    inertial,
    inspectors,
    moves_on_floor,
    moves_without_imu,
    moving,
    nouns,
    without_imu,
)

_ORDER = ("problem", "warning", "hint")


def findings(inspection: Inspection) -> tuple[Finding, ...]:
    """All findings: problems, then warnings, then hints."""
    every = [*missing_sensors(inspection), *unread(inspection)]
    for subject in get_args(Subject):
        every += _jumps(inspection) if subject == "gaps" else ()
        for kind in reversed(inspectors().values()):  # first of sensors that are compared with the IMU
            every += kind.checks[subject](inspection) if subject in kind.checks else ()
    return tuple(sorted(every, key=lambda f: _ORDER.index(f.severity)))


def _jumps(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on clocks that jump."""
    imus = {inspection.sources.sensors[name].topic for name in inertial(inspection)}  # their notes name jumps already
    for stream in inspection.streams:
        if stream.timing is not None and stream.timing.jumps and stream.topic not in imus:
            yield Finding(
                "warning",
                f"{stream.topic.name}: the clock jumps forward; the longest part between jumps is used, "
                f"{stream.timing.duration_s:.1f} s, unless --from and --to choose another.",
            )


def missing_sensors(inspection: Inspection) -> Iterator[Finding]:
    """Findings on missing sensors, and on topics without messages."""
    topic_list = listing([s.topic for s in inspection.streams])
    if inertial(inspection):
        yield from _beside_an_imu(inspection, topic_list)
    elif independent(inspection):
        yield _independent_without_imu(inspection, topic_list)
    elif moves_without_imu(inspection):
        yield Finding(
            "hint",
            "There is no IMU, so smooth motion is assumed, and all other sensors are calibrated relative to "
            f"{without_imu(inspection)[0]}.",
        )
    elif moves_on_floor(inspection):
        yield Finding(
            "hint",
            "There is no IMU, so smooth motion on a flat floor is assumed. The motion comes from "
            f"{' and '.join(without_imu(inspection))}.",
        )
    else:
        yield Finding("problem", f"{_alone(inspection)}: {topic_list}; {_wanted()}.")
    for stream in inspection.streams:
        if stream.topic.kind in ("image", "imu") and not stream.topic.count:
            yield Finding("warning", f"{stream.topic.name} holds no messages; check that this sensor was running.")


def _wanted() -> str:
    return (
        f"record the images of a camera, or an IMU with a {nouns()}, or a {nouns(alone=True)} with the sensors to "
        "calibrate"
    )


def _beside_an_imu(inspection: Inspection, topic_list: str) -> Iterator[Finding]:
    if independent(inspection) or moving(inspection) or inspection.moving_frames:
        return
    if others := dependent(inspection):
        names = " and ".join([*others, *inertial(inspection)])
        sentence = f"{names} do not determine the motion: {topic_list}; record a camera, a {nouns()} as well."
    else:
        sentence = (
            f"There is only an IMU: {topic_list}; record the images of a camera, or a {nouns()}. `icalib allan` "
            "estimates the noise of an IMU at rest."
        )
    yield Finding("problem", sentence)


def _independent_without_imu(inspection: Inspection, topic_list: str) -> Finding:
    kind = inspectors()[inspection.sources.sensors[independent(inspection)[0]].kind]
    others = [*without_imu(inspection), *(f"frames of {topic}" for topic in inspection.moving_frames)]
    if others:
        return Finding(
            "hint",
            f"There is no IMU, so smooth motion is assumed, and {' and '.join(others)} are aligned to the "
            f"{kind.sensor.noun}s.",
        )
    return Finding(
        "warning",
        f"There is no IMU: {topic_list}. {kind.alone}; for more, record sensor_msgs/Imu, or write imu0/data.csv.",
    )


def _alone(inspection: Inspection) -> str:
    """Why sensors that need others cannot be calibrated without an IMU, as the begin of a sentence."""
    others = dependent(inspection)
    if not others:
        return "There is no sensor to calibrate"
    names = " and ".join(others)
    if others == dependent(inspection, lambda kind: kind.sensor.needs_imu):
        return f"Without an IMU {names} cannot be calibrated"
    if dependent(inspection, lambda kind: kind.moves_alone):
        return f"Beside {without_imu(inspection)[0]} there is no sensor that can be calibrated without an IMU"
    return f"Without an IMU the motion is unknown from {names}"


def unread(inspection: Inspection) -> Iterator[Finding]:
    """Warnings on topics with messages that icalib does not read, such as raw LiDAR packets and videos."""
    for stream in inspection.streams:
        if stream.topic.count and (content := type_not_read(stream.topic.type)):
            yield Finding("warning", f"{stream.topic.name} holds {content[1]}.")
