"""From what wheels measured to the rates at which they turn, checked."""

from __future__ import annotations

import numpy as np

from icalib.errors import RecordingError
from icalib.measurements import WheelPoses, WheelStream
from icalib.recordings.ordered import kept_readings, longest_run
from icalib.recordings.wheels import WheelReadings
from icalib.rig import Wheels

_RATE_HZ = (1.0, 10_000.0)
_FASTEST_RAD_S = 200.0  # a wheel of 0.1 m at 72 km/h; slow robots reach it in deg/s
_GAP_STEPS, _GAP_S = 5.0, 0.1  # a gap is longer than either
_STUCK_S = 5.0
_TURNING_RAD_S = 0.5


def checked_wheels(
    read: WheelReadings | WheelPoses, wheels: Wheels, where: str
) -> tuple[WheelStream | WheelPoses, tuple[str, ...]]:
    """The turning rates of both wheels, or their relative poses as they are, and notes on what looks odd.

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
    rate = read.value if wheels.measures == "rates" else _mean_rates(read, wheels)
    _refuse_units(rate, wheels, what)
    meaning = wheels.meaning if wheels.measures == "rates" else "mean"
    stream = WheelStream(read.name, read.stamps_ns, np.ascontiguousarray(rate), meaning)
    return stream, notes + _gap_notes(stream, what) + _stuck_notes(stream, what)


def _mean_rates(read: WheelReadings, wheels: Wheels) -> np.ndarray:
    """(N, 2) rad/s between the stamps. Ticks go on where their counter starts anew: the shorter way round."""
    turned = np.diff(read.value, axis=0)
    if wheels.measures == "ticks":
        assert wheels.counts_per_turn is not None  # of every rig file
        if wheels.counter_size is not None:
            turned -= wheels.counter_size * np.round(turned / wheels.counter_size)
        turned *= 2.0 * np.pi / wheels.counts_per_turn
    rate = turned / (np.diff(read.stamps_ns)[:, None] * 1e-9)
    return np.concatenate([rate[:1], rate])


def _refuse_units(rate: np.ndarray, wheels: Wheels, what: str) -> None:
    faster = np.abs(rate).max(axis=1)
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


def _stuck_notes(stream: WheelStream, what: str) -> tuple[str, ...]:
    """Where one wheel reports the same for long while the other turns."""
    notes: list[str] = []
    for side, other, name, other_name in ((0, 1, "left", "right"), (1, 0, "right", "left")):
        same = np.concatenate([[False], np.diff(stream.rate[:, side]) == 0])
        same &= np.abs(stream.rate[:, other]) > _TURNING_RAD_S
        same &= np.concatenate([[False], np.diff(stream.rate[:, other]) != 0])
        second, count = longest_run(same)  # of readings that are the one before
        begin = max(second - 1, 0)
        duration = (stream.stamps_ns[begin + count] - stream.stamps_ns[begin]) * 1e-9
        if duration > _STUCK_S:
            notes.append(
                f"{what}: the {name} wheel reports {stream.rate[begin, side]:.4g} rad/s for {duration:.3g} s from "
                f"{stream.stamps_ns[begin]} ns on while the {other_name} one turns; check its encoder."
            )
    return tuple(notes)
