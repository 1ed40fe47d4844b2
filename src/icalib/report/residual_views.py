"""Data that the 3D view shows of residuals: curves over time, and points in space. Each kind of sensor defines them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from icalib.result import Calibration, RowResiduals
from icalib.sensors import call_kind
from icalib.sensors.records import Residuals


@dataclass(frozen=True, eq=False)
class ResidualCurve:
    """Curves over time. name: the kind of residual, "" if the sensor has only one. seconds (n,); values (n, m), one
    column for each label, whitened or in the unit that the label names."""

    name: str
    seconds: np.ndarray
    values: np.ndarray
    labels: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class ResidualCloud:
    """Points (n, 3) [m] measured by a sensor, in the world frame, at seconds (n,). size (n,): absolute values of their
    residuals [m]."""

    sensor: str
    seconds: np.ndarray
    points: np.ndarray
    size: np.ndarray


def curves(c: Calibration, r: Residuals) -> Iterator[ResidualCurve]:
    """Curves of one residual record as its kind of sensor defines them; by default one whitened curve for each column
    of `RowResiduals`."""
    kind_curves = call_kind(c.rig["sensors"][r.sensor]["type"], "show", "curves", r)
    if kind_curves is not None:
        yield from kind_curves
    elif isinstance(r, RowResiduals):
        for k, label in enumerate(r.labels):
            yield ResidualCurve(label, r.seconds, r.whitened[:, k : k + 1], (f"{label}, whitened",))
