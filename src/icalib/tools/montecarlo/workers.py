"""Runs on many cores or machines."""

from __future__ import annotations

from collections.abc import Generator, Iterable

from icalib.tools.batch import Crew, Lost
from icalib.tools.batch import run_all as run_tasks
from icalib.tools.montecarlo.one_run import RunTask, run
from icalib.tools.montecarlo.record import RunRecord


def run_all(
    tasks: Iterable[RunTask], workers: int | None = None, scheduler: str | None = None
) -> Generator[RunRecord, None, None]:
    """Records as they are ready, in no order. A run that killed its worker time after time ends as a failed one, with
    no program. Raises what `icalib.tools.batch.run_all` raises."""
    for task, record in run_tasks(run, tasks, Crew(workers, scheduler)):
        yield RunRecord(task.seed, record.sentence, 0.0, "") if isinstance(record, Lost) else record
