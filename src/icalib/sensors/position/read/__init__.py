"""Reads tables, solutions of RTKLIB, logs of NMEA and messages into checked streams of positions.

Checks of fixes: stamps, units, motion, repeated fixes, outliers, steps.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from icalib.base.remark import Remark
from icalib.data.images import Note, ignore
from icalib.data.messages import TopicInfo
from icalib.data.recording import Reader, Reading, ReadStream, Recording
from icalib.data.stamps import kept_readings, true_runs
from icalib.data.tables import TableFile, named
from icalib.errors import RecordingError
from icalib.geometry.geodesy import east_north_up, latitude_longitude
from icalib.geometry.small import lagrange_weights
from icalib.sensors.position.read.fixes import (
    AS_RECORDED,
    FIX_RATES_HZ,
    FIX_TYPES,
    GEODETIC,
    NAVSAT,
    POINT,
    RECEIVER,
    SENTENCE,
    SUFFIX,
    LocalFrame,
    PositionReadings,
    Recorded,
    about_first,
    from_fixes,
    from_geodetic,
    good_fixes,
    is_nmea,
    left_out,
    read_nmea,
    read_pos,
    read_position_table,
)
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.position.stream import PositionStream
from icalib.sensors.sensor import TableLayout

# Kinds of topics. Where a bag has several, the first is used: a driver may publish the fixes of one receiver as all.
RECEIVER_KINDS = (RECEIVER, SENTENCE)
POSITION_KINDS = ((NAVSAT, POINT), *((kind,) for kind in RECEIVER_KINDS), ("pose", "odometry"))
METRIC_KINDS = (POINT, *POSITION_KINDS[-1])
MESSAGES = tuple(message for message, _ in FIX_TYPES.values())
Noted = tuple[PositionReadings, tuple[Remark, ...]]


def _stamps(path: Path, layout: TableLayout) -> np.ndarray:
    return _of_file(PositionSensor(path.parent.name, str(path), layout=layout), path, ignore)[0].stamps_ns


TABLES = (
    TableFile("positions.csv", "table of positions", "position", _stamps),
    TableFile("*[Gg][NnPp][Ss]*.csv", "table of positions", "position", _stamps, partial(named, kind=GEODETIC)),
    TableFile(f"*{SUFFIX}", "solution of RTKLIB", "position", _stamps),
    *(TableFile(name, "log of NMEA sentences", "position", _stamps, is_nmea) for name in ("*.nmea", "*.txt")),
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
                sentence = f"{what}: its positions were then converted to the frame of {sensor.shared_frame}."
                note = Remark("positions_converted", sentence)
                notes += (note,)
        stream, more = checked_positions(reading.cut(readings, what), what)
        streams.append((stream, notes + more))
    return streams


def source(recording: Recording, sensor: PositionSensor) -> Path | TopicInfo:
    """The table, which may be next to a bag, or the topic, of the first of `POSITION_KINDS` that the recording has."""
    if not recording.has_messages or (sensor.topic is None and recording.find(sensor.path) is not None):
        return recording.table(sensor, sensor.path)
    kinds = first_kinds(recording.topics()) if sensor.topic is None else sum(POSITION_KINDS, ())
    return recording.topic(sensor.name, sensor.topic, *kinds)


def first_kinds(topics: Iterable[TopicInfo]) -> tuple[str, ...]:
    """The first of `POSITION_KINDS` with messages; all of them if there are none."""
    recorded = {topic.kind for topic in topics if topic.count}
    return next((kinds for kinds in POSITION_KINDS if recorded & {*kinds}), sum(POSITION_KINDS, ()))


def _readings(recording: Recording, sensor: PositionSensor, what: str) -> Noted:
    """Readings in metres, and notes; what: names the source in messages."""
    path = source(recording, sensor)
    if isinstance(path, TopicInfo):
        return _of_topic(recording, sensor, path, what)
    written, coordinates = _of_file(sensor, path, recording.note)
    return _in_metres(recording.inside(written, path), coordinates, sensor, what)


def _of_file(sensor: PositionSensor, path: Path, note: Note) -> tuple[PositionReadings, Recorded]:
    """The readings in a file, and their coordinates."""
    if is_nmea(path):
        return from_fixes(sensor.name, read_nmea(path, note)), "geodetic"
    if path.name.removesuffix(".gz").endswith(SUFFIX):
        return read_pos(sensor.name, path)
    return read_position_table(sensor, path, note)


def _of_topic(recording: Recording, sensor: PositionSensor, topic: TopicInfo, what: str) -> Noted:
    message, fix_of = FIX_TYPES[topic.type]
    fixes = [(stamp_ns, fix) for stamp_ns, fix in recording.messages(topic.name, topic.kind, fix_of) if fix is not None]
    notes: tuple[Remark, ...] = ()
    if not message.stamped:
        timed = [(fix.utc_ns, fix) for _, fix in fixes if fix.utc_ns is not None]
        unknown = f"; {len(fixes) - len(timed)} fixes without it were left out" if len(timed) < len(fixes) else ""
        fixes, notes = (
            timed,
            (Remark("stamps_of_receiver", f"{what}: its stamps are the receiver's time (UTC){unknown}."),),
        )
    order = recording.by_stamp(topic.name, np.array([stamp_ns for stamp_ns, _ in fixes], np.int64))
    written = from_fixes(sensor.name, [fixes[k] for k in order.tolist()])
    readings, more = _in_metres(written, "local" if topic.kind in METRIC_KINDS else "geodetic", sensor, what)
    return readings, notes + more


def _in_metres(written: PositionReadings, coordinates: Recorded, sensor: PositionSensor, what: str) -> Noted:
    """The good readings in metres, and notes."""
    good = good_fixes(written.status, sensor.least_status, len(written.stamps_ns))
    if coordinates == "geodetic":
        readings, notes = from_geodetic(what, written, good)
    else:
        some = written.some(good)
        readings, notes = about_first(what, _levelled(some) if coordinates == "earth" and good.any() else some)
    return readings, left_out(what, written.status, good, sensor.least_status) + notes


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


def checked_positions(read: PositionReadings, what: str) -> tuple[PositionStream, tuple[Remark, ...]]:
    """The fixes with strictly increasing stamps, without outliers and repeated fixes, and notes on those removed.

    Raises RecordingError naming `what` and the instant where fixes are too few, not finite, not in order, without
    motion, or in other units.
    """
    if len(read.stamps_ns) < MIN_FIXES:
        raise RecordingError(
            f"{what}: only {len(read.stamps_ns)} fixes are usable; a calibration needs the whole recording."
        )
    finite = np.asarray(np.isfinite(read.position).all(axis=1))
    notes: tuple[Remark, ...] = ()
    if not finite.all():
        if finite.sum() < MIN_FIXES or finite.mean() < 0.5:
            raise RecordingError(
                f"{what}: {int((~finite).sum())} of {len(finite)} positions are not finite, the first at "
                f"{read.stamps_ns[np.argmin(finite)]} ns; correct the program that writes them."
            )
        sentence = f"{what}: {int((~finite).sum())} of {len(finite)} positions are not finite and were removed."
        note = Remark("positions_not_finite", sentence)
        notes += (note,)
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


def _without_frozen(read: PositionReadings, what: str) -> tuple[PositionReadings, tuple[Remark, ...]]:
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
    note = Remark(
        "receiver_frozen",
        f"{what}: {int(frozen.sum())} fixes repeat the one before exactly while the antenna moves, as if the receiver "
        f"was frozen, {seconds:.1f} s in all, the first at {read.stamps_ns[np.argmax(frozen)]} ns; they were removed.",
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


def _without_singles(read: PositionReadings, what: str) -> tuple[PositionReadings, tuple[Remark, ...]]:
    wrong = single_wrong(read.seconds, read.position)
    if not wrong.any():
        return read, ()
    note = Remark(
        "fix_outliers",
        f"{what}: {int(wrong.sum())} of {len(wrong)} fixes are outliers of the trajectory and were removed, the "
        f"first at {read.stamps_ns[np.argmax(wrong)]} ns.",
    )
    return read.some(~wrong), (note,)


def _jumps(read: PositionReadings, what: str) -> tuple[Remark, ...]:
    """A note on steps of the solution."""
    first, vectors = steps(read.seconds, read.position)
    if not len(first):
        return ()
    size = np.linalg.norm(vectors, axis=1)
    times = "once" if len(first) == 1 else f"{len(first)} times"
    return (
        Remark(
            "fixes_jump",
            f"{what}: its fixes jump {times}, by up to {size.max():.2g} m, the first at {read.stamps_ns[first[0]]} ns, "
            "as when a receiver gains or loses its carrier-phase solution. Fixes that do not fit the trajectory are "
            "rejected; leave worse fixes out with least_status, or cut the recording with --from and --to.",
        ),
    )


# Outliers among fixes before estimation: single fixes off the path of their neighbours, and lasting steps of the
# receiver's solution.

MEDIAN_WINDOW_FIXES = 51  # of the moving median of distances, as motion and noise change
MAX_MEDIAN_DISTANCES = 8.0  # an outlier is this many median distances off, some 10 standard deviations
MIN_OUTLIER_M = 0.05  # smaller errors are no outliers, even among fixes without noise
MAX_OUTLIER_SHARE = 0.1  # of all fixes: if more look like outliers, none of them is rejected
MAX_GAP_STEPS = 2.5  # median intervals: a longer one is a gap, over which the motion may change
# The cubic through two fixes on each side weighs a neighbour by 2/3. An outlier thus moves the distances of both its
# neighbours by 2/3 of its size. A step that lasts moves that of one of them by its whole size.
NEIGHBOUR_SHARES = 0.35, 0.9
# A step of the solution is larger than this, and than a motion with this acceleration makes within an interval.
MIN_STEP_M, MIN_STEP_M_S2 = 0.3, 10.0


def single_wrong(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(n,) bool: which fixes p (n, 3) m at t (n,) s are single outliers, by Hampel's identifier on their distances from
    a cubic through their neighbours (Davies and Gather, 1993)."""
    n = len(t)
    wrong = np.zeros(n, dtype=bool)
    if n < 9:
        return wrong
    far = _from_cubic(t, p)
    typical = np.maximum(median_filter(far, size=min(MEDIAN_WINDOW_FIXES, n), mode="nearest"), np.median(far))
    limit = np.maximum(MAX_MEDIAN_DISTANCES * typical, MIN_OUTLIER_M)
    beside = np.stack([np.roll(far, 1), np.roll(far, -1)]) / np.maximum(far, 1e-12)
    alone = (beside.min(axis=0) > NEIGHBOUR_SHARES[0]) & (beside.max(axis=0) < NEIGHBOUR_SHARES[1])
    wrong = (far > limit) & alone
    return wrong if wrong.mean() <= MAX_OUTLIER_SHARE else np.zeros(n, dtype=bool)


def _from_cubic(t: np.ndarray, p: np.ndarray) -> np.ndarray:
    """(n,) distances [m] from the cubic through two fixes on each side; 0 at the ends and beside gaps."""
    n = len(t)
    i = np.arange(2, n - 2)
    knots = np.stack([i - 2, i - 1, i + 1, i + 2])
    predicted = np.einsum("kn,kni->ni", lagrange_weights(t[knots] - t[i]), p[knots])
    out = np.zeros(n)
    even = t[i + 2] - t[i - 2] < 4.0 * MAX_GAP_STEPS * np.median(np.diff(t))
    out[i] = np.where(even, np.linalg.norm(p[i] - predicted, axis=1), 0.0)
    return out


def steps(t: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Steps of positions p (n, 3) m at t (n,) s that are not motion: numbers (m,) of the first fix after each, and the
    step vectors (m, 3) m."""
    dt, moved = np.diff(t), np.diff(p, axis=0)
    if len(dt) < 5:
        return np.zeros(0, dtype=np.int64), np.zeros((0, 3))
    beyond = moved - dt[:, None] * median_filter(moved / dt[:, None], size=(5, 1), mode="nearest")
    typical, size = float(np.median(dt)), np.linalg.norm(beyond, axis=1)
    limit = max(MIN_STEP_M, MIN_STEP_M_S2 * typical**2, MAX_MEDIAN_DISTANCES * float(np.median(size)))
    before = np.flatnonzero((size > limit) & (dt < MAX_GAP_STEPS * typical))
    return before + 1, beyond[before]


READER = Reader(MESSAGES, TABLES, read, source)
