"""A recording and a rig -> measurements that the rest of the program can trust."""

from __future__ import annotations

from icalib.measurements import CornerStream, Measurements
from icalib.recordings.base import Recording
from icalib.recordings.camera_checks import checked_corners
from icalib.recordings.imu_checks import checked_imu
from icalib.rig import Rig


def read_measurements(recording: Recording, rig: Rig) -> Measurements:
    """Read what `rig` asks for from `recording`, and check it.

    What was dropped or looks odd stands in the notes. Raises RecordingError, one sentence naming the file and the line
    or instant, for data that are missing, unreadable, out of order, in other units, or not of this rig.
    """
    imu, notes = checked_imu(recording.imu(rig.imu), recording.where(rig.imu))
    cameras: list[CornerStream] = []
    for camera in rig.cameras:
        corners = recording.corners(camera, rig.target)
        corners, dropped = checked_corners(corners, recording.where(camera), camera.resolution)
        cameras.append(corners)
        notes = notes + dropped
    return Measurements(imu, tuple(cameras), recording.notes() + notes)
