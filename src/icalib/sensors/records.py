"""Records of residuals, which a result keeps by sensor and kind. Kinds of sensors may have records of their own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Protocol

import numpy as np

# By the name of an array: kinds of numpy's dtypes that it may have, then its axes. An axis is a length or a name; equal
# names are equal lengths. "labels" is the number of labels, "edges" is "images" + 1.
Shapes = dict[str, tuple[str | int, ...]]


class Successive(NamedTuple):
    """whitened (n, d): one row a measurement. follows (n - 1,) bool: row k + 1 is the next in time after row k, of the
    same measured thing."""

    whitened: np.ndarray
    follows: np.ndarray


class Residuals(Protocol):
    """What every record has. It is a frozen dataclass of arrays and of plain values that JSON holds; tuples of text
    are written as lists."""

    shapes: ClassVar[Shapes]  # of every array

    @property
    def sensor(self) -> str: ...

    @property
    def kind(self) -> str:
        """What was measured: "corners", "points", ... A result has one record of a sensor and kind."""
        ...

    @property
    def seconds(self) -> np.ndarray:
        """Times on the clock of the result, s since the first stamp of the body; see `RecordingSpan`."""
        ...

    def normalised(self) -> dict[str, np.ndarray]:
        """(n,) residuals in use over their standard deviation, by name: standard normal numbers if all is well."""
        ...

    def successive(self) -> dict[str, Successive]:
        """Residuals in use over their standard deviation and which of them follow each other in time, by name."""
        ...


@dataclass(frozen=True)
class RowResiduals:
    """Residuals (predicted - measured) of rows with m columns each: increments of wheels, poses, positions."""

    shapes: ClassVar[Shapes] = {
        "seconds": ("f", "n"),
        "residual": ("f", "n", "labels"),
        "whitened": ("f", "n", "labels"),
    }

    sensor: str
    kind: str
    labels: tuple[str, ...]  # (m,) of the columns: "left", "rotation x", ...
    units: tuple[str, ...]  # (m,) SI: "rad", "m", ...
    seconds: np.ndarray  # (n,) of the measurement, or start of the interval that it spans
    residual: np.ndarray  # (n, m)
    whitened: np.ndarray  # (n, m)

    def normalised(self) -> dict[str, np.ndarray]:
        """By column."""
        return {label: self.whitened[:, k] for k, label in enumerate(self.labels)}

    def successive(self) -> dict[str, Successive]:
        """By column; each row follows the one before."""
        return successive_rows(self.labels, self.whitened)


def successive_rows(names: tuple[str, ...], whitened: np.ndarray) -> dict[str, Successive]:
    """Each row of whitened (n, d) follows the one before; its columns in as many blocks as there are names."""
    blocks = np.split(whitened, len(names), axis=1)
    every = np.ones(max(len(whitened) - 1, 0), bool)
    return {name: Successive(block, every) for name, block in zip(names, blocks, strict=True)}
