"""Checks of readings: finite, ordered by stamp, without duplicates."""

from __future__ import annotations

import numpy as np

from icalib.data.stamps.clocks import rate_sentence
from icalib.errors import RecordingError

_CUT_SHARE = 0.3  # share of readings with a conflicting stamp above which stamps are reported as truncated
_MOST_DOUBTFUL, _LEAST_LEFT = 0.1, 3  # largest tolerated share of conflicts; least readings beside a single conflict


def kept_readings(
    stamps_ns: np.ndarray, values: np.ndarray, what: str, rate_hz: tuple[float, float], noun: str, remedy: str
) -> tuple[np.ndarray, tuple[str, ...]]:
    """(N,) bool: readings to keep, of stamps_ns (N,) and values (N, m); and notes on the rejected ones.

    Rejected are exact repetitions, and all readings that share a stamp but differ in value. what, noun, remedy: words
    for the file, one reading, and advice on stamps. rate_hz: slowest and fastest rate. Raises RecordingError with the
    instant for NaN, unordered stamps, many conflicting readings of one stamp, or a rate outside `rate_hz`.
    """
    plural = _plural(noun)
    bad = ~np.isfinite(values).all(axis=1)
    if bad.any():
        raise RecordingError(f"{what}: the {noun} at {stamps_ns[np.argmax(bad)]} ns is not finite; remove it.")
    back = np.diff(stamps_ns) < 0
    if back.any():
        i = int(np.argmax(back))
        raise RecordingError(
            f"{what}: the {noun} at {stamps_ns[i + 1]} ns comes after the one at {stamps_ns[i]} ns; sort the {plural} "
            "by stamp, or record again if the clock was set back."
        )
    if sentence := rate_sentence(what, stamps_ns, *rate_hz):
        raise RecordingError(sentence)
    differs, again = _one_stamp(stamps_ns, values)
    _refuse_many(differs, stamps_ns, what, noun, remedy)
    notes = ()
    if differs.any():
        notes += (
            f"{what}: {int(differs.sum())} {plural} share a stamp with a different {noun}. Which one is right "
            f"is unknown, so all of them were removed, the first at {stamps_ns[np.argmax(differs)]} ns.",
        )
    if again.any():
        first = stamps_ns[np.argmax(again)]
        notes += (f"{what}: {int(again.sum())} repeated {plural} were dropped, the first at {first} ns.",)
    return ~(differs | again), notes


def _one_stamp(stamps_ns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) bool each: readings that share a stamp with a reading of other values, and other readings that repeat the
    stamp before. Stamps are sorted."""
    same = np.diff(stamps_ns) == 0
    group = np.concatenate([[0], np.cumsum(~same)])
    unlike = same & (np.diff(values, axis=0) != 0).any(axis=1)
    differs = np.isin(group, group[1:][unlike])
    return differs, np.concatenate([[False], same]) & ~differs


def _refuse_many(differs: np.ndarray, stamps_ns: np.ndarray, what: str, noun: str, remedy: str) -> None:
    """Raises RecordingError if too many readings, `differs` (N,) bool, share a stamp with different ones."""
    share, n_stamps = differs.mean(), len(np.unique(stamps_ns[differs]))
    if n_stamps < 2 and (~differs).sum() >= _LEAST_LEFT:
        return
    sentence = f"{what}: {int(differs.sum())} of {len(differs)} {_plural(noun)} share a stamp with a different {noun}"
    if share > _CUT_SHARE and n_stamps > 1:
        raise RecordingError(
            f"{sentence}, as if stamps were truncated to whole seconds or milliseconds; {remedy}, with all digits."
        )
    if share > _MOST_DOUBTFUL:
        raise RecordingError(f"{sentence}, the first {stamps_ns[np.argmax(differs)]} ns; {remedy}.")


def _plural(noun: str) -> str:
    return f"{noun}es" if noun.endswith("x") else f"{noun}s"


def true_runs(flag: np.ndarray) -> list[tuple[int, int]]:
    """First index, and the one after the last, of each run of True in `flag` (N,) bool."""
    edge = np.diff(np.concatenate([[0], flag.astype(np.int8), [0]]))
    return list(zip(np.flatnonzero(edge == 1).tolist(), np.flatnonzero(edge == -1).tolist(), strict=True))


def longest_run(flag: np.ndarray) -> tuple[int, int]:
    """Begin and length of the longest run of True in `flag` (N,) bool; (0, 0) if there is none."""
    begin, end = max(true_runs(flag), key=lambda run: run[1] - run[0], default=(0, 0))
    return begin, end - begin
