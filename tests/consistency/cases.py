"""What the tables of this folder are made of: a case is a recording, the rig file that it is calibrated with, and all
that must hold of the one result: values, standard deviations, verdicts, reasons and notes.

A check is a function of a run; those with a bound or a name in them are made by a function, as `known(10)`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pytest
from tests.remarks import names
from tests.typed import not_none

from icalib.data.measurements import Measurements
from icalib.errors import CalibrationError
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.result.verdict import UNUSABLE
from icalib.rig import Rig
from icalib.sensors.sensor import CLOCK_RATE
from icalib.tools.montecarlo.record import error, true_value
from icalib.tools.simulation import Simulation, rig_for

MOST_SIGMA = 4.0
LENS = ("intrinsics", "distortion")


@dataclass(frozen=True, eq=False)
class Run:
    simulation: Simulation
    rig: Rig
    result: Calibration


Check = Callable[[Run], None]


def stated(simulation: Simulation) -> Rig:
    """Lenses are known, of all else there is no guess."""
    return rig_for(simulation.scenario)


def measured(simulation: Simulation) -> Measurements:
    return simulation.measurements


def planes_found(simulation: Simulation) -> Measurements:
    """Of no LiDAR point it is known which plane it lies on."""
    return simulation.measurements.unassociated()


def no_imu(simulation: Simulation) -> Measurements:
    return simulation.measurements.without("imu0")


@dataclass(frozen=True, eq=False)
class Case:
    """recording: simulates it. seen: what of it is calibrated. refused: a part of the sentence of the error with which
    the calibration ends; empty if it does not. full: not run by continuous integration."""

    recording: Callable[[], Simulation]
    checks: Sequence[Check] = ()
    rig: Callable[[Simulation], Rig] = stated
    seen: Callable[[Simulation], Measurements] = measured
    refused: str = ""
    full: bool = False

    def verify(self) -> None:
        simulation = self.recording()
        rig, measurements = self.rig(simulation), self.seen(simulation)
        if self.refused:
            with pytest.raises(CalibrationError, match=self.refused):
                calibrate_measurements(rig, measurements)
            return
        result = calibrate_measurements(rig, measurements)
        assert result.converged, result.status
        for check in self.checks:
            check(Run(simulation, rig, result))


def parameters(cases: dict[str, Case]) -> list[Any]:
    """The cases by name, as pytest's parameters."""
    return [pytest.param(case, id=name, marks=pytest.mark.full if case.full else ()) for name, case in cases.items()]


class Compared(NamedTuple):
    """A group of parameters beside the truth; std: formal standard deviations."""

    sensor: str
    name: str
    error: np.ndarray
    true: np.ndarray
    std: np.ndarray
    is_known: np.ndarray


def compared(run: Run) -> Iterator[Compared]:
    """All groups that are estimated and have a truth."""
    for g in run.result.groups:
        true = truth_of(run, g.sensor, g.name)
        if g.columns is not None and true is not None:
            is_known = np.array([v not in UNUSABLE for v in g.verdict])
            yield Compared(g.sensor, g.name, error(g.name, g.value, true), true, g.std_formal, is_known)


def truth_of(run: Run, sensor: str, name: str) -> np.ndarray | None:
    """The true value of a group, in the frame and on the clock of the reference sensor."""
    truth, true = run.simulation.truth, true_value(run.simulation.truth, sensor, name)
    if true is None or run.result.imu is not None:
        return true
    T, offset = truth.T_imu_sensor[run.result.reference], truth.time_offset[run.result.reference]
    if name == "rotation":
        return T[:3, :3].T @ true
    if name == "translation":
        return T[:3, :3].T @ (true - T[:3, 3])
    return true - offset if name == "time_offset" else true


# Values and standard deviations.


def known(count: int | None = None) -> Check:
    """All that is called known is off by less than four standard deviations. count: of the numbers compared, but for
    rates of clocks."""

    def check(run: Run) -> None:
        found = list(compared(run))
        far = [c for c in found if (np.abs(c.error) > MOST_SIGMA * c.std)[c.is_known].any()]
        assert not far, far
        assert count in (None, sum(len(c.error) for c in found if c.name != CLOCK_RATE.name))

    return check


SI = {CLOCK_RATE.name: 1e6}  # ppm


def exact(bound: float, lens: float = 0.0, least: float = 1e-9) -> Check:
    """All errors are below `bound` [rad, m, s]; those of lenses below `lens` times the true value, or `least`."""

    def check(run: Run) -> None:
        for c in compared(run):
            most = np.maximum(lens * np.abs(c.true), least) if c.name in LENS else bound * SI.get(c.name, 1.0)
            assert (np.abs(c.error) < most).all(), c

    return check


def std_below(group: str, most: float) -> Check:
    """Formal standard deviations of a group such as "wheel0.radii"."""

    def check(run: Run) -> None:
        assert run.result.group(*group.split(".")).std_formal.max() < most

    return check


def off_below(group: str, most: float) -> Check:
    """The length of a group's error."""

    def check(run: Run) -> None:
        (c,) = (c for c in compared(run) if f"{c.sensor}.{c.name}" == group)
        assert np.linalg.norm(c.error) < most, c

    return check


# Verdicts.


def verdicts(result: Calibration, name: str) -> set[str]:
    """Of a group such as "cam0.rotation", or of one component such as "cam0.rotation.x"."""
    sensor, group, *label = name.split(".")
    g = result.group(sensor, group)
    return {v for own, v in zip(g.labels, g.verdict, strict=True) if not label or own == label[0]}


def have(verdict: str, *names: str) -> Check:
    def check(run: Run) -> None:
        assert {name: verdicts(run.result, name) for name in names} == {name: {verdict} for name in names}

    return check


def leaves_open(*names: str) -> Check:
    """These components are unobservable, and a sentence says so of each."""

    def check(run: Run) -> None:
        have("unobservable", *names)(run)
        words = " ".join(run.result.unobservable)
        assert all(name.replace(".", " ").replace("_", " ") in words.replace("_", " ") for name in names), words

    return check


def leaves_nothing_open(run: Run) -> None:
    assert run.result.unobservable == ()


def is_usable(run: Run) -> None:
    assert run.result.verdict != "not usable", run.result.reasons


def body_is(name: str) -> Check:
    def check(run: Run) -> None:
        assert run.result.body == name

    return check


# Words.


def reason(name: str, pattern: str = "") -> Check:
    """The first reason has this identifier, and its text matches."""

    def check(run: Run) -> None:
        assert names(run.result.reasons)[:1] == [name] and re.search(pattern, run.result.reasons[0]), run.result.reasons

    return check


def has_no_reason(run: Run) -> None:
    assert run.result.reasons == ()


def warns(name: str, times: int = 1) -> Check:
    """So many warnings have this identifier."""

    def check(run: Run) -> None:
        assert names(run.result.warnings).count(name) == times, run.result.warnings

    return check


def notes(name: str) -> Check:
    def check(run: Run) -> None:
        assert name in names(run.result.notes), run.result.notes

    return check


def is_silent_on(name: str) -> Check:
    def check(run: Run) -> None:
        assert name not in names((*run.result.warnings, *run.result.notes))

    return check


# The solver.


def steps_below(most: int) -> Check:
    """Of all last passes together: the solver does not creep along a valley."""

    def check(run: Run) -> None:
        assert sum(i.stage == "final" for i in run.result.iterations) < most

    return check


def fits(kind: str, least: float, most: float, sensor: str | None = None) -> Check:
    """chi^2 per degree of freedom of all measurements of a kind."""

    def check(run: Run) -> None:
        ratios = [f.chi2 / f.dof for f in run.result.fits if f.kind == kind and sensor in (None, f.sensor)]
        assert ratios and all(least < r < most for r in ratios), ratios

    return check


# A flat floor, where heights are at the guess.


def heights_at_the_guess(run: Run) -> None:
    """Along the axis that the robot turns about nothing is known, and all stays where the rig's guess has it."""
    up = run.simulation.truth.R_world_imu[0, 2]
    for sensor in (*run.rig.cameras, *run.rig.lidars, *run.rig.wheels):
        g = run.result.group(sensor.name, "translation")
        assert g.verdict[2] == "unobservable" and g.verdict[0] not in UNUSABLE, f"{sensor.name} {g.verdict}"
        moved = (g.value - not_none(sensor.translation.value)) @ up
        assert abs(moved) < 5e-3, f"{sensor.name} {moved}"


def roll_at_the_guess(run: Run) -> None:
    for wheels in run.rig.wheels:
        g = run.result.group(wheels.name, "rotation")
        assert g.verdict[0] == "unobservable" and not {*UNUSABLE} & {*g.verdict[1:]}, g.verdict
        assert abs(error("rotation", g.value, not_none(wheels.rotation.value))[0]) < np.deg2rad(0.5)
