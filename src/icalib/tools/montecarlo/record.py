"""Record of one run: its errors and their covariance, and the JSON format that preserves every bit of them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from icalib.tools.batch import plain_record, record_json

FORMAT = 2
LEAST_SIGMA = 1e-100  # replaces a standard deviation of 0, so that an error over it is finite


@dataclass(frozen=True)
class GroupErrors:
    """One block: parameter group `name` of a sensor, such as cam0.rotation. labels, verdict: name and verdict of each
    entry; its entries in `RunRecord.error` follow those of the blocks before it. unit: of the entries, SI."""

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
    """Residual statistics of one kind of residual: number of residuals, post-fit degrees of freedom, chi^2."""

    sensor: str
    kind: str
    count: int
    dof: float
    chi2: float


@dataclass(frozen=True)
class Whiteness:
    """Mean square of whitened residuals of one kind, and their lag-one autocorrelation."""

    sensor: str
    kind: str
    mean_square: float
    lag1: float


@dataclass(frozen=True)
class Waypoint:
    """One iteration of the solver: error and formal standard deviation before the step, entries as in `RunRecord`."""

    stage: str
    error: np.ndarray  # (n,)
    std: np.ndarray  # (n,)


@dataclass(frozen=True)
class RunRecord:
    """One run. failure: the message, or "" if the solver converged; a run that ended early has no blocks. seconds: run
    time.

    error (n,): estimated minus true, block after block, SI units; for rotations e of R_estimated = R_true Exp(e) [rad].
    covariance (n, n): formal covariance of `error`. unobservable: sentences on unobservable combinations. path:
    iterations of the solver from the initial guess to the result. program: digest of the code that ran it.
    """

    seed: int
    failure: str
    seconds: float
    program: str
    blocks: tuple[GroupErrors, ...] = ()
    error: np.ndarray = field(default_factory=lambda: np.empty(0))
    covariance: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    unobservable: tuple[str, ...] = ()
    sizes: tuple[Size, ...] = ()
    whiteness: tuple[Whiteness, ...] = ()
    path: tuple[Waypoint, ...] = ()

    def errors(self) -> Iterator[tuple[GroupErrors, str, str, float]]:
        """Block, label and verdict of each entry of `error`, and its error in formal standard deviations. With a
        standard deviation of 0 an error counts as huge."""
        sigma = np.maximum(np.sqrt(np.diag(self.covariance)), LEAST_SIGMA)
        entries = ((b, label, v) for b in self.blocks for label, v in zip(b.labels, b.verdict, strict=True))
        for (block, label, verdict), z in zip(entries, (self.error / sigma).tolist(), strict=True):
            yield block, label, verdict, z

    def columns(self, key: str) -> np.ndarray:
        """(m,) indices in `error` of the block `key` ("cam0.rotation"); empty if the run has no such block."""
        start = 0
        for block in self.blocks:
            if block.key == key:
                return np.arange(start, start + len(block.labels))
            start += len(block.labels)
        return np.arange(0)


def to_json(record: RunRecord) -> bytes:
    """The record as JSON, with all digits."""
    return record_json(record, FORMAT)


def from_json(text: bytes) -> RunRecord:
    """The record that `to_json` wrote. Raises ValueError, KeyError or TypeError if `text` is not such a record."""
    plain = plain_record(text, FORMAT)
    plain["blocks"] = tuple(_block(b) for b in plain["blocks"])
    plain["sizes"] = tuple(Size(**s) for s in plain["sizes"])
    plain["whiteness"] = tuple(Whiteness(**w) for w in plain["whiteness"])
    plain["path"] = tuple(Waypoint(w["stage"], np.array(w["error"]), np.array(w["std"])) for w in plain["path"])
    plain["unobservable"] = tuple(plain["unobservable"])
    plain["error"] = np.array(plain["error"], dtype=np.float64)
    n = len(plain["error"])
    plain["covariance"] = np.array(plain["covariance"], dtype=np.float64).reshape(n, n)
    return RunRecord(**plain)


def _block(plain: dict[str, Any]) -> GroupErrors:
    return GroupErrors(plain["sensor"], plain["name"], tuple(plain["labels"]), plain["unit"], tuple(plain["verdict"]))
