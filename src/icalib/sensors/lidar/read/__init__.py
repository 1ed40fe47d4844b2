"""Reads scans of a LiDAR from arrays in a file, or from topics of point clouds, into a checked stream."""

from __future__ import annotations

import zipfile
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from icalib.base.files import HEAD_BYTES, load_arrays, not_data
from icalib.base.remark import Remark
from icalib.data.folder import PictureFolder
from icalib.data.messages import MessageType, TopicInfo, UnreadType
from icalib.data.recording import Reader, Reading, ReadStream, Recording
from icalib.data.tables import TableFile
from icalib.errors import RecordingError
from icalib.sensors.lidar.read.cloud_files import read_cloud
from icalib.sensors.lidar.read.point_clouds import (
    LIVOX_TYPES,
    Sieve,
    checked_lidar,
    checked_stops,
    parse_cdr,
    parse_ros1,
    point_clouds,
    read_clouds,
    sifted,
)
from icalib.sensors.lidar.read.point_times import MAX_SCAN_PERIODS, UNIT_NS, unit_of_offsets, within_scan
from icalib.sensors.lidar.spec import Lidar
from icalib.sensors.lidar.stream import LidarStream
from icalib.sensors.sensor import TableLayout

MESSAGES = (
    MessageType("sensor_msgs/msg/PointCloud2", "points"),
    *(MessageType(t, "points", parsers={"ros1": parse_ros1, "cdr": parse_cdr}) for t in LIVOX_TYPES),
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
    return read_scan_stamps(path)


TABLES = (TableFile("scans.npz", "scans", "points", _stamps),)


def read(recording: Recording, sensors: Sequence[Lidar], reading: Reading) -> list[ReadStream]:
    """The checked stream of each LiDAR, with notes for the user. Raises RecordingError as `scans` and
    `checked_lidar`."""
    streams = []
    for sensor in sensors:
        where = recording.where(sensor)
        if isinstance(recording, PictureFolder):
            streams.append(checked_stops(scans(recording, sensor), f"{where} ({sensor.name})"))
            continue
        # Checked before the cut, which would take a single wrong stamp for a jump of the clock.
        stream, notes = checked_lidar(scans(recording, sensor), where)
        streams.append((reading.cut(stream, f"{where} ({sensor.name})"), notes))
    return streams


def scans(recording: Recording, sensor: Lidar) -> LidarStream:
    """All scans without unusable points, on which the recording gets a note. A scan may be empty.

    Raises RecordingError naming file or topic if the data are missing or cannot be read, or point times are unknown.
    """
    path, what = source(recording, sensor), f"{recording.where(sensor)} ({sensor.name})"
    if isinstance(path, TopicInfo) and isinstance(recording, PictureFolder):
        stream, notes = read_stops(sensor, recording.stills(path.name), what)
    elif isinstance(path, TopicInfo):
        stream, notes = read_clouds(point_clouds(recording, path.name), sensor, what)
    else:
        assert isinstance(path, Path)
        sieve = Sieve(sensor.min_range_m, sensor.max_range_m)
        stream, notes = in_seconds(recording.inside(read_scans(sensor.name, path), path), sensor, what)
        stream = sifted(stream, sieve)
        notes += (sieve.note(what),)
    for note in filter(None, notes):
        recording.note(note)
    return stream


def source(recording: Recording, sensor: Lidar) -> Path | TopicInfo:
    """File or topic of the scans."""
    has_clouds = isinstance(recording, PictureFolder) and any(t.kind == "points" for t in recording.topics())
    if recording.has_messages or has_clouds:
        return recording.topic(sensor.name, sensor.topic, "points")
    return recording.table(sensor, sensor.path)


# Clouds of a LiDAR that stands still, one file for each stop.


def read_stops(sensor: Lidar, files: Sequence[tuple[int, Path]], what: str) -> tuple[LidarStream, tuple[Remark, ...]]:
    """The clouds in `files` (stamp [ns], path) as scans, all points of which are taken at the stamp, and a note on
    unusable points. what: name of the files in messages."""
    sieve = Sieve(sensor.min_range_m, sensor.max_range_m)
    clouds = [read_cloud(path) for _, path in files]
    clouds = [cloud[sieve.keep(cloud, np.zeros(len(cloud), np.float32))] for cloud in clouds]
    start = np.cumsum([0, *(len(cloud) for cloud in clouds)])
    xyz = np.concatenate([np.empty((0, 3), np.float32), *clouds])
    stamps_ns, offset_s = np.array([stamp for stamp, _ in files], np.int64), np.zeros(len(xyz), np.float32)
    stream = LidarStream(sensor.name, stamps_ns, start, offset_s, xyz, np.full(len(xyz), -1, np.int32))
    note = sieve.note(what)
    return stream, () if note is None else (note,)


# Reads scans of a LiDAR from arrays in a file (npz), as `icalib simulate` writes them. Format: docs/recordings.md.

_REQUIRED = {"stamps_ns": np.int64, "start": np.int64, "offset_s": np.float32, "xyz": np.float32}
_OPTIONAL = {"plane": np.int32}
_N_UNIT_SCANS = 8  # first scans, from which the unit of point times is found


def read_scans(name: str, path: Path) -> LidarStream:
    """The scans in the file `path`. Raises RecordingError naming the file, and the array that is missing or invalid."""
    arrays = _arrays(path, tuple(_REQUIRED | _OPTIONAL))
    missing = [n for n in _REQUIRED if n not in arrays]
    if missing:
        raise RecordingError(f"{path} has no array {missing[0]}; it needs {', '.join(_REQUIRED)}.")
    kinds = _REQUIRED | _OPTIONAL
    checked = {n: _of_kind(path, n, array, kinds[n]) for n, array in arrays.items()}
    if "plane" in checked and not _are_planes(arrays["plane"]):
        raise RecordingError(
            f"{path}: plane must be -1 or a plane's number, from 0 up and below the number of points; correct "
            "the program that writes it."
        )
    if "plane" not in checked:
        checked["plane"] = np.full(len(checked["xyz"]), -1, np.int32)
    try:
        return LidarStream(name, *(checked[n] for n in kinds))
    except RecordingError as error:
        raise RecordingError(f"{path}: {error}") from error


def _are_planes(ids: np.ndarray) -> bool:
    """True if all plane numbers are -1, or from 0 to below the number of points: the largest one determines array
    sizes."""
    return not ids.size or bool(ids.min() >= -1 and ids.max() < ids.size)


def read_scan_stamps(path: Path) -> np.ndarray:
    """Stamps (S,) int64 [ns] of the scans in the file `path`. Raises RecordingError as `read_scans`."""
    arrays = _arrays(path, ("stamps_ns",))
    if "stamps_ns" not in arrays:
        raise RecordingError(f"{path} has no array stamps_ns; it needs {', '.join(_REQUIRED)}.")
    return _of_kind(path, "stamps_ns", arrays["stamps_ns"], np.int64)


def in_seconds(stream: LidarStream, lidar: Lidar, what: str) -> tuple[LidarStream, tuple[Remark, ...]]:
    """`stream` with point times in seconds, NaN for outliers, and a note on the unit. Works in place on the arrays of
    `stream`. Raises RecordingError if no unit fits."""
    scans = [stream.offset_s[a:b] for a, b in pairwise(stream.start.tolist()) if b > a]
    first = [scan[np.isfinite(scan)].astype(np.float64) for scan in scans[:_N_UNIT_SCANS]]
    first = [times for times in first if len(times) and np.ptp(times) > 0]
    if not first or len(scans) < 2:  # all points are taken at the stamp
        return stream, ()
    period_s = float(np.median(np.diff(stream.stamps_ns))) * 1e-9
    if not period_s > 0:
        return stream, ()  # the stamps are refused later
    unit, notes = unit_of_offsets(f"{what}: the times of a scan's points", first, period_s, lidar, "s")
    if unit != "s":
        np.multiply(stream.offset_s, np.float32(1e-9 * UNIT_NS[unit]), out=stream.offset_s)
    for scan in scans:
        timed = np.isfinite(scan)
        timed[timed] = within_scan(scan[timed], MAX_SCAN_PERIODS * period_s)
        scan[~timed] = np.nan
    return stream, notes


def _arrays(path: Path, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    """Those of the arrays `names` that the file has. Raises RecordingError if it cannot be read."""
    try:
        with path.open("rb") as file:
            sentence = not_data(path, file.read(HEAD_BYTES))
        if sentence:
            raise RecordingError(sentence)
        if not zipfile.is_zipfile(path):
            raise RecordingError(f"{path} is not a file of arrays (npz); write it with numpy.savez.")
        return load_arrays(path, names)
    except (OSError, ValueError) as error:
        raise RecordingError(f"{path} cannot be read ({error}); copy or write it again.") from error


def _of_kind(path: Path, name: str, array: np.ndarray, kind: type[np.generic]) -> np.ndarray:
    """The array as `kind`, contiguous. Raises RecordingError if its number of axes or its type of numbers is wrong."""
    axes = 2 if name == "xyz" else 1
    numbers = "iu" if np.issubdtype(kind, np.integer) else "iuf"
    if array.ndim != axes or array.dtype.kind not in numbers or (name == "start" and not array.size):
        wanted = "whole numbers" if numbers == "iu" else "numbers"
        raise RecordingError(
            f"{path}: {name} must be {wanted} with {axes} axes, but is {array.dtype} of shape {array.shape}; "
            "correct the program that writes it."
        )
    return np.ascontiguousarray(array, dtype=kind)


READER = Reader(MESSAGES, TABLES, read, source, UNREAD)
