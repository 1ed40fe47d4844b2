"""`consistency.html`: a study in one file that needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from string import Template

import numpy as np

from icalib.report.page import document, plot_place, resource
from icalib.report.plot import COLORS, Figure, axis, figure, numbers
from icalib.report.tables import Html, element, html, sentences, table
from icalib.tools.montecarlo.record import RunRecord
from icalib.tools.montecarlo.store import Identity
from icalib.tools.montecarlo.summary import (
    HEADERS,
    NUMBERS,
    Consistency,
    Nees,
    answer,
    block_row,
    chance_words,
    failures_words,
    largest_words,
    mean_cells,
    nees_cells,
    unobservable_words,
    verdict_words,
)

MEAN = ("sensor", "kind", "mean over runs")


def study_html(consistency: Consistency, identity: Identity, records: Sequence[RunRecord]) -> str:
    """The page as one HTML document."""
    sections = [
        element("h2", "Blocks"),
        blocks_table(consistency),
        element(
            "p",
            "Sampled / predicted: square roots of the smallest and the largest eigenvalue of the sampled "
            "covariance relative to the predicted one; by chance: the range of these in 95 of 100 studies of a "
            "consistent covariance.",
        ),
        element("p", largest_words(consistency)),
        element("h2", "Mean NEES"),
        plot_place("nees"),
        *_unobservable(consistency),
        element("h2", "Failed runs"),
        element("p", failures_words(consistency)),
        failures(consistency),
        element("h2", "Residuals"),
        _residuals(consistency),
        element("h2", "Made from"),
        table(("what", "value"), _facts(identity, records)),
    ]
    return page(f"Consistency, {identity.scenario}", answer(consistency), sections, {"nees": nees_figure(consistency)})


def page(title: str, summary: str, sections: Sequence[Html], figures: dict[str, Figure]) -> str:
    """HTML document in the style of the reports, from its sections and figures."""
    body = Template(resource("icalib.tools.montecarlo", "page.html")).substitute(
        title=html(title), answer=html(summary), sections="".join(sections)
    )
    return document(title, body, figures)


def failures(consistency: Consistency) -> Html:
    """List of the failed runs, each with its message."""
    return sentences([f"seed {f.seed}: {f.sentence}" for f in consistency.failures], "bad", "")


def blocks_table(consistency: Consistency) -> Html:
    headers = (*HEADERS, "by chance", "verdicts")
    body: list[tuple[str, ...]] = [
        (*block_row(b), chance_words(b.spread), verdict_words(b)) for b in consistency.blocks
    ]
    if consistency.whole is not None:
        body.append(("all together", "", "", *nees_cells(consistency.whole), *[""] * (len(headers) - 5)))
    return table(headers, body, NUMBERS)


def nees_figure(consistency: Consistency) -> Figure:
    """Mean NEES of each block, with the 95 % bounds for a consistent covariance."""
    blocks: list[tuple[str, Nees]] = [(b.key, b.nees) for b in consistency.blocks if b.nees is not None]
    names = [name for name, _ in blocks]
    middle = np.array([0.5 * (n.low + n.high) for _, n in blocks])
    half = np.array([0.5 * (n.high - n.low) for _, n in blocks])
    bounds = {
        "type": "scatter",
        "mode": "markers",
        "x": names,
        "y": numbers(middle),
        "name": "95 % bounds",
        "marker": {"opacity": 0},
        "error_y": {"array": numbers(half), "color": "#94a3b8", "thickness": 6, "width": 0},
    }
    means = {
        "type": "scatter",
        "mode": "markers",
        "x": names,
        "y": numbers(np.array([n.mean for _, n in blocks])),
        "name": "mean NEES",
        "marker": {"color": COLORS[0], "size": 8},
    }
    return figure([bounds, means], xaxis=axis("", automargin=True), yaxis=axis("NEES per degree of freedom"))


def _unobservable(consistency: Consistency) -> list[Html]:
    """Section on what was unobservable in at least one run; empty if nothing was."""
    if not consistency.unobservable:
        return []
    return [element("h2", "Unobservable"), sentences(unobservable_words(consistency), "care", "None.")]


def _residuals(consistency: Consistency) -> Html:
    sizes = [element("h3", "chi2 per post-fit degree of freedom"), table(MEAN, map(mean_cells, consistency.sizes))]
    lags = [element("h3", "Correlation with the next one in time"), table(MEAN, map(mean_cells, consistency.lag1))]
    return element("div", [element("section", sizes), element("section", lags)], "grid")


def _facts(identity: Identity, records: Sequence[RunRecord]) -> list[tuple[str, object]]:
    seconds = float(np.median([r.seconds for r in records]))
    return [
        ("scenario", identity.scenario),
        ("sha256", element("code", identity.scenario_sha256)),
        ("first guess", identity.guess),
        ("planes of LiDARs", identity.planes),
        ("seeds", f"{records[0].seed} to {records[-1].seed}"),
        ("time of a run", f"{seconds:.1f} s (median)"),
        ("program", element("code", identity.program)),
        *identity.versions.items(),
    ]
