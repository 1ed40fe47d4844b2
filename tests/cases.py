"""`each`: many small cases in one test, which names all that fail."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

FAILURES = (Exception, pytest.fail.Exception, pytest.skip.Exception)  # a case that is skipped was not tested


def each(
    names: str | tuple[str, ...], cases: Iterable[Any], full: Iterable[Any] = ()
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Like `pytest.mark.parametrize`, but one item: thousands of them take longer to collect than to run.

    Each case has a folder `tmp_path` of its own, and ends with its patches; all other fixtures are shared. `full`:
    further cases, which are an item of their own, with the mark `full`.
    """
    keys = tuple(names.split(", ")) if isinstance(names, str) else names
    listed, further = ([_named(case, keys) for case in some] for some in (cases, full))
    assert listed, "no case"

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def run(*instance: Any, **fixtures: Any) -> None:
            failed = []
            run_now = further if further and fixtures.pop("in_full", False) else listed
            for number, (label, values) in enumerate(run_now):
                try:
                    with _own(fixtures, number) as own:
                        test(*instance, **values, **own)
                except FAILURES as error:
                    failed.append((label, error))
            if failed:
                sentences = "\n".join(f"{label}: {type(error).__name__}: {error}" for label, error in failed)
                raise AssertionError(f"{len(failed)} of {len(run_now)} cases fail\n{sentences}") from failed[0][1]

        signature = inspect.signature(test)
        kept = [p for name, p in signature.parameters.items() if name not in keys]
        if further:
            assert "in_full" not in signature.parameters, "one list of further cases is enough"
            kept.append(inspect.Parameter("in_full", inspect.Parameter.KEYWORD_ONLY))
        run.__signature__ = signature.replace(parameters=kept)  # pyright: ignore[reportAttributeAccessIssue]: fixtures
        marked = pytest.mark.parametrize(
            "in_full", [False, pytest.param(True, marks=pytest.mark.full)], ids=["ci", "full"]
        )
        return marked(run) if further else run

    return decorate


def _named(case: Any, keys: tuple[str, ...]) -> tuple[str, dict[str, Any]]:
    """The label of a case, and its value for each name. `case`: values, or a `pytest.param` of them."""
    label, values = None, case if len(keys) > 1 else (case,)
    if hasattr(case, "marks"):
        assert not case.marks, "a mark is of the whole test"
        label, values = case.id, case.values
    label = label or ", ".join(f"{getattr(value, '__name__', value)!s:.60}" for value in values)
    return label, dict(zip(keys, values, strict=True))


@contextmanager
def _own(fixtures: dict[str, Any], number: int) -> Iterator[dict[str, Any]]:
    """Fixtures of one case: an empty folder, nothing printed yet, and patches that end with it."""
    own = dict(fixtures)
    if "tmp_path" in own:
        own["tmp_path"] = own["tmp_path"] / f"case{number}"
        own["tmp_path"].mkdir()
    if "capsys" in own:
        own["capsys"].readouterr()
    with pytest.MonkeyPatch.context() as patch:
        yield own | ({"monkeypatch": patch} if "monkeypatch" in own else {})
