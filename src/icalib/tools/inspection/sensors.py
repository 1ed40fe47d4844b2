"""Findings on the set of recorded sensors: whether together they determine the motion, as `calibrate` requires."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.data.topics import listing
from icalib.tools.inspection.facts import Finding, Inspection
from icalib.tools.inspection.kinds import inspectors, moves_without_imu, moving, nouns, without_imu


def missing_sensors(found: Inspection) -> Iterator[Finding]:
    """Findings on missing sensors, and on topics without messages."""
    sources, held = found.sources, listing([s.topic for s in found.streams])
    if sources.imus:
        yield from _beside_an_imu(found, held)
    elif sources.cameras:
        yield _cameras_without_imu(found, held)
    elif moves_without_imu(found):
        yield Finding(
            "hint",
            "There is no IMU, so smooth motion is assumed, and all other sensors are calibrated relative to "
            f"{without_imu(found)[0]}.",
        )
    else:
        yield Finding("problem", f"{_alone(found)}: {held}; {_wanted()}.")
    for stream in found.streams:
        if stream.topic.kind in ("image", "imu") and not stream.topic.count:
            yield Finding("warning", f"{stream.topic.name} holds no messages; check that this sensor was running.")


def _wanted() -> str:
    return (
        f"record the images of a camera, or an IMU with a {nouns()}, or a {nouns(alone=True)} with the sensors to "
        "calibrate"
    )


def _beside_an_imu(found: Inspection, held: str) -> Iterator[Finding]:
    sources = found.sources
    if sources.cameras or moving(found) or found.moving_frames:
        return
    if sources.others:
        there = " and ".join([*sources.others, *sources.imus])
        sentence = f"{there} do not determine the motion: {held}; record a camera, a {nouns()} as well."
    else:
        sentence = (
            f"There is only an IMU: {held}; record the images of a camera, or a {nouns()}. `icalib allan` "
            "estimates the noise of an IMU at rest."
        )
    yield Finding("problem", sentence)


def _cameras_without_imu(found: Inspection, held: str) -> Finding:
    others = [*without_imu(found), *(f"frames of {topic}" for topic in found.moving_frames)]
    if others:
        return Finding(
            "hint",
            f"There is no IMU, so smooth motion is assumed, and {' and '.join(others)} are aligned to the cameras.",
        )
    return Finding(
        "warning",
        f"There is no IMU: {held}. Cameras alone give intrinsics, and extrinsics of those that see the target "
        "together; for more, record sensor_msgs/Imu, or write imu0/data.csv.",
    )


def _alone(found: Inspection) -> str:
    """Why sensors without IMU and camera cannot be calibrated, as the begin of a sentence."""
    kinds, others = inspectors(), found.sources.others
    if not others:
        return "There is no sensor to calibrate"
    names = " and ".join(others)
    if all(kinds[source.kind].sensor.needs_imu for source in others.values()):
        return f"Without an IMU {names} cannot be calibrated"
    if any(kinds[source.kind].moves_alone for source in others.values()):
        return f"Beside {without_imu(found)[0]} there is no sensor that can be calibrated without an IMU"
    return f"Without an IMU the motion is unknown from {names}"
