"""Point clouds of messages: fields, checks, and the formats of Livox."""

from __future__ import annotations

import struct
from collections import Counter, namedtuple
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import LidarStream
from icalib.data.messages import HasMessages
from icalib.data.stamps import rate_sentence
from icalib.errors import RecordingError
from icalib.rig import Lidar, TimeUnit
from icalib.sensors.lidar.read.point_times import (
    PointTimes,
    SweepOrder,
    at_even_steps,
    clock_note,
    find_point_times,
    find_sweep,
    in_order,
    likely_fields,
    selected,
    sweep_share,
    with_even_stamps,
    without_repeats,
)

# Converts point cloud messages to the stream of a LiDAR.

_N_TIMING_CLOUDS = 8  # first clouds with points, from which field and unit of point times are found


@dataclass(frozen=True)
class PointCloud:
    """A message with points (N,): a structured array with the fields of the message (x, y, z [m], ...), in message
    order. height: number of rows of the message."""

    stamp_ns: int
    frame: str
    points: np.ndarray
    height: int = 1

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the fields with a single number per point."""
        kind = self.points.dtype
        return tuple(name for name in kind.names or () if not kind[name].shape)


Timing = Callable[
    [PointCloud, np.ndarray], tuple[int, np.ndarray]
]  # (cloud, points (N, 3)) -> stamp [ns], times (N,) since it [s, or turns for azimuth]


def read_clouds(clouds: Iterator[PointCloud], lidar: Lidar, what: str) -> tuple[LidarStream, tuple[Remark, ...]]:
    """The stream of all usable points of `clouds`, and notes on rejected points and on point times. A scan may be
    empty. what: name of the topic in messages.

    Raises RecordingError if fewer than two clouds have points, or if points have no coordinates or no known times.
    """
    ahead = _first_clouds(clouds, what)
    alike, fields = _with_usual_fields(ahead)
    timing, notes = _timing(alike, lidar, what)
    sieve = Sieve(lidar.min_range_m, lidar.max_range_m)
    stamps: list[int] = []
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    others: list[int] = []
    for cloud in chain(ahead, clouds):
        if len(cloud.points) and not fields.issubset(cloud.fields):
            others.append(cloud.stamp_ns)
            continue
        stamp_ns, xyz, offset = cloud.stamp_ns, np.empty((0, 3), np.float32), np.empty(0, np.float32)
        if len(cloud.points):  # a cloud without points may have no fields
            xyz = coordinates(cloud, what)
            stamp_ns, offset = timing(cloud, xyz)
        keep = sieve.keep(xyz, offset)
        stamps.append(stamp_ns)
        parts.append((xyz, offset) if keep.all() else (xyz[keep], offset[keep]))
    del ahead, alike
    stream = _joined(lidar, np.array(stamps, np.int64), parts)
    if lidar.point_time == "azimuth":
        period_s = float(np.median(np.diff(stream.stamps_ns))) * 1e-9
        np.multiply(stream.offset_s, np.float32(period_s), out=stream.offset_s)
    if others:
        note = Remark(
            "clouds_lack_fields",
            f"{what}: {len(others)} clouds lack fields of the others and were left out, the first at {others[0]} ns.",
        )
        notes += (note,)
    dropped = sieve.note(what)
    return stream, notes + ((dropped,) if dropped else ())


def timing_fields(clouds: Iterator[PointCloud], lidar: Lidar, what: str) -> tuple[str | None, TimeUnit | None]:
    """point_time_field and point_time_unit that the rig file must give for a LiDAR with these clouds; each None if it
    is detected from the data. Only the first clouds are read.

    Raises RecordingError as `read_clouds` if no field can be the time.
    """
    ahead, _ = _with_usual_fields(_first_clouds(clouds, what))
    stamps_ns, scans = _stamps(ahead, what), [cloud.points for cloud in ahead]
    try:
        times, notes = find_point_times(what, stamps_ns, scans, lidar)
        return None, times.unit if notes else None
    except RecordingError:
        for field in likely_fields(scans):
            try:
                times, notes = find_point_times(what, stamps_ns, scans, replace(lidar, point_time_field=field))
            except RecordingError:
                continue
            return field, times.unit
        raise


def _first_clouds(clouds: Iterator[PointCloud], what: str) -> list[PointCloud]:
    """Clouds up to the one that is number _N_TIMING_CLOUDS with points. Raises RecordingError if fewer than two have
    points."""
    first: list[PointCloud] = []
    filled = 0
    for cloud in clouds:
        first.append(cloud)
        filled += len(cloud.points) > 0
        if filled == _N_TIMING_CLOUDS:
            return first
    if filled < 2:
        raise RecordingError(
            f"{what}: {filled} of {len(first)} clouds have points; check the driver, and record again."
        )
    return first


def _with_usual_fields(clouds: Sequence[PointCloud]) -> tuple[list[PointCloud], frozenset[str]]:
    """Those clouds that have points and the most common set of fields; and this set."""
    filled = [cloud for cloud in clouds if len(cloud.points)]
    usual = frozenset(Counter(cloud.fields for cloud in filled).most_common(1)[0][0])
    return [cloud for cloud in filled if usual.issubset(cloud.fields)], usual


def coordinates(cloud: PointCloud, what: str) -> np.ndarray:
    """Points (N, 3) float32 [m] in the LiDAR's frame. Raises RecordingError if the cloud has no x, y, z."""
    if any(axis not in cloud.fields for axis in "xyz"):
        names = ", ".join(cloud.fields)
        raise RecordingError(
            f"{what}: the points at {cloud.stamp_ns} ns have no x, y, z, but {names}; choose another topic."
        )
    xyz = np.empty((len(cloud.points), 3), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):  # 1e300 m becomes infinite
        for column, axis in enumerate("xyz"):
            xyz[:, column] = cloud.points[axis]
    return xyz


def _stamps(clouds: Sequence[PointCloud], what: str) -> np.ndarray:
    """(S,) stamps [ns]. Raises RecordingError if they do not increase."""
    stamps_ns = np.array([cloud.stamp_ns for cloud in clouds], np.int64)
    if len(stamps_ns) < 2 or np.median(np.diff(stamps_ns)) <= 0:
        raise RecordingError(
            f"{what}: the stamps of the first clouds do not increase ({stamps_ns[0]} ns, then {stamps_ns[-1]} "
            "ns); have the driver stamp each cloud, and record again."
        )
    return stamps_ns


def _timing(clouds: Sequence[PointCloud], lidar: Lidar, what: str) -> tuple[Timing, tuple[Remark, ...]]:
    """The function that computes stamp and point times of a cloud, chosen from the first clouds; and notes. Raises
    RecordingError if point times are not known."""
    stamps_ns = _stamps(clouds, what)
    if lidar.point_time == "snapshot":
        note = Remark(
            "point_times_ignored",
            f"{what}: all points of a cloud are taken at its stamp, as point_time says; motion within it is ignored.",
        )
        return _at_the_stamp, (note,)
    if lidar.point_time == "azimuth":
        sweep = find_sweep([coordinates(cloud, what) for cloud in clouds])
        if sweep is None:
            raise RecordingError(
                f"{what}: the points are not in order of azimuth, so their times cannot be computed from it; "
                f"set point_time of {lidar.name} to snapshot in the rig file, or record a cloud with times."
            )
        turn = "counterclockwise" if sweep.direction > 0 else "clockwise"
        sentence = f"{what}: point times are computed from the azimuth, {turn}, one turn per cloud, as point_time says."
        note = Remark("point_times_by_azimuth", sentence)
        return partial(_by_azimuth, sweep), (note,)
    times, notes = find_point_times(what, stamps_ns, [cloud.points for cloud in clouds], lidar)
    first_ns, _ = _by_field(times, clouds[0], clouds[0].points)
    if note := clock_note(what, times, clouds[0].stamp_ns, first_ns):
        notes += (note,)
    return partial(_by_field, times), notes


def _at_the_stamp(cloud: PointCloud, xyz: np.ndarray) -> tuple[int, np.ndarray]:
    """Stamp [ns] of the cloud, and times of 0 (N,)."""
    return cloud.stamp_ns, np.zeros(len(xyz), np.float32)


def _by_azimuth(sweep: SweepOrder, cloud: PointCloud, xyz: np.ndarray) -> tuple[int, np.ndarray]:
    """Stamp [ns] of the cloud, and times (N,) since it as shares of a turn."""
    return cloud.stamp_ns, sweep_share(sweep, xyz, cloud.height).astype(np.float32)


def _by_field(times: PointTimes, cloud: PointCloud, xyz: np.ndarray) -> tuple[int, np.ndarray]:
    """Stamp [ns], and times (N,) since it [s], from the field of point times."""
    return times.of(cloud.stamp_ns, cloud.points[times.field])


def _joined(lidar: Lidar, stamps_ns: np.ndarray, parts: list[tuple[np.ndarray, np.ndarray]]) -> LidarStream:
    """The stream of all clouds. Columns are joined one after another, so that at most one is in memory twice. Empties
    `parts`."""
    start = np.concatenate([[0], np.cumsum([len(offset) for _, offset in parts], dtype=np.int64)])
    offsets = [offset for _, offset in parts]
    points = [xyz for xyz, _ in parts]
    parts.clear()
    xyz = np.concatenate(points)
    points.clear()
    return LidarStream(lidar.name, stamps_ns, start, np.concatenate(offsets), xyz, np.full(len(xyz), -1, np.int32))


def point_clouds(bag: HasMessages, topic: str) -> Iterator[PointCloud]:
    """Yields the PointCloud2 or Livox CustomMsg messages of `topic`. Messages with too little data for their points are
    damaged and left out. Raises RecordingError as `BagRecording.messages`."""
    for stamp_ns, (frame, points, height) in bag.messages(topic, "points", _points_of):
        yield PointCloud(stamp_ns, frame, points, height)


def _points_of(message: Any) -> tuple[str, np.ndarray, int]:
    """Frame, points and number of rows of a message. Raises ValueError if its data are too short for its points, or a
    point for its fields."""
    m = message
    if isinstance(m, LivoxCloud):
        return m.header.frame_id, m.points, 1
    if len(m.data) < m.row_step * m.height or m.row_step < m.point_step * m.width:
        raise ValueError(f"{m.width * m.height} points do not fit {len(m.data)} bytes")
    if not m.width * m.height:
        return m.header.frame_id, np.empty(0), m.height
    kind = _point_type(m)
    rows = m.data[: m.row_step * m.height].reshape(m.height, m.row_step)[:, : m.point_step * m.width]
    return m.header.frame_id, np.ascontiguousarray(rows).reshape(-1).view(kind), m.height


def _end(field: Any) -> int:
    """Bytes from the begin of a point to the end of a PointField."""
    return field.offset + max(field.count, 1) * int(_FIELD_TYPES[field.datatype][1])


_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # of PointField


def _point_type(message: Any) -> np.dtype:
    """Structured dtype of the points of a message. Raises ValueError if its fields cannot be read, or lie beyond the
    bytes of a point: numpy does not check large offsets."""
    order = ">" if message.is_bigendian else "<"
    wrong = [f.name for f in message.fields if f.datatype not in _FIELD_TYPES or _end(f) > message.point_step]
    if wrong or message.point_step < 1:
        raise ValueError(
            f"its point fields cannot be read: {', '.join(wrong) or 'all'}, in points of {message.point_step} bytes"
        )
    formats = [(order + _FIELD_TYPES[f.datatype], (f.count,) if f.count > 1 else ()) for f in message.fields]
    return np.dtype(
        {
            "names": [f.name for f in message.fields],
            "formats": formats,
            "offsets": [f.offset for f in message.fields],
            "itemsize": message.point_step,
        }
    )


# Checks of points and scans: usable points, and stamps that fit the point times.

_SCAN_RATE_HZ = (0.1, 1000.0)  # lowest and highest plausible rate
_MAX_POINT_PERIODS = 2.0  # time from the stamp of a scan to its points, in scan periods
_MAX_FAR_SHARE = 0.1  # of the scans; if more exceed _MAX_POINT_PERIODS, unit or origin of point times is wrong
_POINTS_PER_BATCH = 1_000_000  # bounds the memory


class Sieve:
    """Selects finite points with a time, from min_range_m to max_range_m, and counts all other points by reason."""

    def __init__(self, min_range_m: float, max_range_m: float) -> None:
        self._near_m, self._far_m = min_range_m, max_range_m
        self._total = 0
        self._dropped = np.zeros(5, np.int64)

    def keep(self, xyz: np.ndarray, offset_s: np.ndarray) -> np.ndarray:
        """(N,) bool: the point xyz (N, 3) [m] can be used. offset_s (N,): its time, NaN if it has none."""
        with np.errstate(over="ignore", invalid="ignore"):  # squares of huge values overflow to infinity
            r2 = np.einsum("ij,ij->i", xyz, xyz)
        near, far = r2 < np.float32(self._near_m) ** 2, r2 > np.float32(self._far_m) ** 2
        good, timed = np.isfinite(r2), np.isfinite(offset_s)
        kept = good & timed & ~near & ~far
        self._total += len(r2)
        if not kept.all():
            zero = r2 == 0
            reasons = (~good, good & zero, good & near & ~zero, good & far, good & ~near & ~far & ~timed)
            self._dropped += [np.count_nonzero(reason) for reason in reasons]
        return kept

    def note(self, what: str) -> Remark | None:
        """A sentence on the points left out of `what`, by reason; None if all were kept."""
        if not self._dropped.any():
            return None
        words = (
            "without numbers",
            "at zero",
            f"nearer than {self._near_m:g} m",
            f"farther than {self._far_m:g} m",
            "without a time within their scan",
        )
        parts = [f"{count} {why}" for count, why in zip(self._dropped, words, strict=True) if count]
        return Remark("lidar_points_unusable", f"{what}: of {self._total} points {', '.join(parts)} were left out.")


def sifted(stream: LidarStream, sieve: Sieve) -> LidarStream:
    """The stream with the points that the sieve keeps; a scan may become empty. Reuses the arrays of `stream`, which
    are invalid afterwards, as a second cloud may not fit in memory."""
    n = len(stream.xyz)
    columns = (stream.offset_s, stream.xyz, stream.plane)
    keep = np.empty(n, bool)
    kept = 0
    for begin in range(0, n, _POINTS_PER_BATCH):
        part = slice(begin, min(begin + _POINTS_PER_BATCH, n))
        keep[part] = sieve.keep(stream.xyz[part], stream.offset_s[part])
        count = int(np.count_nonzero(keep[part]))
        for column in columns:
            column[kept : kept + count] = column[part][keep[part]]
        kept += count
    start = stream.start - np.searchsorted(np.flatnonzero(~keep), stream.start)
    return LidarStream(stream.name, stream.stamps_ns, start, *(column[:kept] for column in columns))


def checked_lidar(stream: LidarStream, where: str) -> tuple[LidarStream, tuple[Remark, ...]]:
    """`stream` without scans that are empty, repeat a recent scan, or have a wrong stamp; and notes on these.

    Raises RecordingError naming `where` and the instant: fewer than two scans with points, a clock that was set back,
    an implausible rate, or points far from the stamp of their scan.
    """
    what = f"{where} ({stream.name})"
    stream, notes = checked_stops(stream, what, 2)
    for check in (without_repeats, in_order, with_even_stamps, at_even_steps):
        stream, more = check(stream, what)
        notes += more
    if len(stream.stamps_ns) < 2:
        raise RecordingError(
            f"{what}: all scans are the same; the LiDAR or its driver froze; restart it, and record again."
        )
    sentence = rate_sentence(what, stream.stamps_ns, *_SCAN_RATE_HZ)
    if sentence:
        raise RecordingError(sentence)
    stream, more = _near_their_stamps(stream, what)
    return stream, notes + more


def checked_stops(stream: LidarStream, what: str, fewest: int = 1) -> tuple[LidarStream, tuple[Remark, ...]]:
    """`stream` without empty scans, and a note on these. Raises RecordingError naming `what` if fewer scans
    than `fewest` have points."""
    filled = np.diff(stream.start) > 0
    if filled.sum() < fewest:
        raise RecordingError(
            f"{what}: {int(filled.sum())} of {len(filled)} scans have usable points; a calibration needs the "
            "whole recording. Check the driver, and min_range and max_range in the rig file."
        )
    if filled.all():
        return stream, ()
    sentence = f"{what}: {int((~filled).sum())} of {len(filled)} scans have no usable point and were left out."
    return stream.of_scans(filled, stream.stamps_ns[filled]), (Remark("scans_empty", sentence),)


def _near_their_stamps(stream: LidarStream, what: str) -> tuple[LidarStream, tuple[Remark, ...]]:
    """The stream without scans whose points are far in time from the stamp, and a note. Raises RecordingError if there
    are many such scans."""
    period_s = float(np.median(np.diff(stream.stamps_ns))) * 1e-9
    low, high = (extreme.reduceat(stream.offset_s, stream.start[:-1]) for extreme in (np.minimum, np.maximum))
    far = np.maximum(-low, high) > _MAX_POINT_PERIODS * period_s
    if not far.any():
        return stream, ()
    if far.mean() > _MAX_FAR_SHARE:
        raise RecordingError(
            f"{what}: points are {low[far].min():.4g} to {high[far].max():.4g} s from the stamp of their scan, "
            f"but scans are {period_s:.4g} s apart; write point times relative to the stamp of the scan."
        )
    first = stream.stamps_ns[np.argmax(far)]
    note = Remark(
        "points_far_from_stamp",
        f"{what}: {int(far.sum())} of {len(far)} scans have points that are far from their stamp and were left out, "
        f"the first at {first} ns.",
    )
    return selected(stream, np.flatnonzero(~far)), (note,)


# Parser of the point message of Livox: CustomMsg of livox_ros_driver, livox_ros_driver2 and livox_ros2_driver.
#
# Its definition, which ROS does not include:
#
# Header header; uint64 timebase; uint32 point_num; uint8 lidar_id; uint8[3] rsvd; CustomPoint[] points CustomPoint:
# uint32 offset_time [ns]; float32 x, y, z [m]; uint8 reflectivity, tag, line

LIVOX_TYPES = ("livox_ros_driver/msg/CustomMsg", "livox_ros_driver2/msg/CustomMsg", "livox_interfaces/msg/CustomMsg")
_POINT_FIELDS = {"offset_time": "u4", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "tag": "u1", "line": "u1"}
_POINT_BYTES = 19  # size of a point; in CDR padded to a multiple of 4


# Stamp [s, ns since 1970] and header of a message, with the field names of ROS.
Stamp, Header = namedtuple("Stamp", "sec nanosec"), namedtuple("Header", "stamp frame_id")


@dataclass(frozen=True)
class LivoxCloud:
    """A CustomMsg. points (N,): structured array with the fields of CustomPoint."""

    header: Header
    points: np.ndarray


def parse_ros1(content: bytes) -> LivoxCloud:
    """Parses a message in ROS 1 serialisation. Raises ValueError or struct.error if the bytes are no such message."""
    _, sec, nanosec, length = struct.unpack_from("<4I", content)
    at = 16 + length
    header = Header(Stamp(sec, nanosec), content[16:at].decode("utf-8", "replace"))
    return LivoxCloud(header, _points(content, at + 16, "<", _POINT_BYTES))


def parse_cdr(content: bytes) -> LivoxCloud:
    """Parses a message in CDR (ROS 2). Raises ValueError or struct.error if the bytes are no such message."""
    body = content[4:]  # alignment counts from here
    order = "<" if content[1:2] == b"\x01" else ">"
    sec, nanosec, length = struct.unpack_from(order + "iII", body)
    name = body[12 : 12 + length].rstrip(b"\0").decode("utf-8", "replace")
    timebase = -(-(12 + length) // 8) * 8
    return LivoxCloud(Header(Stamp(sec, nanosec), name), _points(body, timebase + 16, order, -(-_POINT_BYTES // 4) * 4))


def _points(content: bytes, at: int, order: str, step: int) -> np.ndarray:
    """Points (N,), structured. N is stored at byte `at`; the points follow, `step` bytes each. order: byte order."""
    (count,) = struct.unpack_from(order + "I", content, at)
    size = step * count - (step - _POINT_BYTES) * (count > 0)
    data = content[at + 4 : at + 4 + size]
    if len(data) < size:
        raise ValueError(f"{count} points do not fit {len(content)} bytes")
    offsets = np.cumsum([0, *(np.dtype(kind).itemsize for kind in _POINT_FIELDS.values())])[:-1].tolist()
    kinds = [order + kind for kind in _POINT_FIELDS.values()]
    dtype = np.dtype({"names": list(_POINT_FIELDS), "formats": kinds, "offsets": offsets, "itemsize": step})
    return np.frombuffer(data + bytes(step * count - size), dtype)
