"""Records of residuals that a result saves for each sensor and kind of residual. A kind of sensor may define further
classes of records."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

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
