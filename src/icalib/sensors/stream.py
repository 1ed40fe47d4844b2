"""Base classes of streams: the measurements of one sensor as arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, Protocol, Self, TypeVar

import numpy as np

from icalib.errors import RecordingError

S = TypeVar("S", bound="Stream")
FAR_M = 100.0  # distance from the origin of a frame; further away its rotation and its origin are hard to separate


def check(condition: bool, sentence: str) -> None:
    """Raises RecordingError with `sentence` if the condition is false."""
    if not condition:
        raise RecordingError(sentence)


def check_groups(name: str, stamps_ns: np.ndarray, start: np.ndarray, what: str, counts: dict[str, int]) -> None:
    """Raises RecordingError unless start (N + 1,) increases from 0 to the length of every column. counts: length of
    each column, by name; what: plural noun for rows, in messages."""
    n = len(stamps_ns)
    check(start.shape == (n + 1,), f"{name}: start must have shape ({n + 1},), not {start.shape}.")
    rows = int(start[-1])
    check(int(start[0]) == 0 and bool((np.diff(start) >= 0).all()), f"{name}: start must run upwards from 0.")
    for column, count in counts.items():
        check(count == rows, f"{name}: {column} must have a row for each of the {rows} {what}, not {count}.")


def seconds_since(stamps_ns: np.ndarray, origin_ns: int) -> np.ndarray:
    """Stamps (N,) [ns] as float64 seconds since `origin_ns`; they are subtracted as integers, without rounding."""
    return (stamps_ns - np.int64(origin_ns)).astype(np.float64) * 1e-9


def which_image(file: str, stamp_ns: int) -> str:
    """Name of an image in messages: its file, or else its stamp."""
    return file or f"at {stamp_ns} ns"


def far_origin(positions: np.ndarray) -> np.ndarray | None:
    """New origin (3,) in whole metres, the median of positions (N, 3) [m], if it is further than FAR_M from the origin
    of their frame; else None. Whole numbers can be subtracted without rounding."""
    origin = np.round(np.median(positions, axis=0)) if len(positions) else np.zeros(3)
    return origin if np.linalg.norm(origin) > FAR_M else None


@dataclass(frozen=True)
class RawReadings:
    """Measurements of one sensor as recorded, unchecked. stamps_ns (N,) int64 may still repeat or run backwards.

    Subclasses add arrays with N rows; an array with 0 rows means that the recording does not contain it.
    """

    name: str
    stamps_ns: np.ndarray

    @property
    def seconds(self) -> np.ndarray:
        """(N,) seconds since the first stamp."""
        return seconds_since(self.stamps_ns, int(self.stamps_ns[0]))

    def some(self, kept: np.ndarray) -> Self:
        """The readings selected by the mask `kept` (N,)."""
        if kept.all():
            return self
        arrays = {k: v for k, v in vars(self).items() if isinstance(v, np.ndarray) and len(v) == len(kept)}
        return dataclasses.replace(self, **{name: values[kept] for name, values in arrays.items()})


@dataclass(frozen=True)
class Stream:
    """Checked measurements of one sensor. name: name of the sensor; stamps_ns (N,) int64 [ns] on the sensor's clock;
    joins_ns: if several recordings were joined, the first stamp of each except the first. pictures: a few images of the
    sensor by stamp, to show in a report, each the name of its file ("": none) and a JPEG of any size.

    Subclasses add arrays with N rows. Subclasses with `start` (N + 1,) have rows start[i]:start[i + 1] for stamp i. An
    array with 0 rows means that the sensor does not report it. Raises RecordingError for inconsistent shapes.
    """

    sensor_type: ClassVar[str]  # `Sensor.sensor_type` of the sensors with such streams
    name: str
    stamps_ns: np.ndarray
    joins_ns: tuple[int, ...] = field(default=(), kw_only=True)
    pictures: Mapping[int, tuple[str, bytes]] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        check(self.stamps_ns.dtype == np.int64, f"{self.name}: stamps must be int64 nanoseconds.")

    @property
    def key(self) -> str:
        """Key of the stream in `Measurements.streams`: the name of the sensor, unless a sensor has several streams."""
        return self.name

    @property
    def origin_ns(self) -> int:
        return int(self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        """(N,) seconds since the first stamp of the stream."""
        return seconds_since(self.stamps_ns, self.origin_ns)

    @property
    def rows(self) -> int:
        """Number of rows of the arrays other than stamps_ns and start."""
        start = getattr(self, "start", None)
        return len(self.stamps_ns) if start is None else int(start[-1])

    def columns(self) -> dict[str, np.ndarray]:
        """All arrays by name, except stamps_ns and start."""
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return {k: v for k, v in values.items() if isinstance(v, np.ndarray) and k not in ("stamps_ns", "start")}

    def better_origin(self) -> np.ndarray | None:
        """A new origin (3,) [m] for the frame of the positions, near them, if its own is far (`far_origin`), else None.
        Here None: overridden by streams whose frame is that of other sensors, too."""
        return None

    def relative_to(self, origin: np.ndarray) -> Self:
        """The stream with positions relative to `origin` (3,) [m] of its frame. Streams without positions are
        unchanged."""
        return self

    @classmethod
    def disjoint(cls, recordings: Sequence[Sequence[Self]]) -> Sequence[Sequence[Self]]:
        """The streams of this class in several recordings, renumbered so that no identifier occurs in two recordings.
        Here unchanged: subclasses with identifiers override it."""
        return recordings

    @classmethod
    def joined(cls, streams: Sequence[Self], shifts_ns: Sequence[int] | None = None) -> Self:
        """The concatenation of one sensor's streams in several recordings. shifts_ns: added to the stamps of each, by
        default 0. A column that is missing in one stream is dropped.

        Raises RecordingError if streams of this class cannot be joined.
        """
        if len({type(s) for s in streams}) > 1:
            raise RecordingError(f"{cls.__name__} {streams[0].name}: another recording has a stream of another class.")
        shifts = [0] * len(streams) if shifts_ns is None else shifts_ns
        stamps = [s.stamps_ns + np.int64(shift) for s, shift in zip(streams, shifts, strict=True)]
        changed: dict[str, Any] = {"joins_ns": tuple(int(stamps_ns[0]) for stamps_ns in stamps[1:])}
        if hasattr(streams[0], "start"):
            counts = np.concatenate([np.diff(getattr(s, "start")) for s in streams])  # noqa: B009
            changed["start"] = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        for name, first in streams[0].columns().items():
            values = [getattr(s, name) for s in streams]
            stated = all(len(column) == s.rows for column, s in zip(values, streams, strict=True))
            changed[name] = np.concatenate(values) if stated else first[:0]
        return dataclasses.replace(streams[0], stamps_ns=np.concatenate(stamps), **changed)


# Records of residuals that a result saves for each sensor and kind of residual. A kind of sensor may define further
# classes of records.

# Array name -> (allowed kinds of numpy dtypes, axis, axis, ...). An axis is a length or a name; equal names are equal
# lengths. "labels" is the number of labels, "edges" is "images" + 1.
Shapes = dict[str, tuple[str | int, ...]]


class Successive(NamedTuple):
    """Residuals in the order of time, for tests of their autocorrelation. whitened (n, d): one row per measurement.
    follows (n - 1,) bool: row k + 1 is the measurement of the same quantity that follows row k in time."""

    whitened: np.ndarray
    follows: np.ndarray


class Residuals(Protocol):
    """Interface of all records. A record is a frozen dataclass of arrays and of values that JSON can represent; tuples
    of text are written as lists."""

    shapes: ClassVar[Shapes]  # of every array

    @property
    def sensor(self) -> str: ...

    @property
    def kind(self) -> str:
        """Kind of residual: "corners", "points", ... A result has one record for each sensor and kind."""
        ...

    @property
    def seconds(self) -> np.ndarray:
        """Times (n,) on the clock of the result [s], since the first stamp of the body; see `RecordingSpan`."""
        ...

    def normalised(self) -> dict[str, np.ndarray]:
        """Residuals (n,) used in the estimate over their standard deviation, by name: standard normal if the noise
        model is right."""
        ...

    def successive(self) -> dict[str, Successive]:
        """Residuals used in the estimate over their standard deviation, and which of them are successive, by name."""
        ...


@dataclass(frozen=True)
class RowResiduals:
    """Residuals (predicted - measured) of n rows with m columns: increments of wheels, poses, positions."""

    shapes: ClassVar[Shapes] = {
        "seconds": ("f", "n"),
        "residual": ("f", "n", "labels"),
        "whitened": ("f", "n", "labels"),
    }

    sensor: str
    kind: str
    labels: tuple[str, ...]  # (m,) names of the columns: "left", "rotation x", ...
    units: tuple[str, ...]  # (m,) SI: "rad", "m", ...
    seconds: np.ndarray  # (n,) time of the measurement, or start of its interval
    residual: np.ndarray  # (n, m)
    whitened: np.ndarray  # (n, m)

    def normalised(self) -> dict[str, np.ndarray]:
        """Whitened residuals (n,) by label of the column."""
        return {label: self.whitened[:, k] for k, label in enumerate(self.labels)}

    def successive(self) -> dict[str, Successive]:
        """Whitened residuals by label of the column; each row follows the one before."""
        return successive_rows(self.labels, self.whitened)


def successive_rows(names: tuple[str, ...], whitened: np.ndarray) -> dict[str, Successive]:
    """Splits the columns of whitened (n, d) into one block of equal width per name; each row follows the one before."""
    blocks = np.split(whitened, len(names), axis=1)
    every = np.ones(max(len(whitened) - 1, 0), bool)
    return {name: Successive(block, every) for name, block in zip(names, blocks, strict=True)}
