"""Whiteness of residuals: lag-one autocorrelation of whitened residuals in time."""

from __future__ import annotations

import numpy as np

from icalib.result import Calibration
from icalib.sensors.records import Successive
from icalib.tools.montecarlo.record import Whiteness


def whiteness(result: Calibration) -> tuple[Whiteness, ...]:
    """Whiteness of each kind of residual in `result`."""
    return tuple(
        _statistics(r.sensor, name, rows)
        for r in result.residuals.values()
        for name, rows in r.successive().items()
        if len(rows.whitened)
    )


def _statistics(sensor: str, kind: str, rows: Successive) -> Whiteness:
    """Mean square of whitened residuals, and correlation of each with its successor."""
    values = rows.whitened
    first, second = values[:-1][rows.follows], values[1:][rows.follows]
    mean_square = float(np.mean(values**2)) if values.size else 0.0
    power = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return Whiteness(sensor, kind, mean_square, float((first * second).sum()) / power if power > 0.0 else 0.0)
