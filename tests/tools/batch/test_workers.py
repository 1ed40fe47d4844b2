"""Tasks on real workers: what becomes of those that raise, and of those that kill their worker."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.cases import each

from icalib.base.extras import load_distributed
from icalib.errors import CalibrationError
from icalib.tools.batch import Crew, FailedTask, _answer, run_all, write_atomically


def test_a_task_that_kills_its_workers_is_given_up_and_takes_no_other_with_it():
    """`eval` is work that any worker has."""
    killer = "__import__('time').sleep(0.5) or __import__('os')._exit(1)"
    found = dict(run_all(eval, [killer, "7", "int('x')", "8"], Crew(workers=1)))
    assert (found.pop("7"), found.pop("8")) == (7, 8)
    assert found == {
        killer: FailedTask("its worker died 4 times at this task; give it more memory."),
        "int('x')": FailedTask(
            "its worker failed to run it (ValueError: invalid literal for int() with base 10: 'x'); "
            "install the same icalib everywhere."
        ),
    }


@each("error", [OSError("closed"), TimeoutError("late"), load_distributed().CancelledError("gone")])
def test_an_answer_that_never_comes_is_a_scheduler_that_went_away(error: BaseException):
    class Future:
        def exception(self) -> None:
            return None

        def result(self) -> None:
            raise error

    with pytest.raises(
        CalibrationError, match="the connection to the Dask scheduler was lost; finished tasks are kept"
    ):
        _answer(load_distributed(), Future())


def test_a_file_is_the_old_one_or_the_new_one(tmp_path: Path):
    write_atomically(tmp_path / "a", b"old")
    write_atomically(tmp_path / "a", b"new")
    assert (tmp_path / "a").read_bytes() == b"new"
    (tmp_path / "b").mkdir()
    for place in (tmp_path / "b", tmp_path / "a" / "c", tmp_path / "absent" / "c"):
        with pytest.raises(CalibrationError, match=r"cannot be written .*; choose another folder\."):
            write_atomically(place, b"new")
    assert sorted(f.name for f in tmp_path.iterdir()) == ["a", "b"]
