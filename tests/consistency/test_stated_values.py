"""Values that the rig file fixes or gives a prior: the data contradict some, which is said, and no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.remarks import names
from tests.typed import not_none

from icalib.geometry import so3
from icalib.geometry.targets import AprilGrid
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, Rig, drive_names
from icalib.tools.simulation import Simulation, handheld, rig_for, simulate

TURN = so3.exp(np.deg2rad([0.0, 1.5, 0.0]))


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(handheld(12.0), 2)


@pytest.fixture(scope="module")
def driven(robot) -> Simulation:
    return simulate(robot("ramp", 15.0, "cw"), 1)


def said(result: Calibration) -> list[str]:
    return [w for w in result.warnings if w.name in ("fixed_value_contradicted", "prior_contradicted")]


def stated(rig: Rig, name: str, value: np.ndarray, sigma: float | None = None) -> Rig:
    """The rig with a group of its first camera, or its wheels, fixed, or with a prior of the given sigma."""
    size = 3 if name == "rotation" else value.size
    own = Parameter("fixed", value) if sigma is None else Parameter("prior", value, np.full(size, sigma))
    if rig.wheels and hasattr(rig.wheels[0], name):
        return rig.with_(wheels=(replace(rig.wheels[0], **{name: own}), *rig.wheels[1:]))
    return rig.with_(cameras=(replace(rig.cameras[0], **{name: own}), *rig.cameras[1:]))


def truth(simulation: Simulation, name: str) -> np.ndarray:
    rig = rig_for(simulation.scenario, rotation="fixed", translation="fixed", time_offset="fixed", others="fixed")
    sensor = rig.wheels[0] if rig.wheels and name in drive_names(rig.wheels[0].kind) else rig.cameras[0]
    value = getattr(sensor, name).value
    assert value is not None
    return value


@pytest.mark.parametrize("mode", ["prior", pytest.param("fixed", marks=pytest.mark.full)])
def test_true_values_are_no_news(simulation, mode):
    """All of them at once; each prior is as wide as it may be, or narrow."""
    rig = rig_for(simulation.scenario)
    for name, sigma in (("rotation", 1e-3), ("translation", 0.5), ("time_offset", 1e-7), ("distortion", 1e-4)):
        value = rig.cameras[0].distortion.value if name == "distortion" else truth(simulation, name)
        rig = stated(rig, name, not_none(value), sigma if mode == "prior" else None)
    result = calibrate_measurements(rig, simulation.measurements)
    assert result.converged and said(result) == []


@pytest.mark.parametrize(
    ("name", "off", "sigma", "words"),
    [
        ("translation", [0.1, 0.0, 0.0], 3e-3, "the prior of translation x of cam0, "),
        pytest.param(
            "translation", [0.0, 0.0, 0.02], 1e-6, "the prior of translation z of cam0, ", marks=pytest.mark.full
        ),
        pytest.param(
            "translation", [0.0, -0.02, 0.0], None, "the fixed value of translation y of cam0, ", marks=pytest.mark.full
        ),
        ("time_offset", [2e-3], None, "the fixed value of time offset of cam0, "),
        pytest.param("time_offset", [0.02], 5e-4, "the prior of time offset of cam0, ", marks=pytest.mark.full),
        ("distortion", [0.02, 0.0, 0.0, 0.0], None, "the fixed value of distortion k1 of cam0, "),
    ],
)
def test_a_wrong_value_is_named_with_what_the_data_show(simulation, name, off, sigma, words):
    rig = rig_for(simulation.scenario)
    value = rig.cameras[0].distortion.value if name == "distortion" else truth(simulation, name)
    result = calibrate_measurements(stated(rig, name, value + off, sigma), simulation.measurements)
    assert result.converged and len(said(result)) == 1 and said(result)[0].startswith(words)
    k = int(np.argmax(np.abs(off)))
    scale = {"translation": 1e3, "time_offset": 1e3}.get(name, 1.0)
    shown, spread = said(result)[0].split("alone show ")[1].split(" standard")[0].split(":")[0].split(" +- ")
    assert abs(float(shown) - scale * not_none(value)[k]) < 5.0 * float(spread.split(" ")[0])
    assert float(spread.split(" ")[0]) < 0.1 * scale * abs(off[k])


@pytest.mark.parametrize("sigma", [None, pytest.param(1e-3, marks=pytest.mark.full)])
def test_a_wrong_rotation_is_named_and_nothing_else(simulation, sigma):
    """All else is moved by it, and true values beside it stand out until it is free."""
    rig = stated(rig_for(simulation.scenario), "translation", truth(simulation, "translation"))
    rig = stated(stated(rig, "time_offset", truth(simulation, "time_offset")), "rotation", np.eye(3))
    rig = stated(rig, "rotation", truth(simulation, "rotation") @ TURN, sigma)
    (words,) = said(calibrate_measurements(rig, simulation.measurements))
    assert "rotation of cam0" in words and "1.5 deg from it" in words, words


def test_true_wheels_are_no_news(driven):
    rig = rig_for(driven.scenario, radii="fixed", baseline="fixed")
    result = calibrate_measurements(rig, driven.measurements)
    assert result.converged and said(result) == []


def test_a_wrong_baseline_is_named(driven):
    rig = stated(rig_for(driven.scenario), "radii", truth(driven, "radii"))
    result = calibrate_measurements(stated(rig, "baseline", 1.03 * truth(driven, "baseline")), driven.measurements)
    assert [w[:47] for w in said(result)] == ["the fixed value of baseline of wheel0, 432.6 mm"]


def test_wheels_that_no_vehicle_has_are_named(driven):
    """Their rates are in rpm, and nothing in the rig file says otherwise."""
    fast = tuple(replace(s, rate=s.rate * 30.0 / np.pi) for s in driven.measurements.wheels)
    result = calibrate_measurements(rig_for(driven.scenario), driven.measurements.with_streams(*fast))
    words = [w for w in result.warnings if w.name == "wheel_sizes_implausible"]
    assert len(words) == 1 and "a radius of 10.6 mm and 420" in words[0] and "rate_unit" in words[0], words


def test_a_wrong_size_of_the_target_does_not_blame_true_lever_arms(simulation):
    rig = rig_for(simulation.scenario, rotation="fixed", translation="fixed", time_offset="fixed")
    result = calibrate_measurements(replace(rig, target=AprilGrid(6, 6, 1.08 * 0.088, 0.3)), simulation.measurements)
    assert said(result) == [] and names(result.wrong)[:1] == ["target_size_wrong"]
