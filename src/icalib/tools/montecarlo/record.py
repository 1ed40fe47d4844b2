"""One run of a study, its record, and the store of all records."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from icalib.base.files import writing
from icalib.errors import CalibrationError
from icalib.geometry import so3
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration, Visited
from icalib.result.saving import versions
from icalib.sensors.stream import Successive
from icalib.tools.batch import check_worker, plain_record, program, record_json, sentence_on, write_atomically
from icalib.tools.simulation import Scenario, Truth, rig_for, simulate, with_drawn_guess

# Record of one run: its errors and their covariance, and the JSON format that preserves every bit of them.

FORMAT = 2
LEAST_SIGMA = 1e-100  # replaces a standard deviation of 0, so that an error over it is finite


@dataclass(frozen=True)
class GroupErrors:
    """One block: parameter group `name` of a sensor, such as cam0.rotation. labels, verdict: name and verdict of each
    entry; its entries in `RunRecord.error` follow those of the blocks before it. unit: of the entries, SI."""

    sensor: str
    name: str
    labels: tuple[str, ...]
    unit: str
    verdict: tuple[str, ...]

    @property
    def key(self) -> str:
        return f"{self.sensor}.{self.name}"


@dataclass(frozen=True)
class Size:
    """Residual statistics of one kind of residual: number of residuals, post-fit degrees of freedom, chi^2."""

    sensor: str
    kind: str
    count: int
    dof: float
    chi2: float


@dataclass(frozen=True)
class Whiteness:
    """Mean square of whitened residuals of one kind, and their lag-one autocorrelation."""

    sensor: str
    kind: str
    mean_square: float
    lag1: float


@dataclass(frozen=True)
class Waypoint:
    """One iteration of the solver: error and formal standard deviation before the step, entries as in `RunRecord`."""

    stage: str
    error: np.ndarray  # (n,)
    std: np.ndarray  # (n,)


@dataclass(frozen=True)
class RunRecord:
    """One run. failure: the message, or "" if the solver converged; a run that ended early has no blocks. seconds: run
    time.

    error (n,): estimated minus true, block after block, SI units; for rotations e of R_estimated = R_true Exp(e) [rad].
    covariance (n, n): formal covariance of `error`. unobservable: sentences on unobservable combinations. path:
    iterations of the solver from the initial guess to the result. program: digest of the code that ran it.
    """

    seed: int
    failure: str
    seconds: float
    program: str
    blocks: tuple[GroupErrors, ...] = ()
    error: np.ndarray = field(default_factory=lambda: np.empty(0))
    covariance: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    unobservable: tuple[str, ...] = ()
    sizes: tuple[Size, ...] = ()
    whiteness: tuple[Whiteness, ...] = ()
    path: tuple[Waypoint, ...] = ()

    def errors(self) -> Iterator[tuple[GroupErrors, str, str, float]]:
        """Block, label and verdict of each entry of `error`, and its error in formal standard deviations. With a
        standard deviation of 0 an error counts as huge."""
        sigma = np.maximum(np.sqrt(np.diag(self.covariance)), LEAST_SIGMA)
        entries = ((b, label, v) for b in self.blocks for label, v in zip(b.labels, b.verdict, strict=True))
        for (block, label, verdict), z in zip(entries, (self.error / sigma).tolist(), strict=True):
            yield block, label, verdict, z

    def columns(self, key: str) -> np.ndarray:
        """(m,) indices in `error` of the block `key` ("cam0.rotation"); empty if the run has no such block."""
        start = 0
        for block in self.blocks:
            if block.key == key:
                return np.arange(start, start + len(block.labels))
            start += len(block.labels)
        return np.arange(0)


def to_json(record: RunRecord) -> bytes:
    """The record as JSON, with all digits."""
    return record_json(record, FORMAT)


def from_json(text: bytes) -> RunRecord:
    """The record that `to_json` wrote. Raises ValueError, KeyError or TypeError if `text` is not such a record."""
    plain = plain_record(text, FORMAT)
    plain["blocks"] = tuple(_block(b) for b in plain["blocks"])
    plain["sizes"] = tuple(Size(**s) for s in plain["sizes"])
    plain["whiteness"] = tuple(Whiteness(**w) for w in plain["whiteness"])
    plain["path"] = tuple(Waypoint(w["stage"], np.array(w["error"]), np.array(w["std"])) for w in plain["path"])
    plain["unobservable"] = tuple(plain["unobservable"])
    plain["error"] = np.array(plain["error"], dtype=np.float64)
    n = len(plain["error"])
    plain["covariance"] = np.array(plain["covariance"], dtype=np.float64).reshape(n, n)
    return RunRecord(**plain)


def _block(plain: dict[str, Any]) -> GroupErrors:
    return GroupErrors(plain["sensor"], plain["name"], tuple(plain["labels"]), plain["unit"], tuple(plain["verdict"]))


# One run: simulate, calibrate, compare with the truth. Exceptions become part of the record of the run.
#
# Errors of a result, as the perturbations that its covariance describes. Whiteness of residuals: lag-one
# autocorrelation of whitened residuals in time.

GuessKind = Literal["none", "drawn"]
PlanesKind = Literal["known", "found"]


@dataclass(frozen=True, eq=False)
class RunTask:
    """Inputs of a run. guess: "none", the program finds the initial guess; "drawn", the guess is drawn at random about
    the truth. Without a target, intrinsics always have a drawn guess, because feature tracks alone do not determine
    them. planes: the plane of each LiDAR point is "known", or "found" in the clouds."""

    scenario: Scenario
    seed: int
    guess: GuessKind = "none"
    planes: PlanesKind = "known"


def run(task: RunTask) -> RunRecord:
    """Simulates and calibrates. Extrinsics, time offsets, intrinsics and distortions are estimated. The record depends
    on the task alone, except for its `seconds`."""
    started, visits = time.perf_counter(), list[Visited]()
    try:
        simulation = simulate(task.scenario, task.seed)
        rig = rig_for(task.scenario, intrinsics="free", distortion="free")
        if task.guess == "drawn" or not rig.has_target:
            only = None if task.guess == "drawn" else ("intrinsics",)
            rig = with_drawn_guess(rig, task.scenario, task.seed, only=only)
        measurements = simulation.measurements
        if task.planes == "found":
            measurements = measurements.unassociated()
        result = calibrate_measurements(rig, measurements, on_visit=visits.append)
    except Exception as caught:
        return RunRecord(task.seed, sentence_on(caught), time.perf_counter() - started, program())
    return compare(task.seed, result, simulation.truth, visits, time.perf_counter() - started)


def compare(seed: int, result: Calibration, truth: Truth, visits: list[Visited], seconds: float) -> RunRecord:
    """The record of a run that reached a result. visits: estimates at the solver's iterations; seconds: run time."""
    blocks, errors, columns = [], [np.empty(0)], list[int]()
    for g in result.groups:
        true = true_value(truth, g.sensor, g.name)
        if g.columns is not None and true is not None:
            blocks.append(GroupErrors(g.sensor, g.name, g.labels, g.unit, g.verdict))
            errors.append(error(g.name, g.value, true))
            columns += g.columns
    return RunRecord(
        seed,
        result.failure,
        seconds,
        program(),
        tuple(blocks),
        np.concatenate(errors),
        result.covariance[np.ix_(columns, columns)],
        result.unobservable,
        tuple(Size(f.sensor, f.kind, f.count, f.dof, f.chi2) for f in result.fits),
        whiteness(result),
        _path(tuple(blocks), truth, visits),
    )


def _path(blocks: tuple[GroupErrors, ...], truth: Truth, visits: list[Visited]) -> tuple[Waypoint, ...]:
    """Waypoints from the last initial guess to the result; visits before it belong to guesses that were given up."""
    stages = [v.stage for v in visits]
    begins = [k for k, stage in enumerate(stages) if k == 0 or (stage == stages[0] and stages[k - 1] != stage)]
    return tuple(_waypoint(blocks, truth, v) for v in visits[begins[-1] :]) if visits else ()


def _waypoint(blocks: tuple[GroupErrors, ...], truth: Truth, visit: Visited) -> Waypoint:
    errors, deviations = [np.empty(0)], [np.empty(0)]
    for b in blocks:
        true = true_value(truth, b.sensor, b.name)
        assert true is not None  # `compare` sees to it
        errors.append(error(b.name, visit.values[b.sensor, b.name], true))
        deviations.append(visit.std[b.sensor, b.name])
    return Waypoint(visit.stage, np.concatenate(errors), np.concatenate(deviations))


def true_value(truth: Truth, sensor: str, name: str) -> np.ndarray | None:
    """True value of the group `name` of `sensor`, in the form of `ParameterGroup.value`; None if the truth has none, as
    for the tilt of a target."""
    return truth.values.get(sensor, {}).get(name)


def error(name: str, value: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(n,) estimated minus true; for rotations e of R_estimated = R_true Exp(e) [rad], in the sensor's axes."""
    return so3.log(np.ascontiguousarray(true.T @ value)) if name == "rotation" else value - true


def whiteness(result: Calibration) -> tuple[Whiteness, ...]:
    """Whiteness of each kind of residual in `result`."""
    return tuple(
        _statistics(r.sensor, name, rows)
        for r in result.residuals.values()
        for name, rows in r.successive().items()
        if len(rows.whitened)
    )


def _statistics(sensor: str, kind: str, rows: Successive) -> Whiteness:
    """Mean square of whitened residuals, and correlation of each with its successor."""
    values = rows.whitened
    first, second = values[:-1][rows.follows], values[1:][rows.follows]
    mean_square = float(np.mean(values**2)) if values.size else 0.0
    power = float(np.sqrt((first**2).sum() * (second**2).sum()))
    return Whiteness(sensor, kind, mean_square, float((first * second).sum()) / power if power > 0.0 else 0.0)


# The folder of a study: one file per run, written atomically, and study.json with the inputs of all runs.

STUDY, RUNS = "study.json", "runs"


@dataclass(frozen=True)
class Identity:
    """Inputs that all runs of a folder share. scenario: its name; scenario_sha256: of the scenario file and the
    trajectory file that it names; guess, planes: see `RunTask`; program, versions: of icalib, Python and libraries."""

    scenario: str
    scenario_sha256: str
    guess: GuessKind
    planes: PlanesKind
    program: str
    versions: dict[str, str]

    @classmethod
    def of(cls, scenario: str, scenario_sha256: str, guess: GuessKind, planes: PlanesKind) -> Identity:
        """The identity with the program and the versions of this process."""
        return cls(scenario, scenario_sha256, guess, planes, program(), versions())


_CHANGED = {
    "scenario_sha256": "the scenario changed",
    "guess": "their initial guess differs",
    "planes": "planes are known in one study and found in the other",
    "program": "icalib changed",
    "versions": "Python or a library changed",
}


class RunStore:
    """Records of runs by seed in a folder. Raises CalibrationError if the folder has runs of another study, or cannot
    be written."""

    def __init__(self, folder: Path, identity: Identity) -> None:
        self.folder, self.identity = folder, identity
        with writing(folder):
            (folder / RUNS).mkdir(parents=True, exist_ok=True)
            if (folder / STUDY).exists():
                self._check()
            else:
                write_atomically(folder / STUDY, json.dumps(asdict(identity), indent=1).encode())

    def __contains__(self, seed: int) -> bool:
        return self._file(seed).exists()

    def add(self, record: RunRecord) -> None:
        """Stores a record. Raises CalibrationError if the worker ran another icalib, or the file cannot be written."""
        check_worker(record.program, self.identity.program)
        write_atomically(self._file(record.seed), to_json(record))

    def read(self, seed: int) -> RunRecord:
        """The stored record of a seed. Raises CalibrationError if its file is damaged or missing."""
        path = self._file(seed)
        try:
            return from_json(path.read_bytes())
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise CalibrationError(f"{path} is damaged; delete it to make the run again.") from error

    def _file(self, seed: int) -> Path:
        return self.folder / RUNS / f"{seed:06d}.json"

    def _check(self) -> None:
        path = self.folder / STUDY
        try:
            identity = json.loads(path.read_bytes())
            changed = [words for name, words in _CHANGED.items() if identity[name] != getattr(self.identity, name)]
        except (ValueError, KeyError, TypeError) as error:
            raise CalibrationError(f"{path} is damaged; choose another folder.") from error
        if changed:
            why = ", ".join(changed)
            raise CalibrationError(
                f"{self.folder} holds runs of another study ({why}); choose another folder, or delete it."
            )
