"""A recording and a rig -> measurements that the rest of the program can trust."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from icalib.data.checks.imu_checks import read_imu
from icalib.data.checks.pose_checks import checked_poses
from icalib.data.checks.wheel_checks import checked_wheels
from icalib.data.images.topics import image_topics
from icalib.data.measurements import CornerStream, LidarStream, Measurements, TrackStream
from icalib.data.messages.lidar_checks import checked_lidar
from icalib.data.recordings.base import Recording
from icalib.data.stamps.camera_checks import checked_corners
from icalib.data.stamps.jumps import LONGEST_S, ClockJumps
from icalib.data.stamps.sections import S
from icalib.data.tables.poses import as_frame_sensor
from icalib.errors import RecordingError
from icalib.rig import Camera, Lidar, PoseSensor, Rig, Wheels

FindCorners = Callable[[Recording, Camera], tuple[CornerStream, tuple[str, ...]]]
FindTracks = Callable[[Recording, Sequence[Camera]], Sequence[tuple[TrackStream, tuple[str, ...]]]]


def tables_only(recording: Recording, camera: Camera) -> tuple[CornerStream, tuple[str, ...]]:
    """For recordings without images. Raises RecordingError."""
    raise RecordingError(
        f"{recording.where(camera)} holds images, not corners; give a function that detects the target."
    )


def track_tables_only(recording: Recording, cameras: Sequence[Camera]) -> Sequence[tuple[TrackStream, tuple[str, ...]]]:
    """For recordings without images. Raises RecordingError."""
    raise RecordingError(f"{recording.where(cameras[0])} holds images; give a function that tracks features in them.")


def read_measurements(
    recording: Recording, rig: Rig, find: FindCorners = tables_only, follow: FindTracks = track_tables_only
) -> Measurements:
    """Read what `rig` asks for from `recording`, and check it; `find` finds corners, and `follow` feature tracks, in
    images. Of a clock that jumps one part is used.

    What was dropped or looks odd stands in the notes. Raises RecordingError, one sentence naming the file and the line
    or instant, for data that are missing, unreadable, out of order, in other units, or not of this rig.
    """
    recording.use_layouts(rig.poses)
    imu, notes, jumps = None, (), ClockJumps(LONGEST_S)
    if rig.imu is not None:
        imu, notes = read_imu(recording, rig.imu, jumps)
    cut = jumps.cut if is_timed(rig) else _whole
    tracks, followed = _tracks(recording, rig, follow, cut)
    cameras, seen = _corners(recording, rig, find, cut)

    def read(stream: S, sensor: Wheels | PoseSensor) -> tuple[S, str]:
        where = recording.where(sensor)
        return cut(stream, f"{where} ({sensor.name})"), where

    lidars = [_scans(recording, s, cut) for s in rig.lidars]
    wheels = [checked_wheels(stream, w, where) for w in rig.wheels for stream, where in [read(recording.wheels(w), w)]]
    poses = [
        checked_poses(as_frame_sensor(stream, s), s, where)
        for s in rig.poses
        for stream, where in [read(recording.poses(s), s)]
    ]
    others = (*lidars, *wheels, *poses)
    notes = sum((found for _, found in others), notes + followed + seen)
    imus = () if imu is None else (imu,)
    streams = (*imus, *cameras, *tracks, *(stream for stream, _ in others))
    return Measurements.of_streams(*streams, notes=recording.notes() + jumps.notes + notes)


def _scans(
    recording: Recording, sensor: Lidar, cut: Callable[[LidarStream, str], LidarStream]
) -> tuple[LidarStream, tuple[str, ...]]:
    """Checked before it is cut: a single wrong stamp is no jump of the clock."""
    where = recording.where(sensor)
    stream, notes = checked_lidar(recording.lidar(sensor), where)
    return cut(stream, f"{where} ({sensor.name})"), notes


def is_timed(rig: Rig) -> bool:
    """Whether clocks count: cameras alone only need to know which images were taken together."""
    return rig.imu is not None or len(rig.wheels) + len(rig.poses) > 0


def without_jumps(rig: Rig, measurements: Measurements) -> Measurements:
    """The same of measurements in memory. What was read from files has no jumps any more."""
    m, jumps = measurements, ClockJumps(LONGEST_S)
    if not is_timed(rig):
        return m

    streams = {key: jumps.cut(s, s.name) for key, s in m.streams.items()}
    return replace(m, streams=streams, notes=m.notes + jumps.notes) if jumps.notes else m


def _whole(stream: S, what: str) -> S:
    del what
    return stream


def _tracks(
    recording: Recording, rig: Rig, follow: FindTracks, cut: Callable[[TrackStream, str], TrackStream]
) -> tuple[tuple[TrackStream, ...], tuple[str, ...]]:
    """Feature tracks of each camera that has some, from its table or its images, and notes."""
    pictured = [c for c in rig.cameras if c.tracks_images]
    tables = {c.name: recording.tracks(c) for c in rig.cameras if c.tracks is not None and not c.tracks_images}
    image_topics(recording, pictured)
    above = 1 + max((int(t.feature.max(initial=-1)) for t in tables.values()), default=-1)
    seen = follow(recording, pictured) if pictured else ()
    of_images = {stream.name: (replace(stream, feature=stream.feature + above), notes) for stream, notes in seen}
    by_name = {name: (stream, ()) for name, stream in tables.items()} | of_images
    found = [by_name[c.name] for c in rig.cameras if c.name in by_name]
    tracks = tuple(cut(stream, f"the tracks of {stream.name}") for stream, _ in found)
    return tracks, sum((notes for _, notes in found), ())


def _corners(
    recording: Recording, rig: Rig, find: FindCorners, cut: Callable[[CornerStream, str], CornerStream]
) -> tuple[tuple[CornerStream, ...], tuple[str, ...]]:
    """Of each camera that sees the target, from its table or its images, cut and checked; and notes."""
    seeing = [c for c in rig.cameras if rig.has_target and (c.tracks is None or recording.sees(c))]
    pictured = [c for c in seeing if not recording.has_corners(c)]
    image_topics(recording, pictured)
    cameras, notes = [], ()
    for camera in seeing:
        if camera in pictured:
            corners, found = find(recording, camera)
        else:
            corners, found = recording.corners(camera, rig.target), ()
        where = recording.where(camera)
        corners, dropped = checked_corners(cut(corners, f"{where} ({camera.name})"), where, camera.resolution)
        cameras.append(corners)
        notes = notes + found + dropped
    return tuple(cameras), notes
