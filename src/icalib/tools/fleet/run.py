"""Runs a fleet: calibrates the jobs without an up-to-date result, and compares the results of each robot over time."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from math import isfinite
from pathlib import Path

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from icalib.base.files import printable, refuse_foreign, refuse_foreign_set, sealed
from icalib.errors import CalibrationError
from icalib.tools.batch import Crew, FailedTask, exclusive_lock, run_all, write_atomically
from icalib.tools.fleet import page
from icalib.tools.fleet.page import fleet_html, write_table
from icalib.tools.fleet.result import (
    Fleet,
    InputHashes,
    Job,
    JobRecord,
    JobResult,
    JobStore,
    JobTask,
    by_robot,
    drift_of,
    load_jobs,
    run,
    to_do,
)

Progress = Callable[[str, float], None]
TABLE, PAGE = "fleet.sqlite", "fleet.html"
LIMIT = 3.0  # sigmas, as in `icalib compare`


def run_fleet(
    path: str | Path,
    output: str | Path,
    crew: Crew | None = None,
    limit: float = LIMIT,
    progress: Progress = lambda *_: None,
    say: Callable[[str], None] = lambda sentence: None,
) -> Fleet:
    """Runs the jobs of the file at `path` that have no up-to-date result in `output`, and writes fleet.sqlite and
    fleet.html there.

    crew: the worker pool, by default a worker for each core. limit: sigmas beyond which a block has changed. say:
    called with a sentence on each job that will be run again. Raises RigError if the file is wrong; CalibrationError if
    the folder cannot be written, has files that icalib did not write or is locked by another process, or if no cluster
    answers. KeyboardInterrupt gets a message with the number of finished jobs.
    """
    if not (isfinite(limit) and limit > 0.0):
        raise CalibrationError(f"the limit must be above 0 sigma, not {limit:g}; the usual limit is 3.")
    jobs, store = load_jobs(path), JobStore(Path(output))
    with exclusive_lock(store.folder):
        refuse_foreign(store.folder / name for name in (TABLE, PAGE))
        fleet = _fleet(jobs, store, crew or Crew(), limit, progress, say)
        write_table(store.folder / TABLE, fleet.results)
        write_atomically(store.folder / PAGE, sealed(printable(fleet_html(fleet, Path(path).name)).encode()))
    return fleet


def _fleet(
    jobs: tuple[Job, ...], store: JobStore, crew: Crew, limit: float, progress: Progress, say: Callable[[str], None]
) -> Fleet:
    """Runs the missing jobs, and compares the results of each robot."""
    inputs = {job.name: InputHashes.of(job) for job in jobs}
    done, again = to_do(store, inputs)
    for name, why in again.items():
        say(f"{name} is calibrated again: {why}.")
    tasks = [JobTask(job, inputs[job.name]) for job in jobs if job.name not in done]
    for task in tasks:
        refuse_foreign_set(store.place(task.job.name), [task.job.rig, *task.job.recordings])
    records = done | _do(tasks, store, crew, len(jobs), progress)
    results = tuple(JobResult(job, records[job.name]) for job in jobs)
    robots = by_robot(results)
    drifts = tuple(drift_of(robot, [r.job.name for r in group], store.load, limit) for robot, group in robots.items())
    return Fleet(results, drifts, limit, again)


def _do(tasks: list[JobTask], store: JobStore, crew: Crew, total: int, progress: Progress) -> dict[str, JobRecord]:
    """Runs the tasks, and returns their records by name. Records of jobs whose worker died are not stored, so that the
    next run tries them again. total: number of all jobs, for the progress."""
    records: dict[str, JobRecord] = {}
    before = total - len(tasks)
    if not tasks:
        return records
    progress(f"{before} of {total} jobs", 0.0)
    try:
        with closing(run_all(run, tasks, crew)) as outcomes:
            for task, outcome in outcomes:
                name = task.job.name
                if isinstance(outcome, FailedTask):
                    records[name] = JobRecord(name, outcome.sentence, 0.0, None)
                else:
                    store.add(outcome)
                    records[name] = outcome.record
                progress(f"{before + len(records)} of {total} jobs", len(records) / len(tasks))
    except KeyboardInterrupt:
        n_stored = before + sum(r.inputs is not None for r in records.values())
        raise KeyboardInterrupt(
            f"{n_stored} of {total} jobs are in {store.folder}; the same command resumes."
        ) from None
    return records


# Prints the result of a fleet on the terminal.

MOST = 20  # sentences of each kind that are printed; fleet.html has all


def print_fleet(fleet: Fleet, folder: Path) -> None:
    """Prints a row for each robot, failures, changes, and the paths of the files on standard output."""
    console = Console()
    console.print(table(fleet))
    console.print(page.answer(fleet), markup=False)
    if any(d.n_tested for d in fleet.drifts):
        console.print(page.chance_words(fleet), markup=False)
    for title, sentences in (
        ("Failed", page.failures(fleet)),
        ("Changed", page.changes(fleet)),
        ("Cannot be judged", page.unsure(fleet)),
        ("Note", page.notes(fleet)),
    ):
        for sentence in sentences[:MOST]:
            console.print(f"{title}: {sentence}", markup=False)
        if len(sentences) > MOST:
            console.print(f"{title}: {len(sentences) - MOST} more, in fleet.html", markup=False)
    console.print(f"Wrote {folder / 'fleet.html'}, fleet.sqlite, and a result for each job in jobs.", markup=False)


def table(fleet: Fleet) -> Table:
    """One row for each robot."""
    out = Table(title="Fleet", title_justify="left", box=SIMPLE_HEAD, padding=(0, 1))
    for header in page.ROBOT_HEADERS:
        out.add_column(header, justify="right" if header in page.ROBOT_HEADERS[1:3] else "left")
    for row in page.robot_rows(fleet):
        out.add_row(*map(str, row))
    return out
