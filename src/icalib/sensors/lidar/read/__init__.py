"""Reads scans of a LiDAR from arrays in a file, or from topics of point clouds, into a checked stream."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from icalib.data.recordings.base import Reading, ReadStream, Recording
from icalib.data.tables.table import TableFile
from icalib.data.topics import MessageType, TopicInfo, UnreadType
from icalib.sensors.lidar.read import livox
from icalib.sensors.lidar.read.checks import Sieve, checked_lidar, sifted
from icalib.sensors.lidar.read.point_clouds import point_clouds, read_clouds
from icalib.sensors.lidar.read.scans import in_seconds, read_scan_stamps, read_scans
from icalib.sensors.lidar.spec import Lidar
from icalib.sensors.lidar.stream import LidarStream
from icalib.sensors.sensor import TableLayout

MESSAGES = (
    MessageType("sensor_msgs/msg/PointCloud2", "points"),
    *(MessageType(t, "points", parsers={"ros1": livox.parse_ros1, "cdr": livox.parse_cdr}) for t in livox.TYPES),
)
UNREAD = (
    UnreadType(
        r"(velodyne|ouster|hesai|pandar|rslidar|robosense|nebula|lslidar|seyond|innovusion|vanjee)\w*/msg/"
        r"\w*(scan|packets?|packetmsg|udpframe)",
        "points",
        "raw packets of a LiDAR; replay the recording with the LiDAR's driver, and record the sensor_msgs/PointCloud2 "
        "that it sends",
    ),
    UnreadType(
        r"sensor_msgs/msg/(MultiEcho)?LaserScan",
        "points",
        "scans of one plane, and icalib needs a 3D LiDAR's sensor_msgs/PointCloud2; run scan matching, and give its "
        "nav_msgs/Odometry as a sensor of type: pose, kind: relative",
    ),
    UnreadType(
        r"\.(pcd|ply|las|laz) files",
        "points",
        "clouds that have no stamps; record the driver's sensor_msgs/PointCloud2 in a bag, or write scans.npz "
        "(docs/recordings.md)",
    ),
)


def _stamps(path: Path, layout: TableLayout) -> np.ndarray:
    """(S,) int64 stamps [ns] of a file of scans."""
    del layout
    return read_scan_stamps(path)


TABLES = (TableFile("scans.npz", "scans", "points", _stamps),)


def read(recording: Recording, sensors: Sequence[Lidar], reading: Reading) -> list[ReadStream]:
    """The checked stream of each LiDAR, with notes for the user. Raises RecordingError as `scans` and
    `checked_lidar`."""
    streams = []
    for sensor in sensors:
        where = recording.where(sensor)
        # Checked before the cut, which would take a single wrong stamp for a jump of the clock.
        stream, notes = checked_lidar(scans(recording, sensor), where)
        streams.append((reading.cut(stream, f"{where} ({sensor.name})"), notes))
    return streams


def scans(recording: Recording, sensor: Lidar) -> LidarStream:
    """All scans without unusable points, on which the recording gets a note. A scan may be empty.

    Raises RecordingError naming file or topic if the data are missing or cannot be read, or point times are unknown.
    """
    path, what = source(recording, sensor), f"{recording.where(sensor)} ({sensor.name})"
    if isinstance(path, TopicInfo):
        stream, notes = read_clouds(point_clouds(recording, path.name), sensor, what)
    else:
        sieve = Sieve(sensor.min_range_m, sensor.max_range_m)
        stream, notes = in_seconds(recording.inside(read_scans(sensor.name, path), path), sensor, what)
        stream = sifted(stream, sieve)
        notes += (sieve.note(what),)
    for note in filter(None, notes):
        recording.note(note)
    return stream


def source(recording: Recording, sensor: Lidar) -> Path | TopicInfo:
    """File or topic of the scans."""
    if recording.has_messages:
        return recording.topic(sensor.name, sensor.topic, "points")
    return recording.table(sensor, sensor.path)
