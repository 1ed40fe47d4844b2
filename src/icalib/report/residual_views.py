"""What the 3D view shows of residuals: curves over time, and points in space. Kinds of sensors give their own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from icalib.result import Calibration, RowResiduals
from icalib.sensors import answer
from icalib.sensors.records import Residuals


@dataclass(frozen=True, eq=False)
class ResidualCurve:
    """name: of what is left, "" where a sensor has one curve alone. seconds (n,); values (n, m) with m labels, in the
    unit that the labels say, or whitened."""

    name: str
    seconds: np.ndarray
    values: np.ndarray
    labels: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ResidualCloud:
    """Points (n, 3) [m] that a sensor measured, in the world at seconds (n,), and the size (n,) [m] of their
    residuals."""

    sensor: str
    seconds: np.ndarray
    points: np.ndarray
    size: np.ndarray


def curves(c: Calibration, r: Residuals) -> Iterator[ResidualCurve]:
    """Of one record of the result, as its kind of sensor shows it, or else each column of its rows."""
    own = answer(c.rig["sensors"][r.sensor]["type"], "show", "curves", r)
    if own is not None:
        yield from own
    elif isinstance(r, RowResiduals):
        for k, label in enumerate(r.labels):
            yield ResidualCurve(label, r.seconds, r.whitened[:, k : k + 1], (f"{label}, whitened",))
