"""Guesses of wheels, pose sensors and LiDARs carry no weight, and none of them ends in anything but a sentence."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest

from icalib.errors import CalibrationError
from icalib.estimate.inputs import Inputs
from icalib.geometry import so3
from icalib.initialize.rig_guess import guess_of_rig
from icalib.optim.state import State
from icalib.pipeline import calibrate_measurements
from icalib.rig import Camera, Lidar, Parameter, PoseSensor, Rig, Wheels
from icalib.sensors.pose.simulate import SimPoses
from icalib.tools.simulation import Simulation, rig_for, simulate

OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
ON_TOP = np.array([[1.0, 0.0, 0.0, 0.1], [0.0, 0.0, -1.0, 0.2], [0.0, 1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]])
STARTS: dict[str, Any] = dict.fromkeys(("rotation", "translation", "time_offset", "radii", "baseline"), "start")
Sensor = Camera | Lidar | Wheels | PoseSensor
KINDS = ("cameras", "lidars", "wheels", "poses")


@pytest.fixture(scope="module")
def simulation(robot) -> Simulation:
    scenario = robot("ramp", 12.0, "cw")
    return simulate(scenario.with_sensors(SimPoses("mocap", ON_TOP, rate_hz=50.0, time_offset_s=0.01)), 1)


def group(sensor: Sensor, name: str) -> np.ndarray:
    found = getattr(sensor, name).value
    assert found is not None
    return found


def with_guesses(rig: Rig, kind: str, guesses: dict[str, np.ndarray]) -> Rig:
    """The rig with guesses of its first sensor of a kind."""
    first = getattr(rig, kind)[0]
    own = {name: Parameter("free", np.asarray(value, dtype=np.float64)) for name, value in guesses.items()}
    return rig.with_sensors(replace(first, **own))


def wrong(sensor: Sensor, what: str) -> dict[str, np.ndarray]:
    R, p, t = (group(sensor, name) for name in ("rotation", "translation", "time_offset"))
    if what == "inverse":
        return {"rotation": R.T, "translation": -R.T @ p}
    if what == "link":
        return {"rotation": R @ OPTICAL}
    if what == "millimetres":
        return {
            name: 1e3 * group(sensor, name) for name in ("translation", "radii", "baseline") if hasattr(sensor, name)
        }
    return {"time_offset": t + {"seconds": 3.0, "hours": 7200.0}[what]}


IN_CI = {("wheels", "millimetres"), ("poses", "seconds")}
WRONG = list(product(("wheels", "poses"), ("inverse", "link", "millimetres", "seconds", "hours")))


@pytest.mark.parametrize(
    ("kind", "what"), [pytest.param(*x, marks=() if x in IN_CI else pytest.mark.full) for x in WRONG]
)
def test_a_wrong_guess_is_replaced(simulation, kind, what):
    rig = rig_for(simulation.scenario, **STARTS)
    sensor = getattr(rig, kind)[0]
    result = calibrate_measurements(with_guesses(rig, kind, wrong(sensor, what)), simulation.measurements)
    assert result.converged
    for g in result.groups:
        if g.sensor == sensor.name and g.columns is not None:
            true = group(sensor, g.name)
            off = so3.log(np.ascontiguousarray(true.T @ g.value)) if g.name == "rotation" else g.value - true
            assert np.abs(off / g.std).max() < 5.0, g.name
    noted = [w for w in result.notes if w.name == "guess_contradicted"]
    assert all(f" of {sensor.name}" in w for w in noted)
    assert noted or (kind, what) == ("wheels", "inverse")  # the turn of the wheels is nearly its own inverse


def drawn(rig: Rig, rng: np.random.Generator) -> Rig:
    """Guesses of some groups of all sensors, from a thousandth to a million times what is true."""
    for kind in KINDS:
        for sensor in getattr(rig, kind)[:1]:
            wild = {}
            for name, value in vars(sensor).items():
                if isinstance(value, Parameter) and value.value is not None and rng.random() < 0.6:
                    sizes = 10.0 ** rng.uniform(-3.0, 6.0, value.value.shape) * rng.choice(
                        (-1.0, 1.0), value.value.shape
                    )
                    true = value.value * sizes
                    wild[name] = so3.exp(3.0 * rng.standard_normal(3)) if name == "rotation" else true
            rig = with_guesses(rig, kind, wild)
    return rig


@pytest.mark.parametrize("seed", [*range(3), *(pytest.param(k, marks=pytest.mark.full) for k in range(3, 24))])
def test_no_guess_ends_the_first_guess_but_in_a_sentence(simulation, seed):
    rig = drawn(rig_for(simulation.scenario, **STARTS), np.random.default_rng(seed))
    try:
        inputs, state, _ = guess_of_rig(rig, [simulation.measurements])
    except CalibrationError as error:
        assert str(error).endswith(".")
        return
    assert isinstance(inputs, Inputs) and isinstance(state, State)
    assert all(np.isfinite(v).all() for v in state.values.values())


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.full) for k in (1, 2))])
def test_no_guess_spoils_the_calibration(simulation, seed):
    rig = rig_for(simulation.scenario, **STARTS)
    truth, result = rig, calibrate_measurements(drawn(rig, np.random.default_rng(seed)), simulation.measurements)
    assert result.converged
    for kind in ("cameras", "wheels", "poses"):
        sensor = getattr(truth, kind)[0]
        (g,) = [g for g in result.groups if g.sensor == sensor.name and g.name == "rotation"]
        off = so3.log(np.ascontiguousarray(group(sensor, "rotation").T @ g.value))
        assert np.abs(off / g.std).max() < 5.0, (kind, off)
