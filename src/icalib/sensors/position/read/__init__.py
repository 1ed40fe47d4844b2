"""Reads tables, solutions of RTKLIB and messages into checked streams of positions.

Checks of fixes: stamps, units, motion, repeated fixes, outliers, steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from icalib.data.recordings.base import Reading, ReadStream, Recording
from icalib.data.stamps.ordered import kept_readings, true_runs
from icalib.data.tables.table import TableFile, named
from icalib.data.topics import MessageType, TopicInfo
from icalib.errors import RecordingError
from icalib.geometry.geodesy import east_north_up, latitude_longitude
from icalib.sensors.position.read.outliers import single_wrong, steps
from icalib.sensors.position.read.readings import (
    AS_RECORDED,
    FIX_RATES_HZ,
    GEODETIC,
    LocalFrame,
    PositionReadings,
    about_first,
    from_geodetic,
    from_navsat,
    from_positions,
    good_fixes,
    left_out,
    read_position_table,
)
from icalib.sensors.position.read.rtklib import SUFFIX, read_pos
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.position.stream import PositionStream
from icalib.sensors.sensor import TableLayout

NAVSAT, POINT = "navsat", "point"
POSITION_KINDS = (NAVSAT, POINT)  # kinds of topics with positions alone
POSE_KINDS = ("pose", "odometry")  # kinds of topics with poses
MESSAGES = (
    MessageType("sensor_msgs/msg/NavSatFix", NAVSAT),
    MessageType("geometry_msgs/msg/PointStamped", POINT),
)
Noted = tuple[PositionReadings, tuple[str, ...]]


def _stamps(path: Path, layout: TableLayout) -> np.ndarray:
    if _is_solution(path):
        return read_pos(path).stamps_ns
    return read_position_table(PositionSensor(path.parent.name, str(path), layout=layout), path)[0].stamps_ns


TABLES = (
    TableFile("positions.csv", "table of positions", "position", _stamps),
    TableFile("*[Gg][NnPp][Ss]*.csv", "table of positions", "position", _stamps, partial(named, kind=GEODETIC)),
    TableFile(f"*{SUFFIX}", "solution of RTKLIB", "position", _stamps),
)


def read(recording: Recording, sensors: Sequence[PositionSensor], reading: Reading) -> list[ReadStream]:
    """The checked streams, and notes. Raises RecordingError where data are missing, cannot be read or cannot be
    right."""
    places = {sensor.name: f"{recording.where(sensor)} ({sensor.name})" for sensor in sensors}
    written = {sensor.name: _readings(recording, sensor, places[sensor.name]) for sensor in sensors}
    streams = []
    for sensor in sensors:
        what, (readings, notes) = places[sensor.name], written[sensor.name]
        if sensor.shared_frame:
            owner = written.get(sensor.shared_frame)
            frame = AS_RECORDED if owner is None else owner[0].frame
            if readings.frame is not frame:
                readings = readings.inside(what, frame, sensor.shared_frame)
                notes += (f"{what}: its positions were then converted to the frame of {sensor.shared_frame}.",)
        stream, more = checked_positions(reading.cut(readings, what), what)
        streams.append((stream, notes + more))
    return streams


def where(recording: Recording, sensor: PositionSensor) -> str:
    """Path of the table, or place of the topic, with the sensor's positions, for messages."""
    if _is_table(recording, sensor):
        return str(recording.table(sensor, sensor.path))
    return recording.place(_topic(recording, sensor).name)


def _is_table(recording: Recording, sensor: PositionSensor) -> bool:
    return not recording.has_messages or (sensor.topic is None and recording.find(sensor.path) is not None)


def _is_solution(path: Path) -> bool:
    return path.name.removesuffix(".gz").endswith(SUFFIX)


def _topic(recording: Recording, sensor: PositionSensor) -> TopicInfo:
    """The topic of a sensor. Messages with positions alone go before poses and odometry."""
    has_positions = any(t.kind in POSITION_KINDS and t.count for t in recording.topics())
    kinds = POSITION_KINDS if has_positions and sensor.topic is None else (*POSITION_KINDS, *POSE_KINDS)
    return recording.topic(sensor.name, sensor.topic, *kinds)


def _readings(recording: Recording, sensor: PositionSensor, what: str) -> Noted:
    """Readings in metres, and notes; what: names the source in messages."""
    if not _is_table(recording, sensor):
        return _of_topic(recording, sensor, _topic(recording, sensor), what)
    path = recording.table(sensor, sensor.path)
    if _is_solution(path):
        return _of_solution(recording, sensor, path, what)
    written, geodetic = read_position_table(sensor, path, recording.note)
    written = recording.inside(written, path)
    if not geodetic:
        return about_first(what, written)
    return from_geodetic(what, written, written.position, np.ones(len(written.stamps_ns), dtype=bool))


def _of_topic(recording: Recording, sensor: PositionSensor, topic: TopicInfo, what: str) -> Noted:
    messages = list(recording.messages(topic.name, topic.kind))
    order = recording.by_stamp(topic.name, np.array([stamp for stamp, _ in messages], np.int64))
    messages = [messages[k] for k in order.tolist()]
    if topic.kind != NAVSAT:
        return about_first(what, from_positions(sensor.name, messages))
    written, degrees = from_navsat(sensor.name, messages)
    good = good_fixes(written.status, sensor.least_status, len(degrees))
    readings, notes = from_geodetic(what, written, degrees, good)
    return readings, left_out(what, written.status, good, sensor.least_status) + notes


def _of_solution(recording: Recording, sensor: PositionSensor, path: Path, what: str) -> Noted:
    file = read_pos(path)
    written = PositionReadings(sensor.name, file.stamps_ns, file.values, file.covariance, file.status)
    written = recording.inside(written, path)
    good = good_fixes(written.status, sensor.least_status, len(written.stamps_ns))
    notes = left_out(what, written.status, good, sensor.least_status)
    if file.kind == "geodetic":
        readings, more = from_geodetic(what, written, written.position, good)
        return readings, notes + more
    written = written.some(good)
    if file.kind == "earth" and len(written.stamps_ns):
        written = _levelled(written)
    readings, more = about_first(what, written)
    return readings, notes + more


def _levelled(written: PositionReadings) -> PositionReadings:
    """Earth-centred positions, converted to metres east, north and up of the first one."""
    R = east_north_up(*latitude_longitude(written.position[0]))
    covariance = R @ written.covariance @ R.T if len(written.covariance) else written.covariance
    frame = LocalFrame(written.position[0], R, True)
    return replace(written, position=(written.position - frame.origin) @ R.T, covariance=covariance, frame=frame)


MIN_FIXES = 3  # second differences need as many
_MAX_SPEED_M_S = 350.0  # of an airliner; more is another unit
_MIN_RANGE_M = 0.05  # largest distance from the median: fixes with 1 cm of noise stay within it at rest
_MIN_FROZEN_FIXES = 4  # equal fixes in a row: receivers round, and some stand still
# A receiver is frozen if the antenna would stop or start with more than this acceleration, half of gravity, and move
# by more than this distance at once when fixes change again.
_MAX_ACCELERATION_M_S2, _MIN_LEAP_M = 5.0, 0.3


def checked_positions(read: PositionReadings, what: str) -> tuple[PositionStream, tuple[str, ...]]:
    """The fixes with strictly increasing stamps, without outliers and repeated fixes, and notes on those removed.

    Raises RecordingError naming `what` and the instant where fixes are too few, not finite, not in order, without
    motion, or in other units.
    """
    if len(read.stamps_ns) < MIN_FIXES:
        raise RecordingError(
            f"{what}: only {len(read.stamps_ns)} fixes are usable; a calibration needs the whole recording."
        )
    finite = np.asarray(np.isfinite(read.position).all(axis=1))
    notes: tuple[str, ...] = ()
    if not finite.all():
        if finite.sum() < MIN_FIXES or finite.mean() < 0.5:
            raise RecordingError(
                f"{what}: {int((~finite).sum())} of {len(finite)} positions are not finite, the first at "
                f"{read.stamps_ns[np.argmin(finite)]} ns; correct the program that writes them."
            )
        notes += (f"{what}: {int((~finite).sum())} of {len(finite)} positions are not finite and were removed.",)
        read = read.some(finite)
    remedy = "write the receiver's own stamps"
    kept, repeated = kept_readings(read.stamps_ns, read.position, what, FIX_RATES_HZ, "fix", remedy)
    read = read.some(kept)
    if len(read.stamps_ns) < MIN_FIXES:
        raise RecordingError(
            f"{what}: only {len(read.stamps_ns)} fixes are usable; a calibration needs the whole recording."
        )
    _refuse_stillness(read, what)
    _refuse_units(read, what)
    read, frozen = _without_frozen(read, what)
    read, single = _without_singles(read, what)
    notes += repeated + frozen + single + _jumps(read, what)
    return PositionStream(read.name, read.stamps_ns, np.ascontiguousarray(read.position), read.covariance), notes


def _refuse_stillness(read: PositionReadings, what: str) -> None:
    far = float(np.linalg.norm(read.position - np.median(read.position, axis=0), axis=1).max())
    if far < _MIN_RANGE_M:
        raise RecordingError(
            f"{what}: all fixes are the same within {far:.2g} m; check that the receiver was running, or record again "
            "while moving."
        )


def _refuse_units(read: PositionReadings, what: str) -> None:
    speed = float(np.median(np.linalg.norm(np.diff(read.position, axis=0), axis=1) / np.diff(read.seconds)))
    if speed > _MAX_SPEED_M_S:
        raise RecordingError(
            f"{what}: it moves at {speed:.4g} m/s, which is implausible. Positions must be in metres (divide "
            "millimetres by 1000) or degrees, and stamps in nanoseconds."
        )


def _without_frozen(read: PositionReadings, what: str) -> tuple[PositionReadings, tuple[str, ...]]:
    """The fixes without runs that a frozen receiver repeats, and a note. Before or after such a run the acceleration is
    beyond that of a vehicle. The first fix of a run stays."""
    t, p = read.seconds, read.position
    same = np.concatenate([[False], (np.diff(p, axis=0) == 0.0).all(axis=1)])
    frozen = np.zeros(len(t), dtype=bool)
    for begin, end in true_runs(same):
        if end - begin + 1 >= _MIN_FROZEN_FIXES and (_stops_hard(t, p, begin - 1) or _leaps(t, p, end - 1)):
            frozen[begin:end] = True
    if not frozen.any():
        return read, ()
    seconds = float(np.diff(t, prepend=t[0])[frozen].sum())
    note = (
        f"{what}: {int(frozen.sum())} fixes repeat the one before exactly while the antenna moves, as if the receiver "
        f"was frozen, {seconds:.1f} s in all, the first at {read.stamps_ns[np.argmax(frozen)]} ns; they were removed."
    )
    return read.some(~frozen), (note,)


def _stops_hard(t: np.ndarray, p: np.ndarray, k: int) -> bool:
    """Whether stopping at fix k, from the speed before it, takes more than _MAX_ACCELERATION_M_S2."""
    if k < 1 or k + 1 >= len(t):
        return False
    speed = np.linalg.norm(p[k] - p[k - 1]) / (t[k] - t[k - 1])
    return bool(speed > _MAX_ACCELERATION_M_S2 * (t[k + 1] - t[k]))


def _leaps(t: np.ndarray, p: np.ndarray, k: int) -> bool:
    """Whether reaching the fix after k, from rest at k, takes more than _MAX_ACCELERATION_M_S2."""
    if k + 1 >= len(t):
        return False
    step, distance = t[k + 1] - t[k], float(np.linalg.norm(p[k + 1] - p[k]))
    return distance > max(_MIN_LEAP_M, 0.5 * _MAX_ACCELERATION_M_S2 * step**2)


def _without_singles(read: PositionReadings, what: str) -> tuple[PositionReadings, tuple[str, ...]]:
    wrong = single_wrong(read.seconds, read.position)
    if not wrong.any():
        return read, ()
    return read.some(~wrong), (
        f"{what}: {int(wrong.sum())} of {len(wrong)} fixes are outliers of the trajectory and were removed, the first "
        f"at {read.stamps_ns[np.argmax(wrong)]} ns.",
    )


def _jumps(read: PositionReadings, what: str) -> tuple[str, ...]:
    """A note on steps of the solution."""
    first, vectors = steps(read.seconds, read.position)
    if not len(first):
        return ()
    size = np.linalg.norm(vectors, axis=1)
    times = "once" if len(first) == 1 else f"{len(first)} times"
    return (
        f"{what}: its fixes jump {times}, by up to {size.max():.2g} m, the first at {read.stamps_ns[first[0]]} ns, as "
        "when a receiver gains or loses its carrier-phase solution. Fixes that do not fit the trajectory are rejected; "
        "leave worse fixes out with least_status, or cut the recording with --from and --to.",
    )
