"""Fixed values of wheels that no vehicle has: they are named without a solve that cannot end, and priors give way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.consistency.recordings import mocap, reporting, without_imu
from tests.remarks import names
from tests.typed import not_none

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.initialize import rig_guess
from icalib.pipeline import calibrate_measurements
from icalib.rig import Parameter, Rig
from icalib.tools.simulation import Scenario, rig_for, simulate

SECONDS, SEED = 15.0, 1


@pytest.fixture
def solved(monkeypatch) -> list[Rig]:
    """The rigs of all estimates that are made."""
    rigs: list[Rig] = []

    def noting(inputs, *others, **more):
        rigs.append(inputs.rig)
        return determine(inputs, *others, **more)

    determine = rig_guess.determine
    monkeypatch.setattr(rig_guess, "determine", noting)
    return rigs


def measured(scenario: Scenario, imu: bool) -> tuple[Rig, Measurements, Rig]:
    """The rig from nothing, what it measured, and the rig at its true values."""
    truth = rig_for(scenario, time_offset="free", others="fixed")
    if not imu:
        rig, measurements, _ = without_imu(scenario, SEED)
        return rig, measurements, truth
    return rig_for(scenario), simulate(scenario, SEED).measurements, truth


def with_value(rig: Rig, name: str, value: np.ndarray, sigma: float | None = None) -> Rig:
    own = Parameter("fixed", value) if sigma is None else Parameter("prior", value, np.full(value.shape, sigma))
    return rig.with_(wheels=(replace(rig.wheels[0], **{name: own}),))


def drive(robot, kind: str) -> tuple[Scenario, bool]:
    """A robot by what shows its motion, and whether it has an IMU; or by what its wheels report."""
    if kind == "mocap":
        scenario = robot("planar", SECONDS, "w").with_sensors(mocap())
        return replace(scenario, motion=replace(scenario.motion, seed=3)), False
    if kind in ("twist", "steering"):
        return reporting(robot("ramp", SECONDS, "cw"), kind), True
    return robot("ramp", SECONDS, kind), True


ABSURD = {
    "baseline in mm": ("cw", "baseline", 1e3, "It looks like millimetres"),
    "baseline in inches": ("cw", "baseline", 1.0 / 0.0254, "It looks like inches"),
    "diameter": ("cw", "radii", 2.0, "It looks like a diameter"),
    "rates in rpm": ("cw", "radii", 30.0 / np.pi, "Its readings look like rpm"),
    "lever arm in mm": ("cw", "translation", 1e3, "It looks like millimetres"),
    "without IMU": ("mocap", "radii", 1e3, "It looks like millimetres"),
    "wheelbase in cm": ("steering", "wheelbase", 1e2, "It looks like centimetres"),
    "speed in km/h": ("twist", "scales", 3.6, ""),
}


@pytest.mark.parametrize("case", ABSURD)
def test_what_cannot_be_is_named_before_it_is_solved(robot, solved, case):
    kind, name, times, hint = ABSURD[case]
    rig, measurements, truth = measured(*drive(robot, kind))
    wrong = times * getattr(truth.wheels[0], name).value
    with pytest.raises(EstimationError) as error:
        calibrate_measurements(with_value(rig, name, wrong), measurements)
    words = str(error.value)
    assert words.startswith(f"the fixed value of {name}") and " of wheel0, " in words
    assert "contradicts the data" in words and hint in words and words.count("contradicts") == 1
    assert len(solved) == 1 and getattr(solved[0].wheels[0], name).mode == "free"


def test_all_that_cannot_be_is_named(robot, solved):
    rig, measurements, truth = measured(*drive(robot, "cw"))
    for name in ("baseline", "radii"):
        rig = with_value(rig, name, 1e3 * getattr(truth.wheels[0], name).value)
    with pytest.raises(EstimationError, match="of radii left of wheel0.*metres. Besides, .*of baseline of wheel0"):
        calibrate_measurements(rig, measurements)
    assert len(solved) == 1


@pytest.mark.parametrize(("times", "named"), [(1.0, False), (1.3, True)])
def test_what_is_merely_wrong_is_estimated_with_it(robot, solved, times, named):
    rig, measurements, truth = measured(*drive(robot, "cw"))
    rig = with_value(rig, "baseline", times * truth.wheels[0].baseline.value)
    result = calibrate_measurements(rig, measurements)
    assert solved[0].wheels[0].baseline.mode == "fixed"
    assert ("fixed_value_contradicted" in names(result.warnings)) == named


def test_a_prior_that_is_far_off_gives_way(robot):
    """The radii do not end up on the other side of zero, from where nothing leads back."""
    rig, measurements, truth = measured(*drive(robot, "cw"))
    true = not_none(truth.wheels[0].radii.value)
    result = calibrate_measurements(with_value(rig, "radii", 10.0 * true, 1e-3), measurements)
    (words,) = [w for w in result.warnings if w.name == "prior_contradicted" and "radii" in w]
    shown = float(words.split("alone show ")[1].split(" +- ")[0])
    assert result.converged and min(abs(shown - 1e3 * r) for r in not_none(true)) < 2.0
