"""Runs on many cores or machines."""

from __future__ import annotations

from collections.abc import Generator, Iterable

from icalib.batch import Crew, Lost
from icalib.batch import run_all as run_tasks
from icalib.montecarlo.one_run import Task, run
from icalib.montecarlo.record import Record


def run_all(
    tasks: Iterable[Task], workers: int | None = None, scheduler: str | None = None
) -> Generator[Record, None, None]:
    """Records as they are ready, in no order. A run that killed its worker time after time ends as a failed one, with
    no program. Raises what `icalib.batch.run_all` raises."""
    for task, record in run_tasks(run, tasks, Crew(workers, scheduler)):
        yield Record(task.seed, record.sentence, 0.0, "") if isinstance(record, Lost) else record
