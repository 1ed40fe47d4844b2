"""Runs of a study on many cores or machines."""

from __future__ import annotations

from collections.abc import Generator, Iterable

from icalib.tools.batch import Crew, FailedTask
from icalib.tools.batch import run_all as run_tasks
from icalib.tools.montecarlo.one_run import RunTask, run
from icalib.tools.montecarlo.record import RunRecord


def run_all(
    tasks: Iterable[RunTask], workers: int | None = None, scheduler: str | None = None
) -> Generator[RunRecord, None, None]:
    """Yields the records as they finish, in any order. A run whose worker died repeatedly has a failed record with an
    empty `program`. Raises the errors of `icalib.tools.batch.run_all`."""
    for task, record in run_tasks(run, tasks, Crew(workers, scheduler)):
        yield RunRecord(task.seed, record.sentence, 0.0, "") if isinstance(record, FailedTask) else record
