"""What one run leaves: its errors and what its covariance said of them, as JSON that reads back bit for bit."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from icalib.tools.batch import plain_record, record_json

FORMAT = 1
LEAST_SIGMA = 1e-100  # a number, however little


@dataclass(frozen=True)
class GroupErrors:
    """One group of one sensor: which entries of the record's error it has, in order, and how each was judged."""

    sensor: str
    name: str
    labels: tuple[str, ...]
    unit: str
    verdict: tuple[str, ...]

    @property
    def key(self) -> str:
        return f"{self.sensor}.{self.name}"


@dataclass(frozen=True)
class Size:
    """chi^2 of one kind of residual over the degrees of freedom that the fit left to it."""

    sensor: str
    kind: str
    count: int
    dof: float
    chi2: float


@dataclass(frozen=True)
class Whiteness:
    """Mean square of whitened residuals, and their correlation with the next one in time."""

    sensor: str
    kind: str
    mean_square: float
    lag1: float


@dataclass(frozen=True)
class Waypoint:
    """The solver's state when it looked for a step: error and formal standard deviation, entries as in `RunRecord`."""

    stage: str
    error: np.ndarray  # (n,)
    std: np.ndarray  # (n,)


@dataclass(frozen=True)
class RunRecord:
    """One run. failure: a sentence, or "" where the solver converged; a run that ended early has no blocks.

    error (n,): estimated minus true, block after block; of rotations e of R_estimated = R_true Exp(e) [rad].
    covariance (n, n): formal, of the same. path: the solver's, from the guess that the answer was found from.
    program: digest of the code that ran it.
    """

    seed: int
    failure: str
    seconds: float
    program: str
    blocks: tuple[GroupErrors, ...] = ()
    error: np.ndarray = field(default_factory=lambda: np.empty(0))
    covariance: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    undetermined: tuple[str, ...] = ()
    sizes: tuple[Size, ...] = ()
    whiteness: tuple[Whiteness, ...] = ()
    path: tuple[Waypoint, ...] = ()

    def errors(self) -> Iterator[tuple[GroupErrors, str, str, float]]:
        """Of every number that was estimated: its block, label and verdict, and its error in formal standard
        deviations, one without any taken for an enormity."""
        sigma = np.maximum(np.sqrt(np.diag(self.covariance)), LEAST_SIGMA)
        entries = ((b, label, v) for b in self.blocks for label, v in zip(b.labels, b.verdict, strict=True))
        for (block, label, verdict), z in zip(entries, (self.error / sigma).tolist(), strict=True):
            yield block, label, verdict, z

    def columns(self, key: str) -> np.ndarray:
        """(m,) entries of the block `key` ("cam0.rotation") in the error; none where the run has no such block."""
        start = 0
        for block in self.blocks:
            if block.key == key:
                return np.arange(start, start + len(block.labels))
            start += len(block.labels)
        return np.arange(0)


def to_json(record: RunRecord) -> bytes:
    """The record as JSON, numbers in full."""
    return record_json(record, FORMAT)


def from_json(text: bytes) -> RunRecord:
    """The record that `to_json` was given. Raises ValueError, KeyError or TypeError where `text` is something else."""
    plain = plain_record(text, FORMAT)
    plain["blocks"] = tuple(_block(b) for b in plain["blocks"])
    plain["sizes"] = tuple(Size(**s) for s in plain["sizes"])
    plain["whiteness"] = tuple(Whiteness(**w) for w in plain["whiteness"])
    plain["path"] = tuple(Waypoint(w["stage"], np.array(w["error"]), np.array(w["std"])) for w in plain["path"])
    plain["undetermined"] = tuple(plain["undetermined"])
    plain["error"] = np.array(plain["error"], dtype=np.float64)
    n = len(plain["error"])
    plain["covariance"] = np.array(plain["covariance"], dtype=np.float64).reshape(n, n)
    return RunRecord(**plain)


def _block(plain: dict[str, Any]) -> GroupErrors:
    return GroupErrors(plain["sensor"], plain["name"], tuple(plain["labels"]), plain["unit"], tuple(plain["verdict"]))
