"""Reproduces the simulations of the iCalib paper: the robot of Table II in 3D and planar motion, and Figures 2 and
3."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from icalib.base.own_files import refuse_foreign, sealed
from icalib.report.page import plot_place
from icalib.report.plot import Figure
from icalib.report.tables import Html, element
from icalib.tools.batch import write_atomically
from icalib.tools.montecarlo.convergence import plotly_figure, png, rows
from icalib.tools.montecarlo.page import blocks_table, failures, page
from icalib.tools.montecarlo.study import Study, StudyPlan, run_study, scenario_digest
from icalib.tools.montecarlo.words import answer, failures_words, largest_words
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
    sections: list[Html] = []
    figures: dict[str, Figure] = {}
    for motion, study in studies.items():
        consistency = study.consistency
        sections += [element("h2", MOTIONS[motion]), element("p", answer(consistency)), blocks_table(consistency)]
        sections += [
            element("p", largest_words(consistency)),
            element("p", failures_words(consistency)),
            failures(consistency),
        ]
        drawn = rows(study.records)
        for row in drawn:
            name = f"{motion}-{row.key}"
            figures[name] = plotly_figure(row)
            sections.append(plot_place(name))
        if drawn:
            write_atomically(output / _picture(motion), sealed(png(drawn, MOTIONS[motion])))
    words = "Error (lines) and 3 sigma (dashed) at the iterations of the solver, from guesses drawn about the truth."
    write_atomically(output / PAGE, sealed(page("Monte-Carlo runs of the paper", words, sections, figures).encode()))


def _picture(motion: str) -> str:
    return f"convergence-{motion}.png"
