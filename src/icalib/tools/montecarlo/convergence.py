"""Error and 3 sigma bound of each calibration parameter against the solver's iterations, as in Figures 2 and 3
of the iCalib paper. Axes are logarithmic, as errors fall by orders of magnitude."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icalib.base.extras import load_matplotlib
from icalib.report.plot import COLORS, Figure, axis, figure, line
from icalib.sensors.parameter_spec import display_unit
from icalib.tools.montecarlo.record import GroupErrors, RunRecord

MOST_RUNS = 6
SIGMAS = 3.0
_PANEL_INCHES = (2.6, 1.9)


@dataclass(frozen=True)
class Curve:
    """One parameter in one run: |error| (k,) and 3 sigma bound (k,) at k iterations of the solver, in the unit of the
    panel."""

    seed: int
    error: np.ndarray
    bound: np.ndarray


@dataclass(frozen=True)
class Panel:
    """Plot of one parameter in several runs."""

    title: str
    unit: str
    curves: tuple[Curve, ...]


@dataclass(frozen=True)
class PanelRow:
    """The panels of one block."""

    key: str
    panels: tuple[Panel, ...]


def rows(records: Sequence[RunRecord]) -> tuple[PanelRow, ...]:
    """Panels of the first MOST_RUNS runs that did not fail, a row for each block. Of the cameras only the first is
    shown, as in the iCalib paper."""
    runs = [r for r in sorted(records, key=lambda r: r.seed) if not r.failure][:MOST_RUNS]
    blocks = {b.key: b for r in runs for b in r.blocks}
    lenses = [b.sensor for b in blocks.values() if b.name == "distortion"]
    return tuple(_row(runs, b) for b in blocks.values() if b.sensor not in lenses[1:])


def _row(runs: Sequence[RunRecord], block: GroupErrors) -> PanelRow:
    unit, scale = display_unit(block.unit)
    panels = []
    for k, label in enumerate(block.labels):
        curves = tuple(_curve(r, int(r.columns(block.key)[k]), scale) for r in runs if len(r.columns(block.key)))
        verdicts = [b.verdict[k] for r in runs for b in r.blocks if b.key == block.key]
        times = verdicts.count("unobservable")
        words = f" (unobservable in {times} of {len(verdicts)})" if times else ""
        name = block.name if label == block.name else f"{block.name} {label}"
        panels.append(Panel(f"{block.sensor} {name}{words}".replace("_", " "), unit, curves))
    return PanelRow(block.key, tuple(panels))


def _curve(record: RunRecord, column: int, scale: float) -> Curve:
    """Error and bound of the parameter in one column. A parameter fixed at the guess gets the standard deviation of the
    result. For others, the consider covariance of the result is added at each iteration."""
    verdicts = [v for b in record.blocks for v in b.verdict]
    error = np.array([w.error[column] for w in record.path])
    sigma, in_the_end = np.array([w.std[column] for w in record.path]), record.covariance[column, column]
    if verdicts[column] == "unobservable":
        sigma = np.full(len(error), np.sqrt(in_the_end))
    elif len(sigma):
        sigma = np.sqrt(sigma**2 + max(in_the_end - sigma[-1] ** 2, 0.0))
    return Curve(record.seed, scale * np.abs(error), scale * SIGMAS * sigma)


def plotly_figure(row: PanelRow) -> Figure:
    """The panels of a block side by side."""
    n, gap, traces, layout = len(row.panels), 0.08, [], {}
    width = (1.0 - gap * (n - 1)) / n
    for i, panel in enumerate(row.panels):
        number = "" if i == 0 else str(i + 1)
        left = i * (width + gap)
        layout[f"xaxis{number}"] = axis("iteration", domain=[left, left + width], anchor=f"y{number}")
        layout[f"yaxis{number}"] = axis(_words(panel), type="log", anchor=f"x{number}")
        axes = {"xaxis": f"x{number}", "yaxis": f"y{number}"}
        for k, curve in enumerate(panel.curves):
            style = axes | {"legendgroup": str(curve.seed), "showlegend": i == 0}
            x, color = np.arange(len(curve.error)), COLORS[k % len(COLORS)]
            dashed = {"line": {"color": color, "width": 1, "dash": "dash"}, "showlegend": False}
            traces.append(line(x, _positive(curve.error), f"seed {curve.seed}", color, **style))
            traces.append(line(x, _positive(curve.bound), f"3 sigma, seed {curve.seed}", color, **(style | dashed)))
    return figure(traces, height=300, **layout)


def png(rows: Sequence[PanelRow], title: str) -> bytes:
    """PNG picture with a row of panels for each block. Raises RecordingError if matplotlib is not installed."""
    columns = max(len(r.panels) for r in rows)
    size = (_PANEL_INCHES[0] * columns, _PANEL_INCHES[1] * len(rows) + 0.6)
    sheet = load_matplotlib().Figure(figsize=size, layout="constrained")
    sheet.suptitle(f"{title}: error and 3 sigma (dashed) against iterations", fontsize=10)
    grid = sheet.subplots(len(rows), columns, squeeze=False)
    for places, row in zip(grid, rows, strict=True):
        for place in places[len(row.panels) :]:
            place.set_visible(False)
        for place, panel in zip(places, row.panels, strict=False):
            _draw(place, panel)
    out = io.BytesIO()
    sheet.savefig(out, format="png", dpi=130)
    return out.getvalue()


def _draw(place, panel: Panel) -> None:
    for k, curve in enumerate(panel.curves):
        color = COLORS[k % len(COLORS)]
        place.semilogy(_positive(curve.error), color=color, linewidth=1.0)
        place.semilogy(_positive(curve.bound), color=color, linewidth=0.7, linestyle="--")
    place.set_title(panel.title, fontsize=7)
    place.set_ylabel(f"|error| [{panel.unit}]" if panel.unit else "|error|", fontsize=6)
    place.tick_params(labelsize=6)
    place.xaxis.get_major_locator().set_params(integer=True)
    place.grid(True, color="#e5e7eb")


def _words(panel: Panel) -> str:
    return f"{panel.title} [{panel.unit}]" if panel.unit else panel.title


def _positive(values: np.ndarray) -> np.ndarray:
    """The values with NaN for those that are not positive, which a logarithmic axis cannot show."""
    return np.where(values > 0.0, values, np.nan)
