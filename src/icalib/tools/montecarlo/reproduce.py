"""Reproduces the simulations of the iCalib paper: the robot of Table II in 3D and planar motion, and Figures 2 and
3.

Error and 3 sigma bound of each calibration parameter against the solver's iterations, as in Figures 2 and 3 of the
iCalib paper. Axes are logarithmic, as errors fall by orders of magnitude.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from icalib.base.extras import load_matplotlib
from icalib.base.files import refuse_foreign, sealed
from icalib.report.figures import COLORS, Figure, axis, figure, line
from icalib.report.page import Plot
from icalib.sensors.parameter import display_unit
from icalib.tools.batch import write_atomically
from icalib.tools.montecarlo.record import GroupErrors, RunRecord
from icalib.tools.montecarlo.study import Study, StudyPlan, run_study, scenario_digest
from icalib.tools.montecarlo.summary import page
from icalib.tools.simulation import load_scenario

MOTIONS = {"3d": "Motion in three dimensions", "planar": "Planar motion"}
PAGE = "reproduce.html"
FOLDER = Path(__file__).parent / "paper"
Progress = Callable[[str, float], None]


def reproduce(output: Path, plan: StudyPlan, progress: Progress = lambda *_: None) -> dict[str, Study]:
    """Runs both studies, each in a subfolder of `output`, and writes figures and table to `output` (reproduce.html,
    PNG). Returns the studies by the names in `MOTIONS`.

    Raises the errors of `run_study`.
    """
    refuse_foreign([output / PAGE, *(output / _picture(motion) for motion in MOTIONS)])
    studies = {}
    for k, motion in enumerate(MOTIONS):

        def show(words: str, done: float, k: int = k, motion: str = motion) -> None:
            progress(f"{motion}: {words}", (k + done) / len(MOTIONS))

        file = FOLDER / f"table2-{motion}.yaml"
        scenario = load_scenario(file)
        name = f"Table II, {motion}"
        studies[motion] = run_study(scenario, name, scenario_digest(file, scenario), output / motion, plan, show)
    write_figures(output, studies)
    return studies


def write_figures(output: Path, studies: dict[str, Study]) -> None:
    """Writes reproduce.html, and a PNG picture for each motion in which at least one run reached a result."""
    sections = {}
    for motion, study in studies.items():
        drawn = rows(study.records)
        plots = [Plot(f"{motion}-{row.key}", plotly_figure(row), row.key) for row in drawn]
        sections[MOTIONS[motion]] = (study.consistency, plots)
        if drawn:
            write_atomically(output / _picture(motion), sealed(png(drawn, MOTIONS[motion])))
    words = "Error (lines) and 3 sigma (dashed) at the iterations of the solver, from guesses drawn about the truth."
    write_atomically(output / PAGE, sealed(page("Monte-Carlo runs of the paper", (words,), sections).encode()))


def _picture(motion: str) -> str:
    return f"convergence-{motion}.png"


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
    sections, as in the iCalib paper."""
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
