"""Output of the command line: progress bar and summary of the result."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from importlib import import_module
from math import inf
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from icalib.export.kalibr import kalibr_texts
from icalib.report.console import bodies_words, legend, lens_words, relative_words, shown_rows, table
from icalib.result import Calibration
from icalib.result.quantities import chi2_words, dof_words, rms_words
from icalib.result.verdict import NEXT, Usability

LINE_EVERY_S = 30.0  # interval between progress lines if stderr is no terminal
RESIDUALS = "Residuals: chi^2 per degree of freedom is 1 where noise is as stated; in brackets the degrees of freedom."
VERDICT_STYLES: dict[Usability, str] = {
    "usable": "bold green",
    "usable with care": "bold yellow",
    "partly usable": "bold red",
    "not usable": "bold red",
}


@contextmanager
def console_progress(quiet: bool) -> Iterator[Callable[[str, float], None]]:
    """Context manager that yields a function to show stage and completed fraction (0 to 1).

    It shows a bar on standard error; if that is no terminal, a line at most every 30 s; nothing if `quiet`.
    """
    console = Console(stderr=True)
    if quiet:
        yield lambda stage, done: None
        return
    if not console.is_terminal:
        yield progress_lines(time.monotonic)
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("starting", total=1.0)
        yield lambda stage, done: bar.update(task, description=stage, completed=done)


def progress_lines(clock: Callable[[], float]) -> Callable[[str, float], None]:
    """Function that prints stage and completed fraction on standard error, at most every 30 s. clock: time [s]."""
    begin = last = clock()

    def show(stage: str, done: float) -> None:
        nonlocal last
        now = clock()
        if now - last >= LINE_EVERY_S:
            last = now
            print(f"icalib: {stage}, {done:.0%} after {now - begin:.0f} s", file=sys.stderr, flush=True)

    return show


def print_result(calibration: Calibration, folder: Path, verbose: bool = False) -> None:
    """Prints the result on standard output: parameters, residual statistics, notes, written files, verdict. verbose:
    all parameters, see `shown_rows`."""
    console, entries = Console(markup=False), shown_rows(calibration, verbose)
    if len(entries) > console.height:  # a long output begins with verdict and first reason
        console.print(_verdict_line(calibration))
        for sentence in calibration.reasons[:1]:
            console.print(f"Reason 1 of {len(calibration.reasons)}: {sentence}", highlight=False)
    console.print(table(entries))
    lines = (*lens_words(calibration, console.width - 2), bodies_words(calibration), *relative_words(calibration))
    for sentence in filter(None, lines):
        console.print(f"  {sentence}")
    console.print(legend(calibration, entries), highlight=False)
    if calibration.fits:
        console.print(RESIDUALS)
    for f in calibration.fits:
        rms = f", {rms_words(f)} RMS" if f.rms is not None else ""
        rms += f", {f.rejected} rejected" if f.unit == "px" else ""
        console.print(f"  {f.sensor} {f.kind}: chi^2 per degree of freedom {chi2_words(f)} ({dof_words(f)}){rms}")
    for sentence in calibration.notes:
        console.print(f"Note: {sentence}")
    console.print(f"Solver: {calibration.status}")
    written = [*kalibr_texts(calibration), "report.html"]
    unfit = ", with the verdict that it is not usable" if calibration.verdict == "not usable" else ""
    console.print(f"Wrote {folder / 'calibration.yaml'}{unfit}, {', '.join(written)}.")
    print_verdict(calibration, console)


def print_verdict(calibration: Calibration, console: Console) -> None:
    """Prints the numbered reasons of the verdict, and as last line the verdict with advice."""
    for k, sentence in enumerate(calibration.reasons, 1):
        console.print(f"Reason {k}: {sentence}", highlight=False)
    console.print(_verdict_line(calibration))


def _verdict_line(c: Calibration) -> Text:
    return Text.assemble("Verdict: ", (c.verdict, VERDICT_STYLES[c.verdict]), f". {NEXT[c.verdict]}")


def print_warnings(calibration: Calibration) -> None:
    """Output of `--quiet` on standard error: reasons and verdict, or nothing if there are no reasons."""
    if calibration.reasons:
        print_verdict(calibration, Console(stderr=True, markup=False))


# Progress bar for the Python API, in a terminal or a Jupyter notebook.

EVERY_S = 0.2  # least interval between updates in a notebook


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Yields the argument `progress` of `icalib.calibrate`: `with icalib.progress_bar() as progress: ...`."""
    if not in_notebook():
        with console_progress(quiet=False) as show:
            yield show
        return
    display: Any = import_module("IPython.display")
    handle, last = display.display(display.HTML(_bar("starting", 0.0)), display_id=True), -inf

    def redraw(stage: str, done: float) -> None:
        nonlocal last
        if time.monotonic() - last >= EVERY_S:
            last = time.monotonic()
            handle.update(display.HTML(_bar(stage, done)))

    try:
        yield redraw
    finally:
        handle.update(display.HTML(""))


def in_notebook() -> bool:
    """True in a Jupyter kernel, which always imports IPython first."""
    ipython: Any = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return getattr(shell, "kernel", None) is not None


def _bar(stage: str, done: float) -> str:
    return f'<progress value="{done:.3f}" max="1" style="width: 20em"></progress> {escape(stage)}'
