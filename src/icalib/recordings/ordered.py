"""Readings that are finite, in order of their stamps, and each there once."""

from __future__ import annotations

import numpy as np

from icalib.errors import RecordingError
from icalib.recordings.clocks import rate_sentence

_CUT_SHARE = 0.3  # of readings with the stamp of the one before: more are no single bad ones


def kept_readings(
    stamps_ns: np.ndarray, values: np.ndarray, what: str, rate_hz: tuple[float, float], thing: str, own: str
) -> tuple[np.ndarray, tuple[str, ...]]:
    """(N,) bool: which of the readings (N, m) to keep, each but those that repeat the one before, and a note on these.

    what, thing, own: the words for the file, for one reading and for the advice on its stamps. Raises RecordingError
    naming the instant: NaN, stamps out of order or repeated with other values, a rate outside of `rate_hz`.
    """
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise RecordingError(f"{what}: the {thing} at {stamps_ns[np.argmax(bad)]} ns is not finite; remove it.")
    back = np.diff(stamps_ns) < 0
    if back.any():
        i = int(np.argmax(back))
        raise RecordingError(
            f"{what}: the {thing} at {stamps_ns[i + 1]} ns comes after the one at {stamps_ns[i]} ns; sort the {thing}s "
            "by stamp, or record again if the clock was set back."
        )
    if sentence := rate_sentence(what, stamps_ns, *rate_hz):
        raise RecordingError(sentence)
    repeat = np.concatenate([[False], np.diff(stamps_ns) == 0])
    differs = repeat.copy()
    differs[1:] &= (np.diff(values, axis=0) != 0).any(axis=1)
    if differs.sum() > _CUT_SHARE * len(differs):
        raise RecordingError(
            f"{what}: {int(differs.sum())} of {len(differs)} {thing}s have the stamp of the one before, as where "
            f"stamps are cut to whole seconds or milliseconds; {own}, with all their digits."
        )
    if differs.any():
        raise RecordingError(
            f"{what}: two different {thing}s are both stamped {stamps_ns[np.argmax(differs)]} ns; {own}, or remove one."
        )
    if not repeat.any():
        return ~repeat, ()
    first = stamps_ns[np.argmax(repeat)]
    return ~repeat, (f"{what}: {int(repeat.sum())} repeated {thing}s were dropped, the first at {first} ns.",)


def longest_run(flag: np.ndarray) -> tuple[int, int]:
    """Where the longest run of True in `flag` (N,) begins, and its length; (0, 0) without one."""
    edge = np.diff(np.concatenate([[0], flag.astype(np.int8), [0]]))
    begin, end = np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)
    if not len(begin):
        return 0, 0
    longest = int(np.argmax(end - begin))
    return int(begin[longest]), int(end[longest] - begin[longest])
