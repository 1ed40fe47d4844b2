"""Progress in a notebook is a bar of HTML below the cell, and nothing is left of it; elsewhere it is the terminal's."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

import icalib
from icalib.cli import console


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What a stand-in for IPython was told to show."""
    texts: list[str] = []
    handle = SimpleNamespace(update=texts.append)

    def display(text: str, display_id: bool) -> Any:
        assert display_id
        texts.append(text)
        return handle

    ipython, parts = ModuleType("IPython"), ModuleType("IPython.display")
    ipython.get_ipython = lambda: SimpleNamespace(kernel=object())  # type: ignore[attr-defined]
    parts.display, parts.HTML = display, lambda text: text  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", parts)
    monkeypatch.setattr(console, "EVERY_S", 0.0)
    return texts


def test_a_notebook_shows_a_bar(shown: list[str]):
    with icalib.progress_bar() as show:
        show("reading <cam0>", 0.25)
    assert 'value="0.250"' in shown[1] and "reading &lt;cam0&gt;" in shown[1]
    assert shown[0] != "" and shown[-1] == ""


def test_nothing_is_left_where_the_work_fails(shown: list[str]):
    with pytest.raises(ValueError, match="bad"), icalib.progress_bar():
        raise ValueError("bad")
    assert shown[-1] == ""


def test_a_notebook_redraws_only_now_and_then(shown: list[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(console, "EVERY_S", 100.0)
    with icalib.progress_bar() as show:
        for k in range(50):
            show("solving", k / 50)
    assert len(shown) == 3


def test_elsewhere_it_is_that_of_the_console(monkeypatch: pytest.MonkeyPatch):
    made: list[bool] = []
    real = console.console_progress

    def spy(quiet: bool) -> Any:
        made.append(quiet)
        return real(quiet)

    monkeypatch.setattr(console, "console_progress", spy)
    with icalib.progress_bar() as show:
        show("solving", 0.5)
    assert made == [False] and not console.in_notebook()
