"""Converts residuals of a factor of the estimator to a record in the result."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from icalib.motion.factor import ResidualRows
from icalib.result.timeline import Timeline
from icalib.sensors.parameter_spec import AXES
from icalib.sensors.records import RowResiduals

CLIP = 4.0  # standard deviations, so that outliers do not dominate the correlation


def row_record(
    kind: str, rows: Sequence[ResidualRows], timeline: Timeline, labels: Mapping[str, tuple[str, ...]] | None = None
) -> RowResiduals:
    """One record of all residuals `rows` of one factor, which have the same times. kind: name of the record. labels:
    names of the columns by kind of residual; the default is the kind, followed by the axis (or index) if there are
    several columns."""
    names = {r.kind: _labels(r) for r in rows} | dict(labels or {})
    columns = [(label, r.unit) for r in rows for label in names[r.kind]]
    seconds = timeline.on_result_clock(rows[0].seconds, timeline.recording_of(rows[0].seconds))
    residual, whitened = (np.hstack([getattr(r, name) for r in rows]) for name in ("residual", "whitened"))
    return RowResiduals(
        rows[0].sensor,
        kind,
        tuple(label for label, _ in columns),
        tuple(unit for _, unit in columns),
        seconds,
        residual,
        whitened,
    )


def _labels(r: ResidualRows) -> tuple[str, ...]:
    n = r.residual.shape[1]
    if n == 1:
        return (r.kind,)
    return tuple(f"{r.kind} {mark}" for mark in (AXES if n == len(AXES) else range(1, n + 1)))


def lag_one_correlation(whitened: np.ndarray) -> float:
    """Lag-one autocorrelation of whitened residuals (n, m) over all columns, with values clipped at `CLIP`; 0 if n <
    2."""
    clipped = np.clip(whitened, -CLIP, CLIP)
    return float((clipped[1:] * clipped[:-1]).sum() / max((clipped**2).sum(), 1e-30))
