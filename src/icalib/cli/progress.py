"""Progress bar for the Python API, in a terminal or a Jupyter notebook."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from importlib import import_module
from math import inf
from typing import Any

from icalib.cli import console

EVERY_S = 0.2  # least interval between updates in a notebook


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """Yields the argument `progress` of `icalib.calibrate`: `with icalib.progress_bar() as progress: ...`."""
    if not in_notebook():
        with console.console_progress(quiet=False) as show:
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
