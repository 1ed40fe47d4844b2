"""Tasks on many cores or machines, by Dask. A task whose worker dies is done again on another."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, TypeVar

from icalib.base.extras import load_dask, load_distributed
from icalib.errors import CalibrationError

ANSWER_WITHIN_S = 10
# A task that waits at a worker would share the blame when that worker dies, and be given up in the end with the guilty.
_ONE_TASK_A_WORKER = {"distributed.scheduler.worker-saturation": 1.0}
SILENT = 60  # above every level of logging: what goes wrong is said in a sentence

Task = TypeVar("Task")
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Crew:
    """Who works. workers: processes on this machine, one for each core where None; scheduler: address of a Dask cluster
    instead. Raises CalibrationError where both are given, or no worker."""

    workers: int | None = None
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise CalibrationError(
                f"{self.workers} workers were asked for, but at least 1 is needed; correct --workers."
            )
        if self.workers is not None and self.scheduler is not None:
            raise CalibrationError("a cluster has its own number of workers; give --workers or --scheduler, not both.")


@dataclass(frozen=True)
class Lost:
    """In place of an answer: the sentence on a task that killed its worker time after time."""

    sentence: str


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_all(
    work: Callable[[Task], Answer], tasks: Iterable[Task], crew: Crew
) -> Generator[tuple[Task, Answer | Lost], None, None]:
    """Each task with `work`'s answer to it, as they are ready, in no order. `work` is of a module, and raises nothing.

    A solve has two threads, but the rest of a calibration has one: hence a worker for each core. Raises
    CalibrationError where no cluster answers or it goes away, RecordingError where Dask is not installed.
    """
    distributed = load_distributed()
    with ExitStack() as stack:
        client = _client(distributed, crew, stack)
        futures = {client.submit(work, task, pure=False): task for task in tasks}
        for future in distributed.as_completed(futures):
            yield futures[future], _answer(distributed, future)
            del futures[future]


def _client(distributed: Any, crew: Crew, stack: ExitStack) -> Any:
    if crew.scheduler is None:
        # No dashboard, but its port is taken all the same: any one, so that two studies can run side by side.
        with load_dask().config.set(_ONE_TASK_A_WORKER):
            cluster = distributed.LocalCluster(
                n_workers=crew.workers or cores(),
                threads_per_worker=1,
                dashboard_address=None,
                scheduler_kwargs={"dashboard_address": ":0"},
                silence_logs=SILENT,
            )
        return stack.enter_context(distributed.Client(stack.enter_context(cluster)))
    try:
        return stack.enter_context(distributed.Client(crew.scheduler, timeout=ANSWER_WITHIN_S))
    except (OSError, ValueError) as error:
        raise CalibrationError(
            f"no Dask scheduler answers at {crew.scheduler}; start one with dask scheduler, and give the "
            "address that it prints."
        ) from error


def _answer(distributed: Any, future: Any) -> Any:
    """Raises CalibrationError where the scheduler is gone, and with it what it knew, or on the way the answer."""
    try:
        error = future.exception()
        if error is None:
            return future.result()
    except (distributed.CancelledError, distributed.TimeoutError, OSError):
        raise CalibrationError(
            "the connection to the Dask scheduler was lost; finished tasks are kept, and the same command resumes."
        ) from None
    if isinstance(error, distributed.KilledWorker):
        times = error.allowed_failures + 1
        return Lost(f"its worker died {times} times at this task; give it more memory.")
    return Lost(f"its worker failed to run it ({type(error).__name__}: {error}); install the same icalib everywhere.")
