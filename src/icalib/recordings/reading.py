"""A recording and a rig -> measurements that the rest of the program can trust."""

from __future__ import annotations

from collections.abc import Callable

from icalib.errors import RecordingError
from icalib.measurements import CornerStream, Measurements
from icalib.recordings.base import Recording
from icalib.recordings.camera_checks import checked_corners
from icalib.recordings.imu_checks import checked_imu
from icalib.recordings.lidar_checks import checked_lidar
from icalib.recordings.pose_checks import checked_poses
from icalib.recordings.topics import image_topics
from icalib.recordings.wheel_checks import checked_wheels
from icalib.rig import Camera, Rig

FindCorners = Callable[[Recording, Camera], tuple[CornerStream, tuple[str, ...]]]


def tables_only(recording: Recording, camera: Camera) -> tuple[CornerStream, tuple[str, ...]]:
    """For recordings without images. Raises RecordingError."""
    raise RecordingError(f"{recording.where(camera)} holds images, not corners; nothing here looks for the target.")


def read_measurements(recording: Recording, rig: Rig, find: FindCorners = tables_only) -> Measurements:
    """Read what `rig` asks for from `recording`, and check it; `find` finds corners where there are images.

    What was dropped or looks odd stands in the notes. Raises RecordingError, one sentence naming the file and the line
    or instant, for data that are missing, unreadable, out of order, in other units, or not of this rig.
    """
    imu, notes = None, ()
    tracks = tuple(recording.tracks(c) for c in rig.cameras if c.tracks is not None)
    if rig.imu is not None:
        imu, notes = checked_imu(recording.imu(rig.imu), recording.where(rig.imu))
    cameras, seen = _corners(recording, rig, find)
    lidars = [checked_lidar(recording.lidar(s), recording.where(s)) for s in rig.lidars]
    wheels = [checked_wheels(recording.wheels(w), w, recording.where(w)) for w in rig.wheels]
    poses = [checked_poses(recording.poses(s), s, recording.where(s)) for s in rig.poses]
    notes = sum((found for _, found in (*lidars, *wheels, *poses)), notes + seen)
    return Measurements(
        imu, cameras, recording.notes() + notes, tracks=tracks,
        lidars=tuple(stream for stream, _ in lidars), wheels=tuple(stream for stream, _ in wheels),
        poses=tuple(stream for stream, _ in poses),
    )  # fmt: skip


def _corners(recording: Recording, rig: Rig, find: FindCorners) -> tuple[tuple[CornerStream, ...], tuple[str, ...]]:
    """Of each camera that sees the target, from its table or its images, checked; and notes."""
    seeing = [c for c in rig.cameras if rig.has_target and (c.tracks is None or recording.sees(c))]
    pictured = [c for c in seeing if not recording.has_corners(c)]
    image_topics(recording, pictured)
    cameras, notes = [], ()
    for camera in seeing:
        if camera in pictured:
            corners, found = find(recording, camera)
        else:
            corners, found = recording.corners(camera, rig.target), ()
        corners, dropped = checked_corners(corners, recording.where(camera), camera.resolution)
        cameras.append(corners)
        notes = notes + found + dropped
    return tuple(cameras), notes
