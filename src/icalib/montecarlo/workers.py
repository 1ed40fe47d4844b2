"""Runs on many cores or machines, by Dask. A run whose worker dies is made again on another."""

from __future__ import annotations

import os
from collections.abc import Generator, Iterable
from contextlib import ExitStack
from typing import Any

from icalib.errors import CalibrationError
from icalib.extras import load_distributed
from icalib.montecarlo.one_run import Task, run
from icalib.montecarlo.record import Record

ANSWER_WITHIN_S = 10
SILENT = 60  # above every level of logging: what goes wrong is said in a sentence


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_all(
    tasks: Iterable[Task], workers: int | None = None, scheduler: str | None = None
) -> Generator[Record, None, None]:
    """Records as they are ready, in no order.

    workers: processes on this machine; None: one for each core. A solve has two threads, but the rest of a run has one.
    scheduler: address of a cluster to use instead. A run that killed its worker time after time ends as a failed one,
    with no program. Raises CalibrationError where no cluster answers, RecordingError where Dask is not installed.
    """
    distributed = load_distributed()
    with ExitStack() as stack:
        client = _client(distributed, workers, scheduler, stack)
        futures = {client.submit(run, task, pure=False): task for task in tasks}
        for future in distributed.as_completed(futures):
            yield future.result() if future.status == "finished" else _lost(futures[future], future.exception())
            del futures[future]


def _client(distributed: Any, workers: int | None, scheduler: str | None, stack: ExitStack) -> Any:
    if scheduler is None:
        # No dashboard, but its port is taken all the same: any one, so that two studies can run side by side.
        cluster = distributed.LocalCluster(
            n_workers=workers or cores(),
            threads_per_worker=1,
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": ":0"},
            silence_logs=SILENT,
        )
        return stack.enter_context(distributed.Client(stack.enter_context(cluster)))
    try:
        return stack.enter_context(distributed.Client(scheduler, timeout=ANSWER_WITHIN_S))
    except (OSError, ValueError) as error:
        raise CalibrationError(
            f"no Dask scheduler answers at {scheduler}; start one with dask scheduler, and give the address it prints."
        ) from error


def _lost(task: Task, error: BaseException | None) -> Record:
    """What is known of a run that Dask gave up."""
    return Record(task.seed, f"its worker died again and again ({error}); give it more memory.", 0.0, "")
