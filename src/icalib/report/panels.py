"""Figure of `RowResiduals` over time."""

from __future__ import annotations

from icalib.report.plot import COLORS, Figure, figure, line, stacked_axes, thin, y_of
from icalib.result import RowResiduals

MOST_ROWS = 2500  # rows in one figure; more are thinned out
DISPLAY_UNITS = {"rad": ("mrad", 1e3), "m": ("mm", 1e3), "m/s": ("mm/s", 1e3)}


def panels(r: RowResiduals) -> Figure:
    """Residuals over time, one panel for each column, with a common time axis. Units with rad and m are shown in mrad
    and mm."""
    keep = thin(len(r.seconds), MOST_ROWS)
    units = [DISPLAY_UNITS.get(unit, (unit, 1.0)) for unit in r.units]
    traces = [
        line(
            r.seconds[keep],
            scale * r.residual[keep, k],
            label,
            COLORS[k % len(COLORS)],
            yaxis=y_of(k),
            line={"color": COLORS[k % len(COLORS)], "width": 1},
        )
        for k, (label, (_, scale)) in enumerate(zip(r.labels, units, strict=True))
    ]
    titles = [f"{label} [{unit}]" for label, (unit, _) in zip(r.labels, units, strict=True)]
    return figure(traces, 130 * len(titles) + 90, **stacked_axes(titles))
