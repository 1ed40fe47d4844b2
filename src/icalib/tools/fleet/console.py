"""Prints the result of a fleet on the terminal."""

from __future__ import annotations

from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from icalib.tools.fleet import words
from icalib.tools.fleet.result import Fleet

MOST = 20  # sentences of each kind that are printed; fleet.html has all


def print_fleet(fleet: Fleet, folder: Path) -> None:
    """Prints a row for each robot, failures, changes, and the paths of the files on standard output."""
    console = Console()
    console.print(table(fleet))
    console.print(words.answer(fleet), markup=False)
    if any(d.n_tested for d in fleet.drifts):
        console.print(words.chance_words(fleet), markup=False)
    for title, sentences in (
        ("Failed", words.failures(fleet)),
        ("Changed", words.changes(fleet)),
        ("Cannot be judged", words.unsure(fleet)),
        ("Note", words.notes(fleet)),
    ):
        for sentence in sentences[:MOST]:
            console.print(f"{title}: {sentence}", markup=False)
        if len(sentences) > MOST:
            console.print(f"{title}: {len(sentences) - MOST} more, in fleet.html", markup=False)
    console.print(f"Wrote {folder / 'fleet.html'}, fleet.sqlite, and a result for each job in jobs.", markup=False)


def table(fleet: Fleet) -> Table:
    """One row for each robot."""
    out = Table(title="Fleet", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1))
    for header in words.ROBOT_HEADERS:
        out.add_column(header, justify="right" if header in words.ROBOT_HEADERS[1:3] else "left")
    for row in words.robot_rows(fleet):
        out.add_row(*map(str, row))
    return out
