"""Reads an IMU from tables or topics into a checked `ImuStream`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from icalib.base.remark import Remark
from icalib.data.messages import MessageType, TopicInfo, choose_topic
from icalib.data.recording import Cut, Reader, Reading, ReadStream, Recording
from icalib.data.stamps import ClockJumps, kept_readings, longest_run
from icalib.data.tables import STAMP, TableFile, TableKind, holds, in_axes, read_table, vector_names
from icalib.errors import RecordingError
from icalib.sensors.imu.read.cleaning import WINDOW_S, gravity_size, in_time, without_wrong
from icalib.sensors.imu.spec import ImuSensor, TwoSources
from icalib.sensors.imu.stream import ImuStream
from icalib.sensors.sensor import TableLayout

# An IMU whose gyroscope and accelerometer have separate stamps, on two topics or in two tables.

_LOOKED_AT = 50  # readings that tell which sensor a topic carries; a driver leaves the other at zero or NaN
_LEAST_COMMON_S = 1.0  # time in which both sensors ran


@dataclass(frozen=True)
class ImuHalf:
    """Readings of the gyroscope or of the accelerometer as recorded: stamps_ns (N,), values (N, 3)."""

    name: str
    stamps_ns: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class ImuHalves:
    """Readings of both sensors as recorded, unchecked: gyro (N, 3) at gyro_ns (N,), accel (M, 3) at accel_ns (M,)."""

    name: str
    gyro_ns: np.ndarray
    gyro: np.ndarray
    accel_ns: np.ndarray
    accel: np.ndarray


class HasImuMessages(Protocol):
    """A bag that yields the messages of a topic as (stamp [ns], message)."""

    def messages(self, topic: str, kind: str) -> Iterator[tuple[int, Any]]: ...


def values_of(message: Any) -> tuple[float, float, float, float, float, float]:
    """Angular rates x, y, z and specific forces x, y, z of a sensor_msgs/Imu message."""
    w, f = message.angular_velocity, message.linear_acceleration
    return w.x, w.y, w.z, f.x, f.y, f.z


def imu_source(where: str, bag: HasImuMessages, topics: Sequence[TopicInfo], sensor: ImuSensor) -> str | TwoSources:
    """The topic of the IMU, or its two topics if gyroscope and accelerometer are separate (`pair_of`). Raises
    RecordingError as `choose_topic`."""
    if isinstance(sensor.topic, TwoSources):
        gyro, accel = (choose_topic(where, topics, sensor.name, t, "imu").name for t in both(sensor.topic))
        return TwoSources(gyro, accel)
    pair = pair_of(bag, topics)
    if pair is not None and sensor.topic is None and sum(t.kind == "imu" and t.count > 0 for t in topics) == 2:
        return pair
    chosen = choose_topic(where, topics, sensor.name, sensor.topic, "imu").name
    return pair if pair is not None and chosen in both(pair) else chosen


def pair_of(bag: HasImuMessages, topics: Sequence[TopicInfo]) -> TwoSources | None:
    """The two topics or tables of an IMU if exactly one has only gyroscope readings and exactly one has only
    accelerometer readings; otherwise None."""
    imus = [t for t in topics if t.kind == "imu" and t.count]
    carried = {t.name: CARRIED.get(t.type) or _carried(bag, t.name) for t in imus} if len(imus) > 1 else {}
    gyros, accels = ([name for name, what in carried.items() if what == half] for half in ("gyro", "accel"))
    return TwoSources(gyros[0], accels[0]) if len(gyros) == len(accels) == 1 else None


def both(pair: TwoSources) -> tuple[str, str]:
    """The sources of gyroscope and accelerometer, in this order."""
    return pair.gyro, pair.accel


def _carried(bag: HasImuMessages, topic: str) -> str:
    """`gyro`, `accel` or `both`: the sensors whose readings on this topic are not all zero or NaN; `both` if all
    are."""
    rows = np.array([values_of(m) for _, m in islice(bag.messages(topic, "imu"), _LOOKED_AT)]).reshape(-1, 6)
    rates, forces = (bool((np.nan_to_num(x) != 0.0).any()) for x in (rows[:, :3], rows[:, 3:]))
    return "both" if rates == forces else "gyro" if rates else "accel"


def one_stream(imu: ImuStream | ImuHalves, what: str) -> tuple[ImuStream, tuple[Remark, ...]]:
    """The readings of both sensors in one stream, and notes if they had to be joined.

    Raises RecordingError if a separate sensor has too few finite readings, if its stamps are out of order, or if the
    two overlap too little in time.
    """
    return (imu, ()) if isinstance(imu, ImuStream) else _joined(imu, what)


def _joined(halves: ImuHalves, what: str) -> tuple[ImuStream, tuple[Remark, ...]]:
    """One stream at the gyroscope's stamps within the time common to both, with the accelerometer interpolated
    linearly; and notes. Raises RecordingError as `kept_readings`, and if the two overlap too little."""
    gyro_ns, gyro, gyro_notes = _checked_half(halves.gyro_ns, halves.gyro, "gyroscope", what)
    accel_ns, accel, accel_notes = _checked_half(halves.accel_ns, halves.accel, "accelerometer", what)
    common = (gyro_ns >= accel_ns[0]) & (gyro_ns <= accel_ns[-1])
    if not common.any() or np.ptp(gyro_ns[common]) < 1e9 * _LEAST_COMMON_S:
        raise RecordingError(
            f"{what}: gyroscope and accelerometer have less than {_LEAST_COMMON_S:g} s in common (from {gyro_ns[0]} to "
            f"{gyro_ns[-1]} ns, from {accel_ns[0]} to {accel_ns[-1]} ns); record both at the same time, by one clock."
        )
    gyro_ns, gyro = gyro_ns[common], gyro[common]
    at, known = ((x - accel_ns[0]).astype(np.float64) for x in (gyro_ns, accel_ns))
    accel = np.stack([np.interp(at, known, accel[:, k]) for k in range(3)], axis=1)
    note = Remark(
        "imu_stamps_separate",
        f"{what}: gyroscope and accelerometer have separate stamps; {len(known)} readings of the accelerometer "
        f"were interpolated to {len(at)} stamps of the gyroscope.",
    )
    return ImuStream(halves.name, gyro_ns, gyro, accel), (*gyro_notes, *accel_notes, note)


def _checked_half(
    stamps_ns: np.ndarray, values: np.ndarray, kind: str, what: str
) -> tuple[np.ndarray, np.ndarray, tuple[Remark, ...]]:
    """Stamps [ns] and values of the finite readings of gyroscope or accelerometer (`kind`), without repetitions; and
    notes. Raises RecordingError for fewer than two readings, and as `kept_readings`."""
    finite = np.isfinite(values).all(axis=1)
    if finite.sum() < 2:
        raise RecordingError(f"{what}: the {kind} has only {len(stamps_ns)} readings; record it as long as the rest.")
    notes: tuple[Remark, ...] = ()
    if not finite.all():
        sentence = f"{what}, {kind}: {int((~finite).sum())} readings are not finite and were left out."
        note = Remark("imu_parts_not_finite", sentence)
        notes = (note,)
        stamps_ns, values = stamps_ns[finite], values[finite]
    remedy = "export the IMU's own stamps"
    kept, more = kept_readings(stamps_ns, values, f"{what}, {kind}", RATE_HZ, "reading", remedy)
    return stamps_ns[kept], values[kept], notes + more


# Columns of the table of an IMU, or of separate tables of its two sensors, and the header names they go by.

RATE_HZ = (10.0, 20_000.0)
GYRO = r"w|omega|g|gyro|gyr|gyros|gyroscope|angular_(velocity|vel|rate)|ang_?vel|rotation_rate|w_rs_s"
ACCEL = r"a|acc|accel|acceleration|accelerometer|alpha|linear_(acceleration|accel|acc)|lin_acc|specific_force|f|a_rs_s"

IMU = TableKind(
    ("t [ns]",),
    ("wx [rad/s]", "wy [rad/s]", "wz [rad/s]", "ax [m/s^2]", "ay [m/s^2]", "az [m/s^2]"),
    (STAMP, *vector_names(GYRO), *vector_names(ACCEL)),
    RATE_HZ,
)
# Separate tables of gyroscope and accelerometer.
IMU_GYRO, IMU_ACCEL = (
    TableKind(
        IMU.integers,
        decimals,
        (STAMP, *((*names, axis) for names, axis in zip(known, "xyz", strict=True))),
        IMU.rate_hz,
    )
    for decimals, known in ((IMU.decimals[:3], IMU.known[1:4]), (IMU.decimals[3:], IMU.known[4:]))
)

# Types of tables, as of `TopicInfo`, and what each has.
WHOLE, GYRO_TABLE, ACCEL_TABLE = "table of readings", "table of angular rates", "table of accelerations"
CARRIED = {WHOLE: "both", GYRO_TABLE: "gyro", ACCEL_TABLE: "accel"}


def half_layouts(layout: TableLayout) -> tuple[TableLayout, TableLayout]:
    """Layouts of separate tables of gyroscope and accelerometer. Four `columns` hold for both; seven are in the order
    of a single table. A stamp in two columns makes one more."""
    columns, stamps = layout.columns, len(layout.columns) - 6
    if stamps < 1:
        return layout, layout
    accel = columns[:stamps] + columns[stamps + 3 :]
    return replace(layout, columns=columns[: stamps + 3]), replace(layout, columns=accel)


MESSAGES = (MessageType("sensor_msgs/msg/Imu", "imu"),)


def _stamps(kind: TableKind, half: int | None, path: Path, layout: TableLayout) -> np.ndarray:
    """(N,) int64 stamps [ns] of a table; half: 0 and 1, of the gyroscope and of the accelerometer alone."""
    return read_table(path, kind, layout if half is None else half_layouts(layout)[half]).integers[:, 0].copy()


TABLES = (
    TableFile("data.csv", WHOLE, "imu", partial(_stamps, IMU, None), partial(holds, kind=IMU), IMU),
    TableFile("*[Gg][Yy][Rr]*.csv", GYRO_TABLE, "imu", partial(_stamps, IMU_GYRO, 0), partial(holds, kind=IMU_GYRO)),
    TableFile("*[Aa][Cc][Cc]*.csv", ACCEL_TABLE, "imu", partial(_stamps, IMU_ACCEL, 1), partial(holds, kind=IMU_ACCEL)),
)


def read(recording: Recording, sensors: Sequence[ImuSensor], reading: Reading) -> list[ReadStream]:
    """The checked stream of each IMU, with notes for the user. Raises RecordingError as `read_imu`."""
    return [read_imu(recording, sensor, reading.cut) for sensor in sensors]


def read_imu(recording: Recording, sensor: ImuSensor, cut: Cut) -> tuple[ImuStream, tuple[Remark, ...]]:
    """Valid readings of one IMU in SI units within the time range that `cut` keeps, and notes for the user. Raises
    RecordingError as `readings`, `one_stream` and `checked_imu`."""
    where = recording.where(sensor)
    what = f"{where} ({sensor.name})"
    imu, joined = one_stream(readings(recording, sensor), what)
    imu, notes = checked_imu(cut(imu, what), where, sensor)
    return imu, joined + notes


def time_series(recording: Recording, sensor: ImuSensor) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Stamps (N,) int64 [ns] and readings (N, 3) as they are shown: gyro [deg/s] and accel [m/s^2]. Raises
    RecordingError as `read_imu`."""
    imu, _ = read_imu(recording, sensor, ClockJumps().cut)
    return imu.stamps_ns, {"gyro": np.rad2deg(imu.gyro), "accel": imu.accel}


def readings(recording: Recording, sensor: ImuSensor) -> ImuStream | ImuHalves:
    """All readings as recorded, in the recorded units; stamps may still repeat or run backwards. `ImuHalves` if
    gyroscope and accelerometer have separate topics or tables.

    Raises RecordingError naming file and line, or topic, where the data are missing or cannot be read.
    """
    return _from_messages(recording, sensor) if recording.has_messages else _from_tables(recording, sensor)


def _from_messages(recording: Recording, sensor: ImuSensor) -> ImuStream | ImuHalves:
    def rows(topic: str) -> tuple[np.ndarray, np.ndarray]:
        """Stamps (N,) [ns] and gyroscope and accelerometer readings (N, 6) of a topic, sorted by stamp."""
        stamped = [(stamp, values_of(message)) for stamp, message in recording.messages(topic, "imu")]
        stamps_ns = np.array([stamp for stamp, _ in stamped], np.int64)
        values = np.array([row for _, row in stamped], np.float64).reshape(-1, 6)
        order = recording.by_stamp(topic, stamps_ns)
        return stamps_ns[order], values[order]

    topic = imu_source(str(recording.root), recording, recording.topics(), sensor)
    if isinstance(topic, TwoSources):
        (gyro_ns, gyro), (accel_ns, accel) = rows(topic.gyro), rows(topic.accel)
        return ImuHalves(sensor.name, gyro_ns, gyro[:, :3].copy(), accel_ns, accel[:, 3:].copy())
    stamps_ns, values = rows(topic)
    return ImuStream(sensor.name, stamps_ns, values[:, :3].copy(), values[:, 3:].copy())


def _from_tables(recording: Recording, sensor: ImuSensor) -> ImuStream | ImuHalves:
    if isinstance(sensor.path, TwoSources):
        kinds, layouts, halves = (IMU_GYRO, IMU_ACCEL), half_layouts(sensor.layout), []
        for name, kind, layout in zip(both(sensor.path), kinds, layouts, strict=True):
            path = recording.table(sensor, name)
            table = read_table(path, kind, layout, recording.note)
            half = ImuHalf(sensor.name, table.integers[:, 0].copy(), table.decimals)
            halves.append(recording.inside(half, path))
        gyro, accel = halves
        return ImuHalves(sensor.name, gyro.stamps_ns, gyro.values, accel.stamps_ns, accel.values)
    path = recording.table(sensor, sensor.path)
    table = read_table(path, IMU, sensor.layout, recording.note)
    stamps_ns, values = table.integers[:, 0].copy(), table.decimals
    return recording.inside(ImuStream(sensor.name, stamps_ns, values[:, :3].copy(), values[:, 3:].copy()), path)


def source(recording: Recording, sensor: ImuSensor) -> str:
    """Topics or table files of the IMU, as text for messages."""
    if recording.has_messages:
        topic = imu_source(str(recording.root), recording, recording.topics(), sensor)
        return recording.place(" and ".join(both(topic)) if isinstance(topic, TwoSources) else topic)
    names = both(sensor.path) if isinstance(sensor.path, TwoSources) else (sensor.path,)
    return " and ".join(str(recording.table(sensor, name)) for name in names)


# Converts readings of an IMU to SI units and the IMU frame, as stated in the rig file or as gravity shows.

G_M_S2 = 9.80665
DEGREE = np.pi / 180.0
_FASTEST_RAD_S = 35.0  # 2000 deg/s, the widest range of common gyroscopes
_GRAVITY_M_S2 = (5.0, 20.0)  # plausible range of the median |accel|
_NEAR_ONE = (0.8, 1.25)  # range of gravity in units of g; scale errors of accelerometers are smaller
_STEADY = 0.75  # smallest ratio of lower to upper quartile over windows: gravity; about 0.5: linear acceleration
_MISSING = 0.5  # share of the median |accel|; a smaller gravity means that the readings contain none


def in_si(imu: ImuStream, sensor: ImuSensor) -> ImuStream:
    """The readings in SI units and the IMU frame, converted from the units and axes that the rig file states."""
    accel = G_M_S2 * imu.accel if sensor.accel_unit == "g" else imu.accel
    gyro = DEGREE * imu.gyro if sensor.gyro_unit == "deg/s" else imu.gyro
    return replace(imu, gyro=in_axes(gyro, sensor.gyro_axes), accel=in_axes(accel, sensor.accel_axes))


def recognised_unit(imu: ImuStream, what: str, sensor: ImuSensor | None) -> tuple[ImuStream, tuple[Remark, ...]]:
    """The readings with accelerations in m/s^2, and a note if gravity shows that they were in g.

    Raises RecordingError if the readings contain no gravity, or if the unit of acceleration or angular rate is wrong.
    """
    notes: tuple[Remark, ...] = ()
    median = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    if _is_in_g(imu, median):
        if sensor is not None and sensor.accel_unit is not None:
            raise RecordingError(
                f"{what}: with accel_unit: {sensor.accel_unit} the accelerometer measures gravity as "
                f"{median:.3g}, which looks like units of g; correct accel_unit in the rig file."
            )
        note = Remark(
            "accelerometer_in_g",
            f"{what}: the accelerometer is in units of g (its median is {median:.3g}); its readings were "
            f"multiplied by {G_M_S2} m/s^2.",
        )
        notes = (note,)
        imu = replace(imu, accel=G_M_S2 * imu.accel)
    elif _lacks_gravity(imu, median):
        raise RecordingError(
            f"{what}: the accelerometer readings contain no gravity (median |accel| {median:.3g} m/s^2; their "
            "mean, rotated by the gyroscope, is far below 9.81). The driver has removed it; record the raw "
            "accelerometer."
        )
    elif not _GRAVITY_M_S2[0] <= median <= _GRAVITY_M_S2[1]:
        raise RecordingError(
            f"{what}: the median |accel| is {median:.3g}, far from gravity, 9.81 m/s^2. The columns must be t "
            "[ns], gyroscope x, y, z [rad/s], accelerometer x, y, z [m/s^2] with gravity. Set accel_unit: g "
            "in the rig file for units of g."
        )
    _refuse_degrees(imu, what)
    return imu, notes


def _is_in_g(imu: ImuStream, median: float) -> bool:
    """True if gravity is about 1 in most windows. median: median |accel|. Linear acceleration alone is less steady."""
    if not _NEAR_ONE[0] <= median <= 1.5 * _NEAR_ONE[1]:
        return False
    sizes = [np.linalg.norm(imu.accel, axis=1)] if imu.seconds[-1] < WINDOW_S else _gravity(imu)
    quartiles = (np.quantile(size, [0.25, 0.75]) for size in sizes)
    return any(_NEAR_ONE[0] <= low and high <= _NEAR_ONE[1] for low, high in quartiles)


def _lacks_gravity(imu: ImuStream, median: float) -> bool:
    """True if the readings are near zero, or their mean over windows is far below their size or varies between windows.

    This must be so for every unit of the rates; median: median |accel|.
    """
    if median >= _GRAVITY_M_S2[0] or imu.seconds[-1] < WINDOW_S:
        return False
    quartiles = (np.quantile(size, [0.25, 0.5, 0.75]) for size in _gravity(imu))
    steady = any(low > _STEADY * high and middle > _MISSING * median for low, middle, high in quartiles)
    return median < _MISSING * _NEAR_ONE[0] or not steady


def _gravity(imu: ImuStream) -> list[np.ndarray]:
    """`gravity_size` for rates in rad/s, for rates in deg/s and without rates; empty if the recording is too short."""
    return [size for unit in (1.0, DEGREE, 0.0) if (size := gravity_size(imu, unit)) is not None]


def _refuse_degrees(imu: ImuStream, what: str) -> None:
    fast = float(np.percentile(np.linalg.norm(imu.gyro, axis=1), 99))
    if fast > _FASTEST_RAD_S:
        raise RecordingError(
            f"{what}: the angular rate reaches {fast:.3g}, which is implausible in rad/s and looks like deg/s; "
            "set gyro_unit: deg/s in the rig file."
        )


# Checks that an IMU's stream is plausible in rad/s, m/s^2 and ns, and removes wrong readings.

_SATURATED_RUN = 5  # equal readings in a row at the extreme of an axis
# [rad/s], [m/s^2]. No sensor's range is narrower (125 deg/s, 2 g); equal readings below it are coarse quantisation.
_NARROWEST_RANGE = {"gyroscope": 2.0, "accelerometer": 17.0}


@dataclass(frozen=True)
class Saturation:
    """Run of `count` readings equal to `limit` [rad/s or m/s^2] from stamp_ns on; kind: gyroscope or accelerometer."""

    kind: str
    axis: str  # x, y or z
    limit: float
    count: int
    stamp_ns: int


def checked_imu(imu: ImuStream, where: str, sensor: ImuSensor | None = None) -> tuple[ImuStream, tuple[Remark, ...]]:
    """`imu` with strictly increasing stamps in SI units; notes on dropped, converted and possibly saturated readings.
    `sensor` has the units and axes of the readings as stated in the rig file; None: they are recognised.

    Outliers and copies of readings are dropped. Jittering stamps of evenly sampled readings are replaced by even ones.

    Raises RecordingError that names `where` (the file) and the instant: too few readings, stamps out of order,
    different readings at one stamp, a frozen sensor, or wrong units of time, angular rate or acceleration.
    """
    what = f"{where} ({imu.name})"
    if len(imu.stamps_ns) < 2:
        raise RecordingError(f"{what}: only {len(imu.stamps_ns)} reading; a calibration needs the whole recording.")
    imu, timed = in_time(imu, what)
    if len(imu.stamps_ns) < 2:
        raise RecordingError(f"{what}: no two readings are finite; check the driver, and record again.")
    values, remedy = np.hstack([imu.gyro, imu.accel]), "export the IMU's own stamps"
    kept, notes = kept_readings(imu.stamps_ns, values, what, RATE_HZ, "reading", remedy)
    if notes:
        imu = ImuStream(imu.name, imu.stamps_ns[kept], imu.gyro[kept], imu.accel[kept])
    _refuse_frozen(imu, what)
    imu, rejected = without_wrong(imu, what)
    imu, converted = recognised_unit(imu if sensor is None else in_si(imu, sensor), what, sensor)
    return imu, timed + notes + rejected + converted + _saturation_notes(imu, what)


def _refuse_frozen(imu: ImuStream, what: str) -> None:
    for kind, values in (("gyroscope", imu.gyro), ("accelerometer", imu.accel)):
        if (values == values[0]).all():
            raise RecordingError(f"{what}: the {kind} gives the same reading from start to end; check its driver.")


def _saturation_notes(imu: ImuStream, what: str) -> tuple[Remark, ...]:
    return tuple(
        Remark(
            "imu_saturated",
            f"{what}: the {s.kind} {s.axis} looks saturated, {s.count} readings in a row at {s.limit:.4g} from "
            f"{s.stamp_ns} ns on; move more slowly, or set a wider range.",
        )
        for s in saturations(imu)
    )


def saturations(imu: ImuStream) -> tuple[Saturation, ...]:
    """The longest run of readings at the largest and at the smallest value of each axis, if it looks saturated."""
    runs: list[Saturation] = []
    for kind, values in (("gyroscope", imu.gyro), ("accelerometer", imu.accel)):
        for axis, name in enumerate("xyz"):
            for limit in (values[:, axis].max(), values[:, axis].min()):
                at, count = longest_run(values[:, axis] == limit)
                if abs(limit) >= _NARROWEST_RANGE[kind] and count >= _SATURATED_RUN:
                    runs.append(Saturation(kind, name, float(limit), count, int(imu.stamps_ns[at])))
    return tuple(runs)


READER = Reader(MESSAGES, TABLES, read, source)
