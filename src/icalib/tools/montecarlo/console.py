"""Prints the summary of a study on the terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from icalib.tools.montecarlo.study import Study
from icalib.tools.montecarlo.summary import (
    HEADERS,
    NUMBERS,
    Consistency,
    answer,
    block_row,
    failures_words,
    largest_words,
    nees_cells,
    unobservable_words,
)

MOST_FAILURES = 10  # that are printed
IN_TWO_LINES = ("mean sigma", "sampled / predicted")  # headers that may wrap


def print_study(study: Study, folder: Path) -> None:
    """Prints the table of blocks, failed runs, and the paths of the files on standard output."""
    console, consistency = Console(), study.consistency
    console.print(table(consistency))
    for line in (answer(consistency), largest_words(consistency), *_failures(consistency), *_unobservable(consistency)):
        console.print(line, markup=False)
    seconds = [r.seconds for r in study.records]
    console.print(f"A run took {np.median(seconds):.1f} s (median).", markup=False)
    console.print(f"Wrote {folder / 'consistency.json'}, consistency.html.", markup=False)


def table(consistency: Consistency) -> Table:
    """One row for each block, and one for all together; a NEES outside its bounds is red. The table fits into 80
    columns of text."""
    out = Table(
        title="Consistency", title_justify="left", caption_justify="left", box=SIMPLE_HEAD, padding=0, show_edge=False
    )
    out.caption = "NEES: per degree of freedom, 1 for a consistent covariance. Undetermined entries are excluded."
    for header in HEADERS:
        justify = "right" if header in NUMBERS else "left"
        out.add_column(header, justify=justify, no_wrap=header not in IN_TWO_LINES, overflow="fold")
    for block in consistency.blocks:
        cells = [Text(cell) for cell in block_row(block)]
        if block.nees is not None:
            cells[3].stylize("green" if block.nees.consistent else "bold red")
        out.add_row(*cells)
    if consistency.whole is not None:
        out.add_section()
        out.add_row("all together", "", "", *nees_cells(consistency.whole))
    return out


def _failures(consistency: Consistency) -> list[str]:
    lines = [failures_words(consistency)]
    lines += [f"  seed {f.seed}: {f.sentence}" for f in consistency.failures[:MOST_FAILURES]]
    more = len(consistency.failures) - MOST_FAILURES
    return lines + ([f"  and {more} more, in consistency.json"] if more > 0 else [])


def _unobservable(consistency: Consistency) -> list[str]:
    return [f"Unobservable in {line}" for line in unobservable_words(consistency)]
