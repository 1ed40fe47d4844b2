"""Jobs of a fleet, their results and records on disk, and the changes of each robot."""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from math import erfc, sqrt
from pathlib import Path
from typing import Any

import numpy as np

from icalib.base.files import SEAL, below, check_writable, finish_writing, read_file, regular, sealed, write_files
from icalib.base.yaml_nodes import YamlValue, read_yaml
from icalib.errors import CalibrationError
from icalib.export.formats import output_files
from icalib.geometry.so3 import rpy_std
from icalib.pipeline import calibrate
from icalib.result import Calibration, ParameterGroup, joint_covariance, load_calibration
from icalib.result.quantities import nontrivial_groups
from icalib.tools.batch import check_worker, plain_record, program, record_json, sentence_on
from icalib.tools.comparison.compare import Comparison, Difference, Side, compare_sides, sentence, side_of_result

# Result of a fleet: the results of all jobs, and the changes of each robot.


@dataclass(frozen=True)
class JobResult:
    """A job of the current file of jobs, and its record."""

    job: Job
    record: JobRecord

    @property
    def time(self) -> datetime | None:
        """Time of the recording (UTC): from the file of jobs, else from the recording's clock, else None."""
        if self.job.time is not None or self.record.stamp_ns is None:
            return self.job.time
        return datetime.fromtimestamp(self.record.stamp_ns // 10**9, UTC)

    @property
    def failed(self) -> bool:
        return bool(self.record.failure)

    @property
    def status(self) -> str:
        return "failed" if self.failed else "done"

    @property
    def sentence(self) -> str:
        return self.record.failure or self.record.status


@dataclass(frozen=True)
class Fleet:
    """Result of a fleet. results: in the order of the file of jobs; drifts: one for each robot; limit: sigmas beyond
    which a block has changed; again: jobs that were calibrated again, and the changed inputs."""

    results: tuple[JobResult, ...]
    drifts: tuple[Drift, ...]
    limit: float
    again: dict[str, str]

    @property
    def failed(self) -> tuple[JobResult, ...]:
        return tuple(r for r in self.results if r.failed)

    @property
    def drifted(self) -> tuple[Drift, ...]:
        return tuple(d for d in self.drifts if d.changes)

    @property
    def by_chance(self) -> float:
        """Expected number of changes by chance."""
        return by_chance(sum(d.n_tested for d in self.drifts), self.limit)

    def of(self, job: str) -> JobResult:
        """Result of the job with this name. Raises KeyError if there is none."""
        return {r.job.name: r for r in self.results}[job]


def by_robot(results: tuple[JobResult, ...]) -> dict[str, list[JobResult]]:
    """Results of each robot, without failed jobs. They are sorted by time, or in the order of the file if one has no
    time."""
    groups: dict[str, list[JobResult]] = {r.job.robot: [] for r in results}
    for r in results:
        if not r.failed:
            groups[r.job.robot].append(r)
    return {robot: in_time(group) for robot, group in groups.items()}


def in_time(results: list[JobResult]) -> list[JobResult]:
    times = {r.job.name: r.time for r in results}
    known = {name: t for name, t in times.items() if t is not None}
    return sorted(results, key=lambda r: known[r.job.name]) if len(known) == len(results) else results


# Reads a file of jobs; its format is described in docs/fleet.md.

_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,99}")
_UNFIT = re.compile(r"[^A-Za-z0-9_.-]+")


@dataclass(frozen=True)
class Job:
    """One calibration. name: also that of its folder; recordings: one, or several that are solved jointly; time: of the
    recordings (UTC), None if the file does not state it."""

    name: str
    robot: str
    rig: Path
    recordings: tuple[Path, ...]
    time: datetime | None = None


def load_jobs(path: str | Path) -> tuple[Job, ...]:
    """Reads a file of jobs. Paths are relative to its folder. Recordings may be missing: their jobs will fail.

    Raises RigError, one sentence naming file, line, field, what is wrong and what to do.
    """
    root = read_yaml(Path(path), "file of jobs")
    fields = root.record(("jobs",), ("defaults",))
    defaults = fields["defaults"].record((), ("robot", "rig")) if "defaults" in fields else {}
    folder = Path(path).absolute().parent
    values = fields["jobs"].items()
    if not values:
        fields["jobs"].fail("has no job; add one with robot, rig and recording.")
    jobs = tuple(_job(value, defaults, folder) for value in values)
    _refuse_twins(jobs, values)
    return jobs


def _job(value: YamlValue, defaults: dict[str, YamlValue], folder: Path) -> Job:
    job_fields = value.record(("recording",), ("name", "robot", "rig", "time"))
    fields = defaults | job_fields
    for name in ("robot", "rig"):
        if name not in fields:
            value.fail(f"{name} is missing; add {name}, here or for all jobs in defaults.")
    rig = folder / fields["rig"].text()
    if not rig.is_file():
        fields["rig"].fail(f"{rig} does not exist; correct the path of the rig file.")
    robot = fields["robot"].text()
    recordings = tuple(folder / text for text in _texts(fields["recording"]))
    name = (
        _name(job_fields["name"])
        if "name" in job_fields
        else _UNFIT.sub("_", f"{robot}-{recordings[0].name}").lstrip(".-")[:100]
    )
    return Job(name or "_", robot, rig, recordings, _time(job_fields["time"]) if "time" in job_fields else None)


def _texts(value: YamlValue) -> list[str]:
    items = value.items() if value.is_list else [value]
    if not items:
        value.fail("is an empty list; give the path of a recording, or several.")
    return [item.text() for item in items]


def _name(value: YamlValue) -> str:
    text = value.text()
    if not _NAME.fullmatch(text):
        value.fail(
            "must be a valid folder name (letters, digits, _, - and dots, 100 at most), but is "
            f"{value.summary()}; rename it."
        )
    return text


def _time(value: YamlValue) -> datetime:
    try:
        time = datetime.fromisoformat(value.text())
    except ValueError:
        value.fail(f"must be a date or time as in 2026-11-02 or 2026-11-02T13:05:00+01:00, but is {value.summary()}.")
    return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)


def _refuse_twins(jobs: tuple[Job, ...], values: list[YamlValue]) -> None:
    """Raises RigError if two jobs have the same name, upper and lower case being equal as in some file systems."""
    first_index: dict[str, int] = {}
    for k, job in enumerate(jobs):
        first = first_index.setdefault(job.name.casefold(), k)
        if first != k:
            values[k].fail(f"this job and {values[first].field} are both called {job.name}; give each its own name.")


# Hashes of a job's inputs: a job is calibrated again if they changed.


@dataclass(frozen=True)
class InputHashes:
    """Hashes of the inputs of a job. rig: sha256 of the file. recordings: for each, sha256 of the names, sizes and
    modification times of its files, as hashing the contents would take long; the folder does not matter. program: see
    `tools.batch.program`."""

    rig: str
    recordings: tuple[str, ...]
    program: str

    @classmethod
    def of(cls, job: Job) -> InputHashes:
        """Hashes of the current files and the running program; "absent" for a missing file."""
        return cls(_content(job.rig), tuple(map(_sizes, job.recordings)), program())

    def changed(self, now: InputHashes) -> str:
        """Words on the inputs that differ from `now`; "" if none does."""
        changes = [words for name, words in _CHANGED.items() if getattr(self, name) != getattr(now, name)]
        return ", ".join(changes)


_CHANGED = {"rig": "the rig file changed", "recordings": "the recording changed", "program": "icalib changed"}


def _content(path: Path) -> str:
    try:
        return hashlib.sha256(regular(path).read_bytes()).hexdigest()
    except OSError:
        return "absent"


def _sizes(path: Path) -> str:
    digest = hashlib.sha256(os.fsencode(path.name))
    n_files = 0
    for file in sorted(_files(path)):
        try:
            status = file.stat()
        except OSError:  # a dangling link, or just deleted: the reader of the recording reports what is missing
            continue
        digest.update(os.fsencode(f"{os.path.relpath(file, path)}\0{status.st_size}\0{status.st_mtime_ns}\0"))
        n_files += 1
    return digest.hexdigest() if n_files else "absent"


def _files(path: Path) -> Iterator[Path]:
    if not path.is_dir():
        yield path
    for folder, _, names in os.walk(path):
        yield from (Path(folder, name) for name in names)


# Record of one job, as JSON beside its result: how it ended, and its parameters.

FORMAT = 2
WALL_CLOCK_NS = (10**18, 4 * 10**18)  # 2001 to 2096; clocks that start with the computer are far below


@dataclass(frozen=True)
class GroupRecord:
    """One parameter group of one sensor, as in `ParameterGroup`. value: (n,), for a rotation (3, 3). rpy_std: (3,) of
    roll, pitch and yaw of a rotation [rad], NaN near gimbal lock; else (0,)."""

    sensor: str
    name: str
    labels: tuple[str, ...]
    unit: str
    value: np.ndarray
    std: np.ndarray  # (n,)
    verdict: tuple[str, ...]
    rpy_std: np.ndarray = field(default_factory=lambda: np.empty(0))


@dataclass(frozen=True)
class JobRecord:
    """One job. failure: the message, or "" if the solver converged; seconds: run time; status: how the solver ended, a
    sentence.

    inputs: hashes of the inputs; None if the worker died, and the record is not stored. stamp_ns: first stamp of the
    recording, None unless it is of a wall clock. unobservable, warnings: sentences. blocks: parameter groups.
    verdict: `Calibration.verdict`, "" without a result.
    """

    name: str
    failure: str
    seconds: float
    inputs: InputHashes | None
    status: str = ""
    stamp_ns: int | None = None
    unobservable: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()
    blocks: tuple[GroupRecord, ...] = ()
    verdict: str = ""

    @classmethod
    def of(cls, name: str, result: Calibration, seconds: float, inputs: InputHashes) -> JobRecord:
        """Record of a job with a result, converged or not."""
        stamp = min((r.origin_ns for r in result.recordings), default=0)
        low, high = WALL_CLOCK_NS
        blocks = tuple(_block_record(result, g) for g in nontrivial_groups(result) if g.sensor in result.rig["sensors"])
        known = stamp if low <= stamp < high else None
        unobservable, warnings = (tuple(map(str, said)) for said in (result.unobservable, result.warnings))
        about = (result.status, known, unobservable, warnings, blocks, result.verdict)
        return cls(name, result.failure, seconds, inputs, *about)


def _block_record(c: Calibration, g: ParameterGroup) -> GroupRecord:
    angles = rpy_std(g.value, joint_covariance(c, [g])) if g.value.ndim == 2 else np.empty(0)
    return GroupRecord(g.sensor, g.name, g.labels, g.unit, g.value, g.std, g.verdict, angles)


def to_json(record: JobRecord) -> bytes:
    """The record as JSON, with all digits and icalib's seal."""
    return sealed(record_json(record, FORMAT))


def from_json(text: bytes) -> JobRecord:
    """The record that `to_json` wrote. Raises ValueError, KeyError or TypeError if `text` is not such a record."""
    plain = plain_record(text, FORMAT)
    plain.pop(SEAL, None)
    inputs = plain["inputs"]
    plain["inputs"] = InputHashes(inputs["rig"], tuple(inputs["recordings"]), inputs["program"])
    for name in ("unobservable", "warnings"):
        plain[name] = tuple(plain[name])
    plain["blocks"] = tuple(_block_of(b) for b in plain["blocks"])
    return JobRecord(**plain)


def _block_of(plain: dict[str, Any]) -> GroupRecord:
    value, std, angles = (np.array(plain[name], dtype=np.float64) for name in ("value", "std", "rpy_std"))
    labels, verdict = (tuple(plain[name]) for name in ("labels", "verdict"))
    return GroupRecord(plain["sensor"], plain["name"], labels, plain["unit"], value, std, verdict, angles)


# Runs one job on a worker, and returns its record and the files of its result.


@dataclass(frozen=True)
class JobTask:
    """A job and the hashes of its inputs. They are taken before it waits for a worker, so that the next run sees
    changes of the inputs meanwhile."""

    job: Job
    inputs: InputHashes


@dataclass(frozen=True)
class JobOutcome:
    """Record of a job, and the files of its result by name; empty if the job failed."""

    record: JobRecord
    files: dict[str, bytes]


def run(task: JobTask) -> JobOutcome:
    """Runs a job. It never raises: the record of a failed job has the message. The record's inputs have the program of
    the worker."""
    started, inputs = time.perf_counter(), replace(task.inputs, program=program())
    try:
        result = calibrate(task.job.rig, task.job.recordings)
        files = output_files(result)
    except Exception as caught:
        return JobOutcome(JobRecord(task.job.name, sentence_on(caught), time.perf_counter() - started, inputs), {})
    return JobOutcome(JobRecord.of(task.job.name, result, time.perf_counter() - started, inputs), files)


# Changes between calibrations of one robot, with the tests and sentences of `icalib compare`.


@dataclass(frozen=True)
class GroupChange:
    """A block that differs between the jobs `before` and `after`; words: the sentence on it. at_its_sensor: the block
    is relative to the body or to no other sensor, so that the change is due to its sensor. testable: the block is
    determined on both sides, with standard deviations."""

    before: str
    after: str
    difference: Difference
    words: str
    at_its_sensor: bool
    testable: bool


@dataclass(frozen=True)
class Drift:
    """Changes of one robot. jobs: those with a result, in order of time. changes: beyond `limit` sigmas, between
    successive jobs; from the first to the last job only those that no step shows. unsure: differences that cannot be
    tested, as they are unusable or have no standard deviations. n_tested: number of tested differences. notes:
    what could not be compared."""

    robot: str
    jobs: tuple[str, ...]
    changes: tuple[GroupChange, ...] = ()
    unsure: tuple[GroupChange, ...] = ()
    n_tested: int = 0
    notes: tuple[str, ...] = ()

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors that changed. If only poses between two sensors changed, the sensor of the pair that is
        not the reference frame."""
        changes = [c for c in self.changes if c.at_its_sensor] or self.changes
        return tuple(dict.fromkeys(c.difference.sensor for c in changes))


@dataclass(frozen=True)
class _Comparison:
    """Comparison of two jobs: the blocks that differ, the number of tested blocks, and notes."""

    changes: tuple[GroupChange, ...] = ()
    n_tested: int = 0
    notes: tuple[str, ...] = ()


def drift_of(robot: str, jobs: Sequence[str], load: Callable[[str], Calibration], limit: float) -> Drift:
    """Changes of one robot. jobs: names in order of time. load: returns the result of a job; the message of its
    CalibrationError becomes a note, as does the first reason of a result that is not usable. limit: sigmas beyond which
    a block has changed. At most three results are in memory."""
    steps, notes, first, last = list[_Comparison](), list[str](), None, None
    for name in jobs:
        try:
            result = load(name)
        except CalibrationError as error:
            notes.append(str(error))
            continue
        if result.verdict == "not usable":
            notes.append(f"{name} is not usable and is not compared: {result.reasons[0]}")
            continue
        side = side_of_result(result, name)
        if last is not None:
            steps.append(_step(last, side, limit))
        first, last = first or side, side
    step_blocks = {_block(c) for s in steps for c in s.changes}
    if first is not None and last is not None and len(steps) > 1:
        slow = _step(first, last, limit)
        steps.append(_Comparison(tuple(c for c in slow.changes if _block(c) not in step_blocks), slow.n_tested))
    changes = [c for s in steps for c in s.changes]
    return Drift(
        robot,
        tuple(jobs),
        tuple(c for c in changes if c.testable),
        tuple(c for c in changes if not c.testable),
        sum(s.n_tested for s in steps),
        tuple(dict.fromkeys([*notes, *(n for s in steps for n in s.notes)])),
    )


def by_chance(n_tested: int, limit: float) -> float:
    """Expected number of `n_tested` comparisons beyond `limit` sigmas by chance."""
    return n_tested * erfc(limit / sqrt(2.0))


def _step(a: Side, b: Side, limit: float) -> _Comparison:
    try:
        comparison = compare_sides(a, b, limit=limit)
    except CalibrationError as error:
        return _Comparison(notes=(str(error),))
    changes = tuple(_change(d, comparison) for d in comparison.differences if d.differs)
    return _Comparison(changes, sum(_is_testable(d) for d in comparison.differences), comparison.notes)


def _change(d: Difference, c: Comparison) -> GroupChange:
    at_its_sensor = d.frame in (c.reference, d.sensor, c.a.body)
    return GroupChange(c.a.path, c.b.path, d, sentence(d, c), at_its_sensor, _is_testable(d))


def _is_testable(d: Difference) -> bool:
    return d.sigmas is not None and d.given_by == "both" and not d.open


def _block(c: GroupChange) -> tuple[str, str, str]:
    return c.difference.sensor, c.difference.frame, c.difference.what


# The folder of a fleet: jobs/ has a folder for each job with its result and its record, written together.

JOBS, RECORD = "jobs", "fleet-job.json"


class JobStore:
    """Records and results by the name of the job. Raises CalibrationError if the folder cannot be written."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        check_writable(folder / JOBS)

    def place(self, name: str) -> Path:
        """Folder of the job's files."""
        return below(self.folder / JOBS, name)

    def find(self, name: str) -> JobRecord | None:
        """The record of a job; None if the job is not done, or its result was deleted.

        Raises CalibrationError if the record is damaged, or an interrupted writing cannot be completed.
        """
        place = self.place(name)
        if not place.is_dir():
            return None
        finish_writing(place)
        if not (place / RECORD).exists():
            return None
        try:
            record = from_json(read_file(place, RECORD))
        except (ValueError, KeyError, TypeError) as error:
            raise CalibrationError(f"{place / RECORD} is damaged; delete it to run the job again.") from error
        return record if not record.blocks or (place / "result.json").exists() else None

    def add(self, outcome: JobOutcome) -> None:
        """Stores record and files of a job. Raises CalibrationError if the worker ran another icalib, or the folder
        cannot be written."""
        inputs = outcome.record.inputs
        check_worker(inputs.program if inputs is not None else "", program())
        write_files(self.place(outcome.record.name), outcome.files | {RECORD: to_json(outcome.record)})

    def load(self, name: str) -> Calibration:
        """The job's result. Raises CalibrationError if there is none, or it is damaged."""
        return load_calibration(self.place(name))


def to_do(store: JobStore, inputs: dict[str, InputHashes]) -> tuple[dict[str, JobRecord], dict[str, str]]:
    """Records of the jobs with an up-to-date result; and, for those whose inputs changed, words on the change. inputs:
    current hashes by name of the job."""
    done, changed = dict[str, JobRecord](), dict[str, str]()
    for name, now in inputs.items():
        record = store.find(name)
        if record is None or record.inputs is None:
            continue
        why = record.inputs.changed(now)
        if why:
            changed[name] = why
        else:
            done[name] = record
    return done, changed
