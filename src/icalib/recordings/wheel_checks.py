"""From what wheels measured to the rates at which they turn, or the vehicle moves, checked."""

from __future__ import annotations

import numpy as np

from icalib.errors import RecordingError
from icalib.measurements import WheelPoses, WheelStream
from icalib.recordings.ordered import kept_readings, longest_run
from icalib.recordings.wheels import WheelReadings
from icalib.rig import Wheels

_RATE_HZ = (1.0, 10_000.0)
_FASTEST_RAD_S = 200.0  # a wheel of 0.1 m at 72 km/h; slow robots reach it in deg/s
_FASTEST_M_S, _FASTEST_YAW_RAD_S = 70.0, 15.0  # 250 km/h; a robot that spins in place twice a second
_STEEPEST_RAD = 1.4
_GAP_STEPS, _GAP_S = 5.0, 0.1  # a gap is longer than either
_STUCK_S = 5.0
_TURNING_RAD_S, _DRIVING_M_S, _STEERING_RAD = 0.5, 0.1, 0.05


def checked_wheels(
    read: WheelReadings | WheelPoses, wheels: Wheels, where: str
) -> tuple[WheelStream | WheelPoses, tuple[str, ...]]:
    """What a `WheelStream` of their kind has, or their relative poses as they are, and notes on what looks odd.

    Angles and ticks become the mean rates between their stamps, so that rate times period is what the wheel turned; the
    first, whose period is unknown, is that of the second. Raises RecordingError naming `where` and the instant: too few
    readings, NaN, stamps out of order or repeated with other values, other units of time or rate.
    """
    if isinstance(read, WheelPoses):
        return read, ()
    what = f"{where} ({read.name})"
    if len(read.stamps_ns) < 3:
        raise RecordingError(f"{what}: only {len(read.stamps_ns)} readings; a calibration needs the whole recording.")
    own = "write the encoders' own stamps"
    kept, notes = kept_readings(read.stamps_ns, read.value, what, _RATE_HZ, "reading", own)
    if notes:
        read = WheelReadings(read.name, read.stamps_ns[kept], read.value[kept])
    rate = _combined(read.value if wheels.measures in ("rates", "twist") else _mean_rates(read, wheels), wheels)
    _refuse_units(rate, wheels, what)
    meaning = wheels.meaning if wheels.measures in ("rates", "twist") else "mean"
    stream = WheelStream(read.name, read.stamps_ns, np.ascontiguousarray(rate), meaning, wheels.kind)
    return stream, notes + _gap_notes(stream, what) + _stuck_notes(stream, what)


def _mean_rates(read: WheelReadings, wheels: Wheels) -> np.ndarray:
    """(N, m) rad/s between the stamps, steering angles as they are. Ticks go on where their counter starts anew: the
    shorter way round."""
    n_turning = read.value.shape[1] // (2 if wheels.kind == "steered" else 1)
    turned = np.diff(read.value[:, :n_turning], axis=0)
    if wheels.measures == "ticks":
        assert wheels.counts_per_turn is not None  # of every rig file
        if wheels.counter_size is not None:
            turned -= wheels.counter_size * np.round(turned / wheels.counter_size)
        turned *= 2.0 * np.pi / wheels.counts_per_turn
    rate = turned / (np.diff(read.stamps_ns)[:, None] * 1e-9)
    return np.concatenate([np.concatenate([rate[:1], rate]), read.value[:, n_turning:]], axis=1)


def _combined(value: np.ndarray, wheels: Wheels) -> np.ndarray:
    """(N, 2) of four columns: means of each side, or of the rear wheels and of the front ones.

    Wheels that are steered about one point have cotangents of which the middle one is the mean; written with tangents,
    so that straight ahead is nothing special.
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
                f"{what}: the front wheels are steered by {steep:.4g} rad, further than any; degrees are to be "
                "multiplied by pi / 180, and the angle is that of the front wheels, not of the steering wheel."
            )
    faster = np.abs(rate if wheels.kind == "pair" else rate[:, :1]).max(axis=1)
    fast = float(np.percentile(faster, 50 if wheels.measures == "ticks" else 99))
    if fast > _FASTEST_RAD_S:
        advice = {
            "rates": "deg/s are to be multiplied by pi / 180, turns a minute by pi / 30",
            "angles": "degrees are to be multiplied by pi / 180, counts of an encoder are `measures: ticks`",
            "ticks": "correct counts_per_turn",
        }[wheels.measures]
        raise RecordingError(f"{what}: the wheels turn at {fast:.4g} rad/s, faster than any robot's; {advice}.")
    if wheels.measures == "ticks" and faster.max() > _FASTEST_RAD_S:
        raise RecordingError(
            f"{what}: a wheel turns at {faster.max():.4g} rad/s for an instant, as where a counter starts anew; set "
            f"counter_size of {wheels.name} in the rig file (65536 for 16 bits), or remove what is wrong."
        )


def _refuse_twist_units(rate: np.ndarray, what: str) -> None:
    """What no vehicle does; units that a slow one hides show in the scales of the first guess."""
    speed, yaw = np.percentile(np.abs(rate), 99, axis=0)
    if speed > _FASTEST_M_S:
        raise RecordingError(
            f"{what}: the vehicle moves at {speed:.4g} m/s, faster than any; km/h are to be multiplied by 1 / 3.6."
        )
    if yaw > _FASTEST_YAW_RAD_S:
        raise RecordingError(
            f"{what}: the vehicle turns at {yaw:.4g} rad/s, faster than any; deg/s are to be multiplied by pi / 180."
        )


def _gap_notes(stream: WheelStream, what: str) -> tuple[str, ...]:
    step = np.diff(stream.stamps_ns) * 1e-9
    gap = step > max(_GAP_STEPS * float(np.median(step)), _GAP_S)
    if not gap.any():
        return ()
    i = int(np.argmax(step))
    return (
        f"{what}: {int(gap.sum())} gaps in the readings, the longest of {step[i]:.3g} s from {stream.stamps_ns[i]} ns "
        "on; what the wheels did there is known only on average.",
    )


# What the columns of a stream are called, in which unit, and how much of the other one is not standing still.
_COLUMNS = {
    "pair": (("the left wheel", "the right one turns; check its encoder", _TURNING_RAD_S),
             ("the right wheel", "the left one turns; check its encoder", _TURNING_RAD_S)),
    "steered": (("the driven wheel", "the wheels are steered; check its encoder", _STEERING_RAD),
                ("the steering", "the vehicle drives; unless it went straight, check its sensor", _TURNING_RAD_S)),
    "twist": (("the speed", "the vehicle turns; check what publishes it", _TURNING_RAD_S),
              ("the yaw rate", "the speed changes; unless it went straight, check what publishes it",
               _DRIVING_M_S)),
}  # fmt: skip
_UNITS = {"pair": ("rad/s", "rad/s"), "steered": ("rad/s", "rad"), "twist": ("m/s", "rad/s")}


def _stuck_notes(stream: WheelStream, what: str) -> tuple[str, ...]:
    """Where one column reports the same for long while the other does not."""
    notes: list[str] = []
    for own, (name, but, moving) in enumerate(_COLUMNS[stream.kind]):
        other = 1 - own
        same = np.concatenate([[False], np.diff(stream.rate[:, own]) == 0])
        same &= np.abs(stream.rate[:, other]) > moving
        same &= np.concatenate([[False], np.diff(stream.rate[:, other]) != 0])
        second, count = longest_run(same)  # of readings that are the one before
        begin = max(second - 1, 0)
        duration = (stream.stamps_ns[begin + count] - stream.stamps_ns[begin]) * 1e-9
        if duration > _STUCK_S:
            unit = _UNITS[stream.kind][own]
            report = "reports" if "wheel" in name else "stays at"
            notes.append(
                f"{what}: {name} {report} {stream.rate[begin, own]:.4g} {unit} for {duration:.3g} s from "
                f"{stream.stamps_ns[begin]} ns on while {but}."
            )
    return tuple(notes)
