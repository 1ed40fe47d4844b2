"""Converts readings of wheels to checked rates of the wheels or of the vehicle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.data.measurements import WheelPoses, WheelStream
from icalib.data.stamps.clocks import usual_step
from icalib.data.stamps.ordered import kept_readings, longest_run
from icalib.errors import RecordingError
from icalib.rig import RATE_UNITS, Wheels
from icalib.sensors.wheels.read.outliers import apart, counter_of, range_of, second_order, set_back, without_wraps
from icalib.sensors.wheels.read.raw_readings import RATE_HZ, WheelReadings

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
) -> tuple[WheelStream | WheelPoses, tuple[str, ...]]:
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


def _finite(read: WheelReadings, what: str) -> tuple[WheelReadings, tuple[str, ...]]:
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
    return _some(read, good), (
        f"{what}: {count} of {len(good)} readings are not finite and were removed, the first at {first} ns.",
    )


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


def _even_rates(read: WheelReadings, wheels: Wheels, what: str) -> tuple[WheelReadings, tuple[str, ...]]:
    """Rates or velocities without outliers, and a note."""
    off, outlier = apart(read.value, read.seconds)
    return _some(read, ~np.logical_or.reduce(outlier, axis=1)), _apart_note(read, off, outlier, what)


def _mean_rates(read: WheelReadings, wheels: Wheels, what: str) -> tuple[WheelReadings, tuple[str, ...]]:
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
        notes += (f"{what}: {int(wrong.sum())} single readings are outliers and were removed, the first at {at} ns.",)
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


def _range(read: WheelReadings, wheels: Wheels, what: str) -> tuple[float | None, tuple[str, ...]]:
    """Range after which angles [rad] or ticks wrap around, from the rig file or recognised from angles, with a note on
    the latter; None if they do not wrap around."""
    if wheels.measures == "ticks" or wheels.angle_range is not None:
        return (wheels.counter_size if wheels.measures == "ticks" else wheels.angle_range), ()
    size = range_of(read.value[:, : _turning(read, wheels)])
    if size is None:
        return None, ()
    return size, (
        f"{what}: the angles wrap around after {size:.6f} rad and were unwrapped; angle_range of {read.name} "
        "in the rig file sets another range.",
    )


def _refuse_counter(read: WheelReadings, wheels: Wheels, off: np.ndarray, what: str) -> None:
    """Raises RecordingError if jumps off (N - 1, m) [rad] are as long as the range of an encoder counter."""
    assert wheels.counts_per_turn is not None  # required by the rig file
    size = counter_of(off * wheels.counts_per_turn / (2.0 * np.pi))
    if size is not None:
        raise RecordingError(
            f"{what}: a wheel's count jumps by {size}, which looks like an encoder wrap-around; set "
            f"counter_size of {wheels.name} in the rig file ({size} for {size.bit_length() - 1} bits)."
        )


def _apart_note(read: WheelReadings, off: np.ndarray, outlier: np.ndarray, what: str) -> tuple[str, ...]:
    """A note on outliers: outlier (N, m) marks them, off (N, m) are the deviations from their neighbours."""
    count = int(outlier.any(axis=1).sum())
    if not count:
        return ()
    at, most = read.stamps_ns[np.argmax(outlier.any(axis=1))], np.abs(off[outlier]).max()
    return (
        f"{what}: {count} of {len(outlier)} readings are outliers, off by up to {most:.3g}, and were removed, the "
        f"first at {at} ns.",
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


def _gap_notes(stream: WheelStream, what: str) -> tuple[str, ...]:
    step = np.diff(stream.stamps_ns) * 1e-9
    gap = step > max(_GAP_STEPS * float(np.median(step)), _GAP_S)
    if not gap.any():
        return ()
    i = int(np.argmax(step))
    return (
        f"{what}: {int(gap.sum())} gaps in the readings, the longest of {step[i]:.3g} s from "
        f"{stream.stamps_ns[i]} ns on; in a gap only the mean rate is known.",
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


def _stuck_notes(stream: WheelStream, what: str) -> tuple[str, ...]:
    """Notes on a column that stays constant for longer than _STUCK_S while the other one changes."""
    notes: list[str] = []
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
            notes.append(
                f"{what}: {name} {report} {stream.rate[begin, column]:.4g} {unit} for {duration:.3g} s from "
                f"{stream.stamps_ns[begin]} ns on while {but}."
            )
    return tuple(notes)
