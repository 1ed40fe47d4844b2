"""One run: simulate, calibrate, compare with the truth. Exceptions become part of the record of the run.

Errors of a result, as the perturbations that its covariance describes. Whiteness of residuals: lag-one autocorrelation
of whitened residuals in time.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

import numpy as np

from icalib.geometry import so3
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration, Visited
from icalib.sensors.records import Successive
from icalib.tools.batch import program, sentence_on
from icalib.tools.montecarlo.record import GroupErrors, RunRecord, Size, Waypoint, Whiteness
from icalib.tools.simulation import Scenario, Truth, rig_for, simulate, with_drawn_guess

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
