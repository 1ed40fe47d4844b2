"""What the problem and the evidence ask of a sensor's factor, whatever it measures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from icalib.motion.imu_data import ImuData
from icalib.optim.arrowhead import Piece
from icalib.optim.state import State


@dataclass(frozen=True)
class Whitened:
    """Rows of a factor: residual (n, m), whitened, predicted - measured, and root (n, m), square root of the robust
    weight of each."""

    residual: np.ndarray
    root: np.ndarray

    @classmethod
    def empty(cls, n: int, m: int) -> Whitened:
        """Rows (n, m) to be filled."""
        return cls(np.zeros((n, m)), np.zeros((n, m)))


class SensorFactor(Protocol):
    """All measurements of one sensor. kinds: rows of its residuals by name; imu: the readings that carry it from nodes
    to its own instants, None where it was measured at nodes."""

    @property
    def kinds(self) -> dict[str, slice]: ...

    @property
    def name(self) -> str: ...

    @property
    def imu(self) -> ImuData | None: ...

    def with_imu(self, imu: ImuData) -> SensorFactor:
        """The same measurements, carried by other readings."""
        ...

    def output(self) -> Whitened:
        """Empty rows for `accumulate` to fill."""
        ...

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """Fills `out` for what lies in `piece`, and adds it to the piece's sums where `sums` are wanted. Returns half
        the robust chi^2.

        `curved`: J^T J has the true curvature of the robust loss, not its weights alone.
        """
        ...

    def count(self, out: Whitened, kind: str) -> int:
        """How many measurements of a kind are in use."""
        ...

    def rms(self, out: Whitened, kind: str) -> tuple[float, str]:
        """Of the residuals of a kind as they were before whitening, and their unit."""
        ...


def chi2(out: Whitened, rows: slice) -> float:
    """Of some columns of the rows, robust weights as they are."""
    return float(((out.residual[:, rows] * out.root[:, rows]) ** 2).sum())
