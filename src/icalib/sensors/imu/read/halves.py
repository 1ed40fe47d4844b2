"""An IMU whose gyroscope and accelerometer have separate stamps, on two topics or in two tables."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any, Protocol

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.data.stamps.ordered import kept_readings
from icalib.data.topics import TopicInfo, choose_topic
from icalib.errors import RecordingError
from icalib.rig import ImuSensor, TwoSources
from icalib.sensors.imu.read.table_kinds import CARRIED, RATE_HZ

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


def one_stream(imu: ImuStream | ImuHalves, what: str) -> tuple[ImuStream, tuple[str, ...]]:
    """The readings of both sensors in one stream, and notes if they had to be joined.

    Raises RecordingError if a separate sensor has too few finite readings, if its stamps are out of order, or if the
    two overlap too little in time.
    """
    return (imu, ()) if isinstance(imu, ImuStream) else _joined(imu, what)


def _joined(halves: ImuHalves, what: str) -> tuple[ImuStream, tuple[str, ...]]:
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
    note = (
        f"{what}: gyroscope and accelerometer have separate stamps; {len(known)} readings of the accelerometer "
        f"were interpolated to {len(at)} stamps of the gyroscope."
    )
    return ImuStream(halves.name, gyro_ns, gyro, accel), (*gyro_notes, *accel_notes, note)


def _checked_half(
    stamps_ns: np.ndarray, values: np.ndarray, kind: str, what: str
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Stamps [ns] and values of the finite readings of gyroscope or accelerometer (`kind`), without repetitions; and
    notes. Raises RecordingError for fewer than two readings, and as `kept_readings`."""
    finite = np.isfinite(values).all(axis=1)
    if finite.sum() < 2:
        raise RecordingError(f"{what}: the {kind} has only {len(stamps_ns)} readings; record it as long as the rest.")
    notes: tuple[str, ...] = ()
    if not finite.all():
        notes = (f"{what}, {kind}: {int((~finite).sum())} readings are not finite and were left out.",)
        stamps_ns, values = stamps_ns[finite], values[finite]
    remedy = "export the IMU's own stamps"
    kept, more = kept_readings(stamps_ns, values, f"{what}, {kind}", RATE_HZ, "reading", remedy)
    return stamps_ns[kept], values[kept], notes + more
