"""Many simulated runs of one scenario, and their text on the console."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Generator, Iterable
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from icalib.base.files import printable, refuse_foreign, sealed
from icalib.errors import CalibrationError
from icalib.tools.batch import Crew, FailedTask, exclusive_lock, write_atomically
from icalib.tools.batch import run_all as run_tasks
from icalib.tools.montecarlo.record import GuessKind, Identity, PlanesKind, RunRecord, RunStore, RunTask, run
from icalib.tools.montecarlo.summary import (
    HEADERS,
    NUMBERS,
    Consistency,
    answer,
    block_row,
    consistency_json,
    failures_words,
    largest_words,
    nees_cells,
    study_html,
    summarise,
    unobservable_words,
)
from icalib.tools.simulation import Drive, Scenario, load_scenario

# A Monte-Carlo study: runs of one scenario with different seeds, and their summary. A rerun resumes it.
#
# Runs of a study on many cores or machines.

Progress = Callable[[str, float], None]
FILES = ("consistency.json", "consistency.html")


@dataclass(frozen=True)
class StudyPlan:
    """Settings of a study. runs: their number; seed: of the first run, None for that of the scenario; guess, planes:
    see `RunTask`; workers, scheduler: see `Crew`. Raises CalibrationError if they make no sense.
    """

    runs: int
    seed: int | None = None
    guess: GuessKind = "none"
    planes: PlanesKind = "known"
    workers: int | None = None
    scheduler: str | None = None

    def __post_init__(self) -> None:
        if self.runs < 1:
            raise CalibrationError(f"{self.runs} runs were asked for, but a study needs at least 1; correct --runs.")
        Crew(self.workers, self.scheduler)  # raises CalibrationError if both are given, or no worker


@dataclass(frozen=True)
class Study:
    """The records of all runs in the order of their seeds, and their summary."""

    identity: Identity
    records: tuple[RunRecord, ...]
    consistency: Consistency


def run_file(path: str | Path, output: str | Path, plan: StudyPlan, progress: Progress = lambda *_: None) -> Study:
    """`run_study` of the scenario file at `path`. Raises also RigError if the file is wrong."""
    scenario = load_scenario(path)
    return run_study(scenario, str(path), scenario_digest(path, scenario), Path(output), plan, progress)


def run_study(
    scenario: Scenario, name: str, digest: str, output: Path, plan: StudyPlan, progress: Progress = lambda *_: None
) -> Study:
    """Makes the runs that are missing in `output`, and writes consistency.json and consistency.html there.

    name, digest: of the scenario, see `scenario_digest`. Raises CalibrationError if the folder has runs of another
    study, cannot be written, has files that icalib did not write or is locked by another process, or if no cluster
    answers. KeyboardInterrupt gets a message with the number of finished runs.
    """
    refuse_foreign(output / name for name in FILES)
    store = RunStore(output, Identity.of(name, digest, plan.guess, plan.planes))
    first = scenario.seed if plan.seed is None else plan.seed
    seeds = range(first, first + plan.runs)
    with exclusive_lock(output):
        lost = _fill(store, scenario, seeds, plan, progress)
        records = tuple(lost[seed] if seed in lost else store.read(seed) for seed in seeds)
        study = Study(store.identity, records, summarise(records))
        about = asdict(store.identity) | {"first_seed": first}
        page = printable(study_html(study.consistency, study.identity, records)).encode()
        for file, content in zip(FILES, (consistency_json(study.consistency, about), page), strict=True):
            write_atomically(output / file, sealed(content))
    return study


def scenario_digest(path: str | Path, scenario: Scenario) -> str:
    """sha256 of the scenario file at `path` and of the trajectory file that it names."""
    digest = hashlib.sha256(Path(path).read_bytes())
    if isinstance(scenario.motion, Drive) and scenario.motion.path is not None:
        digest.update(scenario.motion.path.read_bytes())
    return digest.hexdigest()


def _fill(
    store: RunStore, scenario: Scenario, seeds: range, plan: StudyPlan, progress: Progress
) -> dict[int, RunRecord]:
    """Makes and stores the missing runs. Returns the records of runs whose worker died, by seed, which are not
    stored."""
    missing = [seed for seed in seeds if seed not in store]
    done, lost = len(seeds) - len(missing), dict[int, RunRecord]()
    if not missing:
        return lost
    progress(_words(done, seeds), 0.0)
    try:
        tasks = [RunTask(scenario, seed, plan.guess, plan.planes) for seed in missing]
        with closing(run_all(tasks, plan.workers, plan.scheduler)) as records:
            for made, record in enumerate(records, 1):
                if record.program:
                    store.add(record)
                else:
                    lost[record.seed] = record
                progress(_words(done + made, seeds), made / len(missing))
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"{sum(s in store for s in seeds)} of {len(seeds)} runs are in {store.folder}; the same command resumes."
        ) from None
    return lost


def _words(done: int, seeds: range) -> str:
    return f"{done} of {len(seeds)} runs"


def run_all(
    tasks: Iterable[RunTask], workers: int | None = None, scheduler: str | None = None
) -> Generator[RunRecord, None, None]:
    """Yields the records as they finish, in any order. A run whose worker died repeatedly has a failed record with an
    empty `program`. Raises the errors of `icalib.tools.batch.run_all`."""
    for task, record in run_tasks(run, tasks, Crew(workers, scheduler)):
        yield RunRecord(task.seed, record.sentence, 0.0, "") if isinstance(record, FailedTask) else record


# Prints the summary of a study on the terminal.

MOST_FAILURES = 10  # that are printed
IN_TWO_LINES = ("mean sigma", "sampled / predicted")  # headers that may wrap


def print_study(study: Study, folder: Path) -> None:
    """Prints the table of blocks, failed runs, and the paths of the files on standard output."""
    console, consistency = Console(), study.consistency
    console.print(table(consistency))
    for line in (answer(consistency), largest_words(consistency), *_failures(consistency), *_unobservable(consistency)):
        console.print(line, markup=False)
    seconds = [r.seconds for r in study.records]
    console.print(f"A run took {np.median(seconds):.1f} s (median).", markup=False)
    console.print(f"Wrote {folder / 'consistency.json'}, consistency.html.", markup=False)


def table(consistency: Consistency) -> Table:
    """One row for each block, and one for all together; a NEES outside its bounds is red. The table fits into 80
    columns of text."""
    out = Table(
        title="Consistency", title_justify="left", caption_justify="left", box=SIMPLE_HEAD, padding=0, show_edge=False
    )
    out.caption = "NEES: per degree of freedom, 1 for a consistent covariance. Undetermined entries are excluded."
    for header in HEADERS:
        justify = "right" if header in NUMBERS else "left"
        out.add_column(header, justify=justify, no_wrap=header not in IN_TWO_LINES, overflow="fold")
    for block in consistency.blocks:
        cells = [Text(cell) for cell in block_row(block)]
        if block.nees is not None:
            cells[3].stylize("green" if block.nees.consistent else "bold red")
        out.add_row(*cells)
    if consistency.whole is not None:
        out.add_section()
        out.add_row("all together", "", "", *nees_cells(consistency.whole))
    return out


def _failures(consistency: Consistency) -> list[str]:
    lines = [failures_words(consistency)]
    lines += [f"  seed {f.seed}: {f.sentence}" for f in consistency.failures[:MOST_FAILURES]]
    more = len(consistency.failures) - MOST_FAILURES
    return lines + ([f"  and {more} more, in consistency.json"] if more > 0 else [])


def _unobservable(consistency: Consistency) -> list[str]:
    return [f"Unobservable in {line}" for line in unobservable_words(consistency)]
