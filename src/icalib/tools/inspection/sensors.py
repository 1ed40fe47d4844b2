"""Do the sensors that were recorded show the motion together, as `calibrate` asks of a rig?"""

from __future__ import annotations

from collections.abc import Iterator

from icalib.data.images.topics import listing
from icalib.tools.inspection.facts import Finding, Inspection


def missing_sensors(found: Inspection) -> Iterator[Finding]:
    """What there is too little of, and topics without messages."""
    sources, held = found.sources, listing([s.topic for s in found.streams])
    if sources.imus:
        yield from _beside_an_imu(found, held)
    elif sources.cameras:
        yield _cameras_without_imu(found, held)
    elif len(sources.poses) + len(sources.wheels) > 1 and sources.poses:
        yield Finding(
            "hint",
            "There is no IMU, so smooth motion is assumed, and all other sensors are calibrated relative to "
            f"{next(iter(sources.poses))}.",
        )
    else:
        yield Finding("problem", f"{_alone(found)}: {held}; {_WANTED}.")
    for stream in found.streams:
        if stream.topic.kind in ("image", "imu") and not stream.topic.count:
            yield Finding("warning", f"{stream.topic.name} holds no messages; check that this sensor was running.")


_WANTED = "record the images of a camera, or an IMU with a LiDAR, poses or odometry, or poses with wheels"


def _beside_an_imu(found: Inspection, held: str) -> Iterator[Finding]:
    sources = found.sources
    if sources.cameras or sources.lidars or sources.poses or found.moving_frames:
        return
    if sources.wheels:
        yield Finding(
            "problem",
            f"Wheels and an IMU do not determine the motion: {held}; record a camera, a LiDAR or poses as well.",
        )
    else:
        yield Finding(
            "problem",
            f"There is only an IMU: {held}; record the images of a camera, a LiDAR, or poses. `icalib allan` "
            "estimates the noise of an IMU at rest.",
        )


def _cameras_without_imu(found: Inspection, held: str) -> Finding:
    frames = [f"frames of {topic}" for topic in found.moving_frames]
    others = [*found.sources.poses, *found.sources.wheels, *frames]
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
    if found.sources.lidars:
        return "A LiDAR without an IMU does not determine the motion"
    if found.sources.poses:
        return "There are only poses, and nothing to calibrate with them"
    if found.sources.wheels:
        return "Wheels alone do not determine the motion"
    return "There is no sensor to calibrate"
