"""Reads recorded values of wheels, unconverted, from tables, twists or joint states."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from icalib.data.images.image_checks import Note
from icalib.data.measurements import WheelPoses
from icalib.data.messages import TwistStream
from icalib.data.tables.columns import STAMP, TableKind
from icalib.data.tables.table import Table, read_table
from icalib.errors import RecordingError
from icalib.rig import WheelDrive, WheelMeasure, Wheels
from icalib.sensors.stream import RawReadings
from icalib.sensors.wheels.read.joints import JointStream
from icalib.sensors.wheels.spec import NO_SIDEWAYS

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
_MOST_SIDEWAYS, _ANY_VALUE = 0.2, 1e6  # share of the speed: slip stays below; m/s, rad/s: larger values are invalid
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
    rows = rows[(np.abs(rows) < _ANY_VALUE).all(axis=1)]
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
