"""Many independent tasks on local processes or a Dask cluster; finished tasks are stored, so that a rerun resumes.

If a worker dies, its task is repeated on another worker.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Generator, Iterable
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, TypeVar

from icalib.base.extras import load_dask, load_distributed
from icalib.errors import CalibrationError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path

from icalib.base.extras import load_filelock
from icalib.base.files import staged, writing

ANSWER_WITHIN_S = 10  # time limit to connect to a scheduler
# No task is queued at a busy worker: Dask would count the worker's death against the queued task, too, and give it up.
_ONE_TASK_A_WORKER = {"distributed.scheduler.worker-saturation": 1.0}
SILENT = 60  # above every logging level: icalib reports errors in its messages

Task = TypeVar("Task")
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Crew:
    """A worker pool. workers: number of processes on this machine, None for one per core; scheduler: address of a Dask
    cluster to be used instead. Raises CalibrationError if both are given, or workers is less than 1."""

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
class FailedTask:
    """Result of a task that could not be run, because its worker died repeatedly or failed; sentence: the message."""

    sentence: str


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_all(
    work: Callable[[Task], Answer], tasks: Iterable[Task], crew: Crew
) -> Generator[tuple[Task, Answer | FailedTask], None, None]:
    """Runs `work` on each task, and yields pairs of task and result as they finish, in any order. `work` must be a
    function of a module, so that it can be pickled, and must not raise.

    Each core has one worker: a solve has two threads, but the rest of a calibration has one. Raises CalibrationError
    if no cluster answers or the connection is lost, RecordingError if Dask is not installed.
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
        # Dask opens a port even without a dashboard. Port 0 picks a free one, so that two studies can run in parallel.
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
    """Result of a finished task, or `FailedTask`. Raises CalibrationError if the connection to Dask is lost."""
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
        return FailedTask(f"its worker died {times} times at this task; give it more memory.")
    return FailedTask(
        f"its worker failed to run it ({type(error).__name__}: {error}); install the same icalib everywhere."
    )


def record_json(record: DataclassInstance, form: int) -> bytes:
    """JSON of a dataclass of arrays and plain values, with all digits; form: number of the file format."""
    return json.dumps({"format": form} | asdict(record), default=lambda array: array.tolist()).encode()


def plain_record(text: bytes, form: int) -> dict[str, Any]:
    """The fields of the dataclass that `record_json` wrote, as plain values. Raises ValueError, KeyError or TypeError
    if `text` is not such a record of format `form`."""
    plain: dict[str, Any] = json.loads(text)
    if plain.pop("format") != form:
        raise ValueError("another format")
    return plain


def sentence_on(error: Exception) -> str:
    """The message for the record of a failed task, which does not stop the others. An unexpected exception is reported
    as a fault of icalib."""
    if isinstance(error, CalibrationError):
        return str(error)
    return f"the program failed ({type(error).__name__}: {error}), which is a fault of icalib; please report it."


def check_worker(worker_program: str, local_program: str) -> None:
    """Raises CalibrationError if the digest of the worker's program differs from that on this machine."""
    if worker_program != local_program:
        raise CalibrationError(
            "a worker of the cluster runs another version of icalib than this machine; install the same "
            "version everywhere."
        )


def write_atomically(path: Path, content: bytes) -> None:
    """Writes the file atomically: readers see the old content or the new one. Raises CalibrationError if it fails."""
    with replacing(path) as part, part.open("wb") as file:
        file.write(content)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Context with the path of a temporary file, which replaces `path` at the end, or is removed if anything fails.

    Raises CalibrationError if the file cannot be written.
    """
    with writing(path), staged(path.parent) as place:
        part = place / path.name
        yield part
        with part.open("r+b") as file:
            os.fsync(file.fileno())
        part.replace(path)


LOCK = ".lock"


@contextmanager
def exclusive_lock(folder: Path) -> Iterator[None]:
    """Context with an exclusive lock on `folder`. The lock ends with the process, however that ends.

    Raises CalibrationError if another process has the lock, or the folder cannot be written. A file system without
    locks is not protected.
    """
    filelock = load_filelock()
    lock = filelock.FileLock(folder / LOCK)
    with writing(folder), suppress(NotImplementedError):  # the file system has no locks
        try:
            lock.acquire(blocking=False)
        except filelock.Timeout:
            raise CalibrationError(
                f"another icalib uses {folder}; wait until it ends, stop it, or choose another folder."
            ) from None
    try:
        yield
    finally:
        lock.release()


@cache
def program() -> str:
    """Digest of the Python source of `icalib`, 16 hexadecimal digits. Results of different versions, released or
    not, must not be mixed."""
    digest = hashlib.sha256()
    root = Path(__file__).parents[1]
    for file in sorted(root.rglob("*.py")):
        digest.update(file.relative_to(root).as_posix().encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()[:16]
