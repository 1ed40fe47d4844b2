"""What all streams share: a stream is what one sensor measured, in arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from icalib.errors import RecordingError

S = TypeVar("S", bound="Stream")
FAR_M = 100.0  # from the origin of a frame; its rotation and its origin are hard to tell apart from further away


def check(condition: bool, sentence: str) -> None:
    """Raises RecordingError with `sentence` where the condition is false."""
    if not condition:
        raise RecordingError(sentence)


def check_groups(name: str, stamps_ns: np.ndarray, start: np.ndarray, what: str, counts: dict[str, int]) -> None:
    """Raises RecordingError unless start (N + 1,) runs from 0 upwards to the length of every column. counts: the
    length of each column, by name; what: the word for one row of them, in the plural."""
    n = len(stamps_ns)
    check(start.shape == (n + 1,), f"{name}: start must have shape ({n + 1},), not {start.shape}.")
    rows = int(start[-1])
    check(int(start[0]) == 0 and bool((np.diff(start) >= 0).all()), f"{name}: start must run upwards from 0.")
    for column, count in counts.items():
        check(count == rows, f"{name}: {column} must have a row for each of the {rows} {what}, not {count}.")


def seconds_since(stamps_ns: np.ndarray, origin_ns: int) -> np.ndarray:
    """Stamps as float64 seconds since `origin_ns`; the difference is taken in integers, so no digit is lost."""
    return (stamps_ns - np.int64(origin_ns)).astype(np.float64) * 1e-9


def which_image(file: str, stamp_ns: int) -> str:
    """Tells an image from others of its stream, in sentences: by its file, or else by its stamp."""
    return file or f"at {stamp_ns} ns"


def far_origin(positions: np.ndarray) -> np.ndarray | None:
    """(3,) whole metres among positions (N, 3) m, if these are far from the origin of their frame; None if they are
    not. Whole numbers subtract without loss of a digit."""
    origin = np.round(np.median(positions, axis=0)) if len(positions) else np.zeros(3)
    return origin if np.linalg.norm(origin) > FAR_M else None


@dataclass(frozen=True)
class RawReadings:
    """What one sensor measured, as it was written. stamps_ns (N,) int64, which may still repeat or run backwards.

    Subclasses add arrays of N rows; an array of 0 rows is one that is not stated.
    """

    name: str
    stamps_ns: np.ndarray

    @property
    def seconds(self) -> np.ndarray:
        """(N,) seconds since the first stamp."""
        return seconds_since(self.stamps_ns, int(self.stamps_ns[0]))

    def some(self, kept: np.ndarray) -> Self:
        """Those `kept` (N,), a mask."""
        if kept.all():
            return self
        arrays = {k: v for k, v in vars(self).items() if isinstance(v, np.ndarray) and len(v) == len(kept)}
        return dataclasses.replace(self, **{name: values[kept] for name, values in arrays.items()})


@dataclass(frozen=True)
class Stream:
    """What one sensor measured. name: of the sensor; stamps_ns (N,) int64, in nanoseconds of the sensor's own clock;
    joins_ns: where several recordings were joined, the first stamp of each but the first.

    Subclasses add arrays with N rows. Those with `start` (N + 1,) have rows start[i]:start[i + 1] for stamp i. An array
    of 0 rows is one that the sensor does not state. Raises RecordingError for shapes that do not fit.
    """

    sensor_type: ClassVar[str]  # that of the sensors that have such streams
    name: str
    stamps_ns: np.ndarray
    joins_ns: tuple[int, ...] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        check(self.stamps_ns.dtype == np.int64, f"{self.name}: stamps must be int64 nanoseconds.")

    @property
    def key(self) -> str:
        """Its name in `Measurements.streams`: that of the sensor, unless a sensor has several streams."""
        return self.name

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(N,) seconds since this clock's own first stamp."""
        return seconds_since(self.stamps_ns, self.origin_ns)

    @property
    def rows(self) -> int:
        """How many rows its arrays have, beside stamps_ns and start."""
        start = getattr(self, "start", None)
        return len(self.stamps_ns) if start is None else int(start[-1])

    def columns(self) -> dict[str, np.ndarray]:
        """All arrays by name, but for stamps_ns and start."""
        found = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {k: v for k, v in found.items() if isinstance(v, np.ndarray) and k not in ("stamps_ns", "start")}

    def near_origin(self) -> tuple[Self, tuple[str, ...]]:
        """The same with positions counted from among them where the origin of their frame is far, and notes on it."""
        return self, ()

    @classmethod
    def disjoint(cls, recordings: Sequence[Sequence[Self]]) -> Sequence[Sequence[Self]]:
        """The streams of this class of several recordings, such that a number in two of them is two things."""
        return recordings

    @classmethod
    def joined(cls, streams: Sequence[Self], shifts_ns: Sequence[int] | None = None) -> Self:
        """One sensor's streams of several recordings, one after the other. shifts_ns: what to add to the stamps of
        each, by default nothing. A column that one of them does not state is dropped.

        Raises RecordingError where streams of this class cannot be joined.
        """
        if len({type(s) for s in streams}) > 1:
            raise RecordingError(f"{cls.__name__} {streams[0].name}: another recording has a stream of another class.")
        shifts = [0] * len(streams) if shifts_ns is None else shifts_ns
        stamps = [s.stamps_ns + np.int64(shift) for s, shift in zip(streams, shifts, strict=True)]
        changed: dict[str, Any] = {"joins_ns": tuple(int(own[0]) for own in stamps[1:])}
        if hasattr(streams[0], "start"):
            counts = np.concatenate([np.diff(getattr(s, "start")) for s in streams])  # noqa: B009
            changed["start"] = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        for name, first in streams[0].columns().items():
            values = [getattr(s, name) for s in streams]
            stated = all(len(own) == s.rows for own, s in zip(values, streams, strict=True))
            changed[name] = np.concatenate(values) if stated else first[:0]
        return dataclasses.replace(streams[0], stamps_ns=np.concatenate(stamps), **changed)
