"""Reads wheels, or velocities of a vehicle, from tables, joint states, odometry or twists into a checked stream."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from icalib.base.remark import Remark
from icalib.data.images import Note
from icalib.data.measurements import WheelStream
from icalib.data.messages import HasMessages, MessageType, TopicInfo, TwistStream, all_messages, read_twists
from icalib.data.recording import Reader, Reading, ReadStream, Recording
from icalib.data.stamps import kept_readings, longest_run, usual_step
from icalib.data.tables import STAMP, Table, TableFile, TableKind, holds, read_table
from icalib.errors import RecordingError
from icalib.rig import RATE_UNITS, WheelDrive, WheelMeasure
from icalib.sensors.sensor import TableLayout
from icalib.sensors.stream import RawReadings
from icalib.sensors.wheels.spec import NO_SIDEWAYS, Wheels
from icalib.sensors.wheels.stream import WheelPoses

# Reads recorded values of wheels, unconverted, from tables, twists or joint states.

RATE_HZ = (1e-2, 10_000.0)
STAMPS = TableKind(("t [ns]",), known=(STAMP,), rate_hz=RATE_HZ, more=True)
SIDES: dict[WheelDrive, tuple[str, ...]] = {
    "differential": ("left", "right"),
    "skid-steer": ("front left", "rear left", "front right", "rear right"),
    "ackermann": ("wheel", "steering"),
}
UNITS: dict[WheelMeasure, str] = {"rates": "rad/s", "angles": "rad", "ticks": "ticks"}
TWIST = ("v [m/s]", "w [rad/s]")
_LONGEST_STEP_S = 0.5  # longest time over which a yaw rate is integrated between two messages
_MOST_PARTIAL = 0.1  # share of messages that lack some joints of the wheels; more are systematic
_MOST_SIDEWAYS, _ANY_SPEED = 0.2, 1e6  # share of the speed: slip stays below; m/s, rad/s: larger values are invalid
_ALIGNED, _SCATTERED = 0.9, 0.7  # length of the mean of unit directions: 1 if all are the same
RELATIVE_POSES = TableKind(
    ("from [ns]", "to [ns]"), ("yaw [rad]", "x [m]", "y [m]", "yaw yaw", "yaw x", "yaw y", "x x", "x y", "y y")
)
# Header names (regular expressions) of the columns after the stamp.
_NAMES: dict[str, tuple[str, ...]] = {
    "left": (r"(.*_)?left(_.*)?|w?l",),
    "right": (r"(.*_)?right(_.*)?|w?r",),
    "front left": (r"(.*_)?(front_left|left_front)(_.*)?|fl",),
    "rear left": (r"(.*_)?((rear|back)_left|left_(rear|back))(_.*)?|rl|bl",),
    "front right": (r"(.*_)?(front_right|right_front)(_.*)?|fr",),
    "rear right": (r"(.*_)?((rear|back)_right|right_(rear|back))(_.*)?|rr|br",),
    "wheel": (r"(.*_)?(wheel|rear|drive|driven|motor)(_.*)?",),
    "steering": (r"(.*_)?(steering|steer)(_.*)?|delta",),
    "v [m/s]": (r"v|vx|v_x|speed|(forward_)?velocity|linear(_velocity)?_x",),
    "w [rad/s]": (r"w|wz|w_z|omega|yaw_?rate|angular(_velocity)?_z",),
}


@dataclass(frozen=True)
class WheelReadings(RawReadings):
    """Recorded values (N, m) in the recorded unit. Columns by drive: differential: left, right; skid-steer: front left,
    rear left, front right, rear right; ackermann: driven wheel and steering angle [rad], or left and right of both. For
    a twist: forward speed and yaw rate."""

    value: np.ndarray


def value_columns(wheels: Wheels) -> tuple[str, ...]:
    """Names with units of the columns of the table after the stamp."""
    if wheels.measures == "twist":
        return TWIST
    unit = UNITS[wheels.measures]
    return tuple(f"{side} [{'rad' if side == 'steering' else unit}]" for side in SIDES[wheels.drive])


def read_wheel_table(wheels: Wheels, path: Path, note: Note) -> WheelReadings | WheelPoses:
    """The readings in the table at `path`; `note` is called with a sentence on rows that were left out. Raises
    RecordingError naming file and line if it cannot be read, and the instant if relative poses are not consecutive."""
    if wheels.measures == "poses":
        table = read_table(path, RELATIVE_POSES, wheels.layout, note)
        return _relative_poses(wheels.name, path, table)
    columns = value_columns(wheels)
    known = (STAMP, *(_NAMES[c if wheels.measures == "twist" else c.split(" [")[0]] for c in columns))
    table = read_table(path, TableKind(("t [ns]",), columns, known, RATE_HZ), wheels.layout, note)
    return WheelReadings(wheels.name, table.integers[:, 0].copy(), table.decimals)


def _relative_poses(name: str, path: Path, table: Table) -> WheelPoses:
    begin, end = table.integers.T
    wrong = np.concatenate([[False], begin[1:] != end[:-1]]) | (end <= begin)
    if wrong.any():
        i = int(np.argmax(wrong))
        raise RecordingError(
            f"{path} ({name}): the pose from {begin[i]} to {end[i]} ns does not start where the previous one "
            "ends; write consecutive poses."
        )
    covariance = np.empty((len(begin), 3, 3))
    row, column = np.triu_indices(3)
    covariance[:, row, column] = covariance[:, column, row] = table.decimals[:, 3:]
    size = np.linalg.eigvalsh(covariance)
    if (size[:, 0] < -1e-9 * size[:, 2]).any() or (size[:, 2] <= 0).any():
        i = int(np.argmax((size[:, 0] < -1e-9 * size[:, 2]) | (size[:, 2] <= 0)))
        raise RecordingError(
            f"{path} ({name}): the covariance of the pose from {begin[i]} ns is not positive definite; correct "
            "the program that writes it."
        )
    return WheelPoses(name, np.append(begin, end[-1]), table.decimals[:, :3].copy(), covariance)


def read_wheel_twists(wheels: Wheels, twists: TwistStream, what: str) -> WheelReadings:
    """Forward speed [m/s] and yaw rate [rad/s] of the twists. Raises RecordingError naming the topic (`what`) if linear
    velocities are in the world frame."""
    if _in_the_world(twists):
        raise RecordingError(
            f"{what}: its linear velocity is in the world frame, not in the vehicle's. Use the poses of the "
            f"same program instead of {wheels.name} (type: pose, kind: relative), or publish linear.x along "
            "the vehicle."
        )
    if (share := _sideways(twists)) > _MOST_SIDEWAYS:
        raise RecordingError(f"{what}: linear.y is {share:.0%} of its speed, and {NO_SIDEWAYS}.")
    value = np.stack([twists.linear[:, 0], twists.angular[:, 2]], axis=1)
    return WheelReadings(wheels.name, twists.stamps_ns, value)


def _sideways(twists: TwistStream) -> float:
    """Share of the speed (RMS, at least 0.1 m/s) that is lateral and independent of forward speed and yaw rate, which
    show a turned or shifted frame."""
    rows = np.stack([twists.linear[:, 0], twists.angular[:, 2], twists.linear[:, 1]], axis=1)
    rows = rows[(np.abs(rows) < _ANY_SPEED).all(axis=1)]
    lateral = rows[:, 2] - rows[:, :2] @ np.linalg.lstsq(rows[:, :2], rows[:, 2], rcond=None)[0]
    speed = max(float((rows[:, ::2] ** 2).sum()), 0.01 * len(rows), 0.01)
    return float(np.sqrt(lateral @ lateral / speed))


def _in_the_world(twists: TwistStream) -> bool:
    """True if linear velocities keep their direction only after rotation by the integral of the negative yaw rate, so
    that they are in the world frame. Angles are doubled, so that forwards and backwards are the same direction."""
    across, rate = twists.linear[:, 0] + 1j * twists.linear[:, 1], twists.angular[:, 2]
    step = np.clip(np.diff(twists.stamps_ns) * 1e-9, 0.0, _LONGEST_STEP_S)
    good = np.isfinite(across) & np.isfinite(rate)
    rate, square = np.where(good, rate, 0.0), np.where(good, across, 0.0) ** 2
    turned = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)])
    total = np.abs(square).sum()
    if not total > 0.0:
        return False
    as_they_are, back = (abs((square * np.exp(-2j * a)).sum()) / total for a in (0.0 * turned, turned))
    return bool(back > _ALIGNED and as_they_are < _SCATTERED)


def read_wheel_joints(wheels: Wheels, joints: JointStream, what: str) -> WheelReadings:
    """Readings of the joints of the wheels. Raises RecordingError naming the topic (`what`): the wheels measure
    relative poses, joints are missing or sent separately, or they lack positions or velocities. A few messages with NaN
    are kept here and left out later with a note."""
    if wheels.measures == "poses":
        raise RecordingError(
            f"{what}: a bag holds no relative planar poses; set another `measures` of {wheels.name} in the rig file."
        )
    names = _joint_names(wheels, joints.names, what)
    column = [joints.names.index(name) for name in names]
    value = (joints.velocity if wheels.measures == "rates" else joints.position)[:, column]
    if wheels.drive == "ackermann":
        half = len(names) // 2
        value[:, half:] = joints.position[:, column[half:]]
    sent = ~np.isnan(value)
    ever = np.any(sent, axis=0).tolist()
    missing = [name for name, once in zip(names, ever, strict=True) if not once]
    if missing:
        steering = wheels.drive == "ackermann" and missing[0] in names[len(names) // 2 :]
        field, other = ("velocity", "angles") if wheels.measures == "rates" and not steering else ("position", "rates")
        advice = (
            "record the steering angle" if steering else f"set `measures` of {wheels.name} to {other} in the rig file"
        )
        have = "has" if len(missing) == 1 else "have"
        raise RecordingError(f"{what}: {' and '.join(missing)} {have} no {field}; {advice}.")
    _refuse_zeros(wheels, joints, names, what)
    some, all_ = sent.any(axis=1), sent.all(axis=1)
    if (some & ~all_).sum() > _MOST_PARTIAL * some.sum():
        raise RecordingError(
            f"{what}: the message at {joints.stamps_ns[np.argmax(some & ~all_)]} ns has only one of "
            f"{' and '.join(names)}; let the driver send {'both' if len(names) == 2 else 'all'} together."
        )
    return WheelReadings(wheels.name, joints.stamps_ns[some], value[some])


def _refuse_zeros(wheels: Wheels, joints: JointStream, names: tuple[str, ...], what: str) -> None:
    """Raises RecordingError if the quantity that is used of the joints `names`, velocity or position, is always 0 and
    the other one is not: a driver fills missing values with 0."""
    turning = names[: len(names) // 2] if wheels.drive == "ackermann" else names
    column = [joints.names.index(name) for name in turning]
    velocity, position = (np.nan_to_num(x[:, column]).any() for x in (joints.velocity, joints.position))
    zero, other, advice = ("velocity", "position", "angles") if position else ("position", "velocity", "rates")
    if velocity != position and (wheels.measures == "rates") == position:
        raise RecordingError(
            f"{what}: the {zero} of {' and '.join(turning)} is always 0, the {other} is not; set `measures` of "
            f"{wheels.name} to {advice} in the rig file."
        )


def _joint_names(wheels: Wheels, names: tuple[str, ...], what: str) -> tuple[str, ...]:
    """Names of the joints of the wheels, in the column order of `WheelReadings`. Raises RecordingError if they are not
    found or ambiguous."""
    if wheels.joints is not None:
        missing = [name for name in wheels.joints if name not in names]
        if missing:
            raise RecordingError(
                f"{what} has no joint {missing[0]}; it has {', '.join(names)}; correct `joints` of "
                f"{wheels.name} in the rig file."
            )
        return wheels.joints
    sides = SIDES[wheels.drive]
    matches = [[name for name in names if all(word in name.lower() for word in side.split())] for side in sides]
    if any(len(match) != 1 for match in matches):
        which = "the left and the right wheel" if wheels.drive == "differential" else f"the {', the '.join(sides)}"
        raise RecordingError(
            f"{what}: the names of the joints {', '.join(names)} do not tell which are {which}; set `joints: "
            f"[{', '.join(side.upper() for side in sides)}]` of {wheels.name} in the rig file."
        )
    return tuple(match[0] for match in matches)


MESSAGES = (
    MessageType("sensor_msgs/msg/JointState", "joints"),
    MessageType("nav_msgs/msg/Odometry", "odometry"),
    MessageType("geometry_msgs/msg/TwistStamped", "twist"),
)


def _stamps(path: Path, layout: TableLayout) -> np.ndarray:
    kind = RELATIVE_POSES if holds(path, RELATIVE_POSES) else STAMPS
    return read_table(path, kind).integers[:, 0].copy()


TABLES = tuple(TableFile(f"{m}.csv", f"table of {m}", "wheels", _stamps) for m in (*UNITS, "twist", "poses"))


def read(recording: Recording, sensors: Sequence[Wheels], reading: Reading) -> list[ReadStream]:
    """The checked stream of each set of wheels, with notes for the user. Raises RecordingError as `readings` and
    `checked_wheels`."""
    streams = []
    for sensor in sensors:
        where = recording.where(sensor)
        written = reading.cut(readings(recording, sensor), f"{where} ({sensor.name})")
        streams.append(checked_wheels(written, sensor, where))
    return streams


def readings(recording: Recording, sensor: Wheels) -> WheelReadings | WheelPoses:
    """All readings as recorded; stamps may still repeat or run backwards.

    Raises RecordingError naming file and line, or topic, where the data are missing or cannot be read.
    """
    topic, what = source(recording, sensor), f"{recording.where(sensor)} ({sensor.name})"
    if isinstance(topic, Path):
        return recording.inside(read_wheel_table(sensor, topic, recording.note), topic)
    if topic.kind in ("odometry", "twist"):
        read = read_wheel_twists(sensor, read_twists(recording, topic.name, topic.kind), what)
    else:
        read = read_wheel_joints(sensor, read_joints(recording, topic.name), what)
    order = recording.by_stamp(topic.name, read.stamps_ns)
    return WheelReadings(sensor.name, read.stamps_ns[order], read.value[order])


def source(recording: Recording, sensor: Wheels) -> Path | TopicInfo:
    """The table, or the topic of the readings: joint states, or twist or odometry if the wheels measure a twist."""
    if not recording.has_messages:
        return recording.table(sensor, sensor.path)
    kinds = ("twist", "odometry") if sensor.measures == "twist" else ("joints",)
    return recording.topic(sensor.name, sensor.topic, *kinds)


# Joint states of a robot as arrays.


@dataclass(frozen=True)
class JointStream:
    """Joint states: stamps_ns (N,) int64; position [rad or m], velocity, effort (N, joints), NaN where not sent;
    columns in the order of `names`."""

    names: tuple[str, ...]
    stamps_ns: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    effort: np.ndarray


def read_joints(bag: HasMessages, topic: str) -> JointStream:
    """All JointState messages of `topic`; a message may contain only some of the joints. Raises RecordingError as
    `BagRecording.messages`, and for an array whose length differs from that of the names."""
    stamps_ns, messages = all_messages(bag, topic, "joints")
    names = tuple(dict.fromkeys(name for m in messages for name in m.name))
    column = {name: k for k, name in enumerate(names)}
    values = np.full((3, len(messages), len(names)), np.nan)
    for row, m in enumerate(messages):
        columns = [column[name] for name in m.name]
        for quantity, array in enumerate((m.position, m.velocity, m.effort)):
            if len(array) not in (0, len(columns)):
                raise RecordingError(
                    f"{bag.root} {topic}: the message at {stamps_ns[row]} ns has {len(columns)} joints, but "
                    f"{len(array)} values; correct the driver."
                )
            if len(array):
                values[quantity, row, columns] = array
    return JointStream(names, stamps_ns, *values)


# Converts readings of wheels to checked rates of the wheels or of the vehicle.

_LEAST_HZ = 2.0  # readings at a lower rate do not resolve the motion
_FASTEST_RAD_S = 200.0  # a wheel of 0.1 m at 72 km/h; rates of slow robots in deg/s exceed it
_FASTEST_M_S, _FASTEST_YAW_RAD_S = 70.0, 15.0  # 250 km/h; a robot that spins in place twice a second
_STEEPEST_RAD = 1.4  # steering angle of front wheels
_ANY_VALUE = 1e18  # larger rates, angles and counts are invalid
_GAP_STEPS, _GAP_S = 5.0, 0.1  # a gap is longer than both: in median steps, in seconds
_STUCK_S = 5.0  # a constant reading for longer is reported if the other column moves
_TURNING_RAD_S, _DRIVING_M_S, _STEERING_RAD = 0.5, 0.1, 0.05  # larger values are no standstill, no straight drive


def checked_wheels(
    read: WheelReadings | WheelPoses, wheels: Wheels, where: str
) -> tuple[WheelStream | WheelPoses, tuple[Remark, ...]]:
    """The checked `WheelStream`, or the relative poses unchanged; and notes on what was left out or looks implausible.

    Angles and ticks become mean rates between their stamps, so that rate times period is the angle turned. The first
    rate, whose period is unknown, repeats the second. Raises RecordingError that names `where` and the instant: too few
    readings, mostly NaN, stamps out of order, different readings at one stamp, wrong units of time or rate.
    """
    if isinstance(read, WheelPoses):
        return read, ()
    what = f"{where} ({read.name})"
    if len(read.stamps_ns) < 3:
        raise RecordingError(f"{what}: only {len(read.stamps_ns)} readings; a calibration needs the whole recording.")
    read, broken = _finite(read, what)
    remedy = "write the encoders' own stamps"
    kept, notes = kept_readings(read.stamps_ns, read.value, what, RATE_HZ, "reading", remedy)
    if (rate_hz := 1e9 / usual_step(read.stamps_ns)) < _LEAST_HZ:
        raise RecordingError(
            f"{what}: the rate of {rate_hz:.2g} Hz is too low to follow the wheels, at least {_LEAST_HZ:g} Hz "
            "are needed; record at a higher rate."
        )
    read = _signed(_some(read, kept), wheels, what)
    read, apart_notes = (_even_rates if wheels.measures in ("rates", "twist") else _mean_rates)(read, wheels, what)
    rate = _combined(read.value, wheels)
    _refuse_units(rate, wheels, what)
    sampling = wheels.sampling if wheels.measures in ("rates", "twist") else "interval-mean"
    stream = WheelStream(read.name, read.stamps_ns, np.ascontiguousarray(rate), sampling, wheels.kind)
    notes = broken + notes + apart_notes
    return stream, notes + _gap_notes(stream, what) + _stuck_notes(stream, what)


def _some(read: WheelReadings, kept: np.ndarray) -> WheelReadings:
    return read if kept.all() else WheelReadings(read.name, read.stamps_ns[kept], read.value[kept])


def _finite(read: WheelReadings, what: str) -> tuple[WheelReadings, tuple[Remark, ...]]:
    """`read` without readings that are not finite, and a note. Raises RecordingError if most readings are not
    finite."""
    good = np.logical_and.reduce(np.abs(read.value) < _ANY_VALUE, axis=1)
    if good.all():
        return read, ()
    first, count = read.stamps_ns[np.argmin(good)], int((~good).sum())
    if 2 * count > len(good) or len(good) - count < 3:
        raise RecordingError(
            f"{what}: {count} of {len(good)} readings are not finite, the first at {first} ns; correct the "
            "program that writes them."
        )
    sentence = f"{what}: {count} of {len(good)} readings are not finite and were removed, the first at {first} ns."
    note = Remark("wheel_readings_not_finite", sentence)
    return _some(read, good), (note,)


def _signed(read: WheelReadings, wheels: Wheels, what: str) -> WheelReadings:
    """`read` with the signs of the rig file applied and rates in rad/s."""
    if wheels.signs is None and wheels.rate_unit == "rad/s":
        return read
    n, m = read.value.shape
    signs = np.ones(m) if wheels.signs is None else np.array(wheels.signs, dtype=float)
    if len(signs) != m:
        raise RecordingError(f"{what}: signs in the rig file has {len(signs)} entries for {m} columns; write {m}.")
    turning = np.arange(m) < _turning(read, wheels)
    return replace(read, value=read.value * signs * np.where(turning, RATE_UNITS[wheels.rate_unit], 1.0))


def _turning(read: WheelReadings, wheels: Wheels) -> int:
    """Number of leading columns that are wheels; the columns after them are steering angles."""
    return read.value.shape[1] // (2 if wheels.kind == "steered" else 1)


def _even_rates(read: WheelReadings, wheels: Wheels, what: str) -> tuple[WheelReadings, tuple[Remark, ...]]:
    """Rates or velocities without outliers, and a note."""
    off, outlier = apart(read.value, read.seconds)
    return _some(read, ~np.logical_or.reduce(outlier, axis=1)), _apart_note(read, off, outlier, what)


def _mean_rates(read: WheelReadings, wheels: Wheels, what: str) -> tuple[WheelReadings, tuple[Remark, ...]]:
    """Mean rates (N, m) [rad/s] between the stamps of angles or ticks, with steering angles unchanged; and notes.

    Outliers among the angles are removed first. Jumps after which the angle continues from the new value, as of a
    counter that was reset, are removed next.
    """
    size, notes = _range(read, wheels, what)
    off, outlier = apart(_steps(read, wheels, size), read.seconds[1:])
    dt = np.diff(read.seconds)[:, None]
    wrong = second_order(off * dt, outlier)
    if wrong.any():
        at = read.stamps_ns[np.argmax(wrong)]
        sentence = f"{what}: {int(wrong.sum())} single readings are outliers and were removed, the first at {at} ns."
        note = Remark("wheel_single_outliers", sentence)
        notes += (note,)
        read = _some(read, ~wrong)
        off, outlier = apart(_steps(read, wheels, size), read.seconds[1:])
    outlier = set_back(_steps(read, wheels, size), off, outlier)
    if wheels.measures == "ticks" and wheels.counter_size is None and outlier.any():
        _refuse_counter(read, wheels, off * np.diff(read.seconds)[:, None] * outlier, what)
    rate, stamps = _steps(read, wheels, size), read.stamps_ns
    n_turning = _turning(read, wheels)
    turned = WheelReadings(read.name, stamps[1:], np.concatenate([rate, read.value[1:, n_turning:]], axis=1))
    notes += _apart_note(turned, off, outlier, what)
    turned = _some(turned, ~np.logical_or.reduce(outlier, axis=1))
    first = np.concatenate([turned.value[0, :n_turning], read.value[0, n_turning:]])
    value = np.concatenate([first[None], turned.value])
    return WheelReadings(read.name, np.concatenate([stamps[:1], turned.stamps_ns]), value), notes


def _steps(read: WheelReadings, wheels: Wheels, size: float | None) -> np.ndarray:
    """Mean rates (N - 1, m) [rad/s] between the stamps; `size`: range after which angles or ticks wrap around, or
    None."""
    turned = np.diff(read.value[:, : _turning(read, wheels)], axis=0)
    if size is not None:
        turned = without_wraps(turned, size)
    if wheels.measures == "ticks":
        assert wheels.counts_per_turn is not None  # required by the rig file
        turned *= 2.0 * np.pi / wheels.counts_per_turn
    return turned / (np.diff(read.stamps_ns)[:, None] * 1e-9)


def _range(read: WheelReadings, wheels: Wheels, what: str) -> tuple[float | None, tuple[Remark, ...]]:
    """Range after which angles [rad] or ticks wrap around, from the rig file or recognised from angles, with a note on
    the latter; None if they do not wrap around."""
    if wheels.measures == "ticks" or wheels.angle_range is not None:
        return (wheels.counter_size if wheels.measures == "ticks" else wheels.angle_range), ()
    size = range_of(read.value[:, : _turning(read, wheels)])
    if size is None:
        return None, ()
    note = Remark(
        "wheel_angles_wrap",
        f"{what}: the angles wrap around after {size:.6f} rad and were unwrapped; angle_range of {read.name} "
        "in the rig file sets another range.",
    )
    return size, (note,)


def _refuse_counter(read: WheelReadings, wheels: Wheels, off: np.ndarray, what: str) -> None:
    """Raises RecordingError if jumps off (N - 1, m) [rad] are as long as the range of an encoder counter."""
    assert wheels.counts_per_turn is not None  # required by the rig file
    size = counter_of(off * wheels.counts_per_turn / (2.0 * np.pi))
    if size is not None:
        raise RecordingError(
            f"{what}: a wheel's count jumps by {size}, which looks like an encoder wrap-around; set "
            f"counter_size of {wheels.name} in the rig file ({size} for {size.bit_length() - 1} bits)."
        )


def _apart_note(read: WheelReadings, off: np.ndarray, outlier: np.ndarray, what: str) -> tuple[Remark, ...]:
    """A note on outliers: outlier (N, m) marks them, off (N, m) are the deviations from their neighbours."""
    count = int(outlier.any(axis=1).sum())
    if not count:
        return ()
    at, most = read.stamps_ns[np.argmax(outlier.any(axis=1))], np.abs(off[outlier]).max()
    return (
        Remark(
            "wheel_outliers",
            f"{what}: {count} of {len(outlier)} readings are outliers, off by up to {most:.3g}, and were removed, the "
            f"first at {at} ns.",
        ),
    )


def _combined(value: np.ndarray, wheels: Wheels) -> np.ndarray:
    """Four columns reduced to two (N, 2): the mean of each side, or the mean rear wheel and one equivalent front wheel.

    Ackermann geometry: the cotangent of the equivalent angle is the mean of the cotangents of both front wheels. It is
    computed from tangents, which are finite for driving straight ahead.
    """
    if value.shape[1] == 2:
        return value
    first, second = value[:, :2].mean(axis=1), value[:, 2:].mean(axis=1)
    if wheels.kind == "steered":
        left, right = np.tan(value[:, 2:].T)
        together = left + right
        second = np.arctan(2.0 * left * right / np.where(together == 0.0, 1.0, together))
    return np.stack([first, second], axis=1)


def _refuse_units(rate: np.ndarray, wheels: Wheels, what: str) -> None:
    if wheels.kind == "twist":
        return _refuse_twist_units(rate, what)
    if wheels.kind == "steered":
        steep = float(np.percentile(np.abs(rate[:, 1]), 99))
        if steep > _STEEPEST_RAD:
            raise RecordingError(
                f"{what}: the front wheels are steered by {steep:.4g} rad, which is implausible. Give the "
                "angle of the front wheels, not of the steering wheel, in rad (degrees times pi / 180)."
            )
    faster = np.abs(rate if wheels.kind == "pair" else rate[:, :1]).max(axis=1)
    fast = float(np.percentile(faster, 50 if wheels.measures == "ticks" else 99))
    if fast > _FASTEST_RAD_S:
        advice = {
            "rates": "unless the rates are in rad/s, set rate_unit of {} to deg/s or rpm",
            "angles": (
                "for degrees set measures of {} to ticks and counts_per_turn to 360, for encoder counts to "
                "those of a turn; for angles that wrap around set angle_range"
            ),
            "ticks": "correct counts_per_turn of {}",
        }[wheels.measures].format(wheels.name)
        raise RecordingError(
            f"{what}: the wheels turn at {fast:.4g} rad/s, which is implausible; {advice} in the rig file."
        )


def _refuse_twist_units(rate: np.ndarray, what: str) -> None:
    """Raises RecordingError for implausible speeds or yaw rates. The initial guess finds wrong units of slow
    vehicles."""
    speed, yaw = np.percentile(np.abs(rate), 99, axis=0)
    if speed > _FASTEST_M_S:
        raise RecordingError(
            f"{what}: the vehicle moves at {speed:.4g} m/s, which is implausible; multiply km/h by 1 / 3.6."
        )
    if yaw > _FASTEST_YAW_RAD_S:
        raise RecordingError(
            f"{what}: the vehicle turns at {yaw:.4g} rad/s, which is implausible; multiply deg/s by pi / 180."
        )


def _gap_notes(stream: WheelStream, what: str) -> tuple[Remark, ...]:
    step = np.diff(stream.stamps_ns) * 1e-9
    gap = step > max(_GAP_STEPS * float(np.median(step)), _GAP_S)
    if not gap.any():
        return ()
    i = int(np.argmax(step))
    return (
        Remark(
            "wheel_reading_gaps",
            f"{what}: {int(gap.sum())} gaps in the readings, the longest of {step[i]:.3g} s from "
            f"{stream.stamps_ns[i]} ns on; in a gap only the mean rate is known.",
        ),
    )


# For each column of a stream: its name, text on the other column, and the value above which the other one moves.
_COLUMNS = {
    "pair": (
        ("the left wheel", "the right one turns; check its encoder", _TURNING_RAD_S),
        ("the right wheel", "the left one turns; check its encoder", _TURNING_RAD_S),
    ),
    "steered": (
        ("the driven wheel", "the wheels are steered; check its encoder", _STEERING_RAD),
        ("the steering", "the vehicle drives; unless it went straight, check its sensor", _TURNING_RAD_S),
    ),
    "twist": (
        ("the speed", "the vehicle turns; check its publisher", _TURNING_RAD_S),
        ("the yaw rate", "the speed changes; unless it went straight, check its publisher", _DRIVING_M_S),
    ),
}
_UNITS = {"pair": ("rad/s", "rad/s"), "steered": ("rad/s", "rad"), "twist": ("m/s", "rad/s")}


def _stuck_notes(stream: WheelStream, what: str) -> tuple[Remark, ...]:
    """Notes on a column that stays constant for longer than _STUCK_S while the other one changes."""
    notes: list[Remark] = []
    for column, (name, but, moving) in enumerate(_COLUMNS[stream.kind]):
        other = 1 - column
        same = np.concatenate([[False], np.diff(stream.rate[:, column]) == 0])
        same &= np.abs(stream.rate[:, other]) > moving
        same &= np.concatenate([[False], np.diff(stream.rate[:, other]) != 0])
        second, count = longest_run(same)  # run of readings equal to the one before
        begin = max(second - 1, 0)
        duration = (stream.stamps_ns[begin + count] - stream.stamps_ns[begin]) * 1e-9
        if duration > _STUCK_S:
            unit = _UNITS[stream.kind][column]
            report = "reports" if "wheel" in name else "stays at"
            sentence = (
                f"{what}: {name} {report} {stream.rate[begin, column]:.4g} {unit} for {duration:.3g} s from "
                f"{stream.stamps_ns[begin]} ns on while {but}."
            )
            notes.append(Remark("wheel_reading_constant", sentence))
    return tuple(notes)


# Outliers in readings of wheels, and wrap-around of angles and encoder counters.

_HALF_WINDOW = 2  # readings on each side of the window of the median (Hampel identifier)
_MAX_DEVIATIONS = 10.0  # median deviations (about 7 standard deviations); noise stays below
_CHANGE_PERCENTILE = 95  # percentile of changes between readings; robust against one outlier in a hundred
_MAX_CHANGES = 4.0  # times the change at _CHANGE_PERCENTILE; brief true motions stay below
_MAX_QUANTA = 10.0  # quantisation steps of the rates; readings of a slow wheel that are a few ticks stay below
_MIN_RELATIVE_RATE = 1e-6  # of the 99th percentile of rates; smaller deviations are rounding errors
_MAX_ANY_RATE = 1e3  # rad/s or m/s, beyond any vehicle
_MAX_SPAN_S = 0.25  # between the neighbours of an outlier; true motion may change as much in a longer time
_MAX_OUTLIER_SHARE = 0.1  # if more readings deviate, none is taken for an outlier
_MAX_RATE_CHANGES = 2.0  # times the 95th percentile of rates: the change from forwards to backwards
_MAX_STEPS_BACK = 4  # steps within which the angle returns to its course after outliers
_MAX_REMAINDER = 0.2  # of a jump; larger sums of the steps until the return are no return
_SIZE_TOLERANCE = 0.01  # relative difference between a jump and the size of a counter
_MIN_BITS, _MAX_BITS = 8, 32  # of an encoder counter
_ANGLE_RANGES_RAD = (2.0 * np.pi, 4.0 * np.pi)  # after which joint angles wrap around
_MAX_UNAMBIGUOUS_STEP = 0.4  # of the range; a larger step may be a step in the other direction


def apart(rate: np.ndarray, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Deviations (N, m) of rates (N, m) at seconds (N,) from the median of their neighbours, and a mask (N, m) of those
    that are outliers."""
    padded = np.pad(rate, ((_HALF_WINDOW, _HALF_WINDOW), (0, 0)), mode="reflect")
    middle = np.median(np.stack([padded[k : k + len(rate)] for k in range(2 * _HALF_WINDOW + 1)]), axis=0)
    off = rate - middle
    brisk = np.percentile(np.abs(np.diff(rate, axis=0)), _CHANGE_PERCENTILE, axis=0)
    limit = np.maximum(_MAX_DEVIATIONS * np.median(np.abs(off), axis=0), _MAX_CHANGES * brisk)
    limit = np.maximum(limit, [_coarse(r, o) for r, o in zip(rate.T, off.T, strict=True)])
    # Readings at the ends have neighbours on one side only; a higher limit keeps a sudden start.
    ends = np.isin(np.arange(len(rate)), [0, 1, len(rate) - 2, len(rate) - 1])[:, None]
    outlier = np.abs(off) > np.where(ends, np.maximum(limit, _fastest(rate)), limit)
    span = np.diff(seconds, prepend=seconds[0])
    outlier &= (span + np.append(span[1:], 0.0) < _MAX_SPAN_S)[:, None]
    if outlier.any(axis=1).sum() > _MAX_OUTLIER_SHARE * len(rate):
        outlier[:] = False
    return off, outlier


def _coarse(rate: np.ndarray, off: np.ndarray) -> float:
    """Deviation that rates (n,) of a slow wheel reach by quantisation, as of single ticks; off (n,): their
    deviations."""
    fast = min(float(np.percentile(np.abs(rate), 99)), _MAX_ANY_RATE)
    size = np.abs(off)[np.abs(off) > _MIN_RELATIVE_RATE * fast]
    return min(_MAX_QUANTA * float(np.percentile(size, 10)), 2.0 * fast) if len(size) else 0.0


def set_back(rate: np.ndarray, off: np.ndarray, outlier: np.ndarray) -> np.ndarray:
    """Mask (N, m) of the outlying steps `outlier` of angles that no motion explains: the angle was reset. Shorter ones
    are true motion and are kept. rate, off (N, m): rate of each step, and its deviation from its neighbours."""
    return outlier & (np.abs(off) > _fastest(rate))


def _fastest(rate: np.ndarray) -> np.ndarray:
    """Largest change (m,) of rates (N, m) by true motion."""
    return _MAX_RATE_CHANGES * np.percentile(np.abs(rate), _CHANGE_PERCENTILE, axis=0)


def second_order(off: np.ndarray, outlier: np.ndarray) -> np.ndarray:
    """Mask (N + 1,) of angles that are outliers: a jump leads away from the course of the angle and another one back.

    off (N, m): deviations of the N steps between the angles from neighbouring steps; outlier (N, m): those that are
    large.
    """
    wrong = np.zeros(len(off) + 1, dtype=bool)
    for column in range(off.shape[1]):
        steps = np.flatnonzero(outlier[:, column])
        for i in steps.tolist():
            if wrong[i]:
                continue
            for j in range(i + 1, min(i + _MAX_STEPS_BACK, len(off))):
                if outlier[j, column] and abs(off[i : j + 1, column].sum()) < _MAX_REMAINDER * abs(off[i, column]):
                    wrong[i + 1 : j + 1] = True
                    break
    return wrong


def counter_of(off: np.ndarray) -> int | None:
    """Size of an encoder counter, a power of two, if a jump off (n,) [ticks] has that size (wrap-around); otherwise
    None."""
    size = np.abs(off[off != 0.0])
    bits = np.round(np.log2(size))
    fits = (np.abs(size / 2.0**bits - 1.0) < _SIZE_TOLERANCE) & (bits >= _MIN_BITS) & (bits <= _MAX_BITS)
    return int(2 ** int(bits[np.argmax(fits)])) if fits.any() else None


def range_of(angles: np.ndarray) -> float | None:
    """Range [rad] after which angles (N, m) wrap around; None if they do not, or if it is ambiguous.

    All angles must lie within the range, some steps must be longer than half of it, and unwrapped steps must be short.
    """
    step = np.diff(angles, axis=0)
    for size in _ANGLE_RANGES_RAD:
        wraps = (np.abs(step) > 0.5 * size).any(axis=0)
        if not wraps.any():
            continue
        low, high = np.percentile(angles[:, wraps], [0.5, 99.5], axis=0)
        rest = np.abs(without_wraps(step[:, wraps], size))
        if (high - low < 1.001 * size).all() and np.percentile(rest, 99) < _MAX_UNAMBIGUOUS_STEP * size:
            return size
    return None


def without_wraps(step: np.ndarray, size: float) -> np.ndarray:
    """Unwrapped steps of angles or counts that wrap around after `size`: the shorter of both directions."""
    return step - size * np.round(step / size)


READER = Reader(MESSAGES, TABLES, read, source)
