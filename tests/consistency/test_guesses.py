"""Guesses carry no weight: whatever the rig file guesses, the result is that of none, and a wrong guess is noted."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from icalib.errors import CalibrationError
from icalib.geometry import so3
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Camera, Parameter, Rig
from icalib.tools.simulation import Simulation, handheld, rig_for, simulate

OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # R_link_optical
SIGMAS = 5.0


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(handheld(12.0), 2)


def guessed(rig: Rig, **values: np.ndarray) -> Rig:
    """The rig with guesses of its first camera."""
    own = {name: Parameter("free", np.asarray(value, dtype=np.float64)) for name, value in values.items()}
    return rig.with_(cameras=(replace(rig.cameras[0], **own), *rig.cameras[1:]))


def true_camera(simulation: Simulation) -> Camera:
    return rig_for(simulation.scenario, rotation="fixed", translation="fixed", time_offset="fixed").cameras[0]


def value(camera: Camera, name: str) -> np.ndarray:
    found = getattr(camera, name).value
    assert found is not None
    return found


def worst(result: Calibration, truth: Camera) -> float:
    """The largest error of the camera, in its standard deviations."""
    errors = []
    for g in result.groups:
        if g.sensor == truth.name and g.name in ("rotation", "translation", "time_offset", "intrinsics", "distortion"):
            true = value(truth, g.name)
            off = so3.log(np.ascontiguousarray(true.T @ g.value)) if g.name == "rotation" else g.value - true
            errors.append(np.abs(off / g.std).max())
    return float(max(errors))


def noted(result: Calibration) -> list[str]:
    return [w for w in result.notes if w.name == "guess_contradicted"]


def wrong_guesses(camera: Camera) -> dict[str, tuple[dict[str, np.ndarray], str]]:
    """By kind: what is guessed, and words of the note."""
    R, p, t = (value(camera, name) for name in ("rotation", "translation", "time_offset"))
    lens, bent = value(camera, "intrinsics"), value(camera, "distortion")
    return {
        "inverse": ({"rotation": R.T, "translation": -R.T @ p}, "looks like the inverse, as in Kalibr's T_cam_imu"),
        "link": ({"rotation": R @ OPTICAL.T}, "frame whose axes are named otherwise"),
        "seconds": ({"time_offset": t - 3.0}, "time offset of cam0 is 3000 ms from what the data show"),
        "milliseconds": ({"time_offset": 1e3 * t}, "looks like milliseconds"),
        "millimetres": ({"translation": 1e3 * p}, "looks like millimetres"),
        "half": ({"intrinsics": lens * [0.5, 0.5, 1.0, 1.0]}, "focal length is 2 times that"),
        "double": ({"intrinsics": 2.0 * lens, "distortion": bent}, "focal length is 0.5 times that"),
        "undistorted": (
            {"intrinsics": lens, "distortion": 0.0 * bent},
            "the guess of distortion of cam0, [-0, 0,",
        ),
    }


# Kinds that are guessed wrongly at once, of different parameters.
TOGETHER = [("inverse", "seconds", "half"), ("link", "millimetres", "milliseconds", "double"), ("undistorted",)]


@pytest.mark.parametrize("kinds", TOGETHER, ids=" ".join)
def test_wrong_guesses_are_replaced_and_noted(simulation, kinds):
    truth, values = true_camera(simulation), {}
    wrong = wrong_guesses(truth)
    for kind in kinds:
        values |= wrong[kind][0]
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    result = calibrate_measurements(guessed(rig, **values), simulation.measurements)
    assert result.converged and worst(result, truth) < SIGMAS
    assert len(noted(result)) == len(kinds), noted(result)
    assert all(any(wrong[kind][1] in note for note in noted(result)) for kind in kinds), noted(result)


def test_each_kind_is_guessed(simulation):
    assert {kind for kinds in TOGETHER for kind in kinds} == {*wrong_guesses(true_camera(simulation))}


def test_good_guesses_are_no_news(simulation):
    rig = rig_for(simulation.scenario, rotation="start", translation="start", time_offset="start", intrinsics="start")
    result = calibrate_measurements(rig, simulation.measurements)
    assert result.converged and noted(result) == []


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("rotation", r"rotation of cam0 .* alone show 17\d deg .* the inverse"),
        pytest.param("translation", "translation . of cam0, -.*millimetres", marks=pytest.mark.full),
        ("time_offset", "time offset of cam0, 504.2 ms, .* alone show 4\\.(199|2)"),
        pytest.param("intrinsics", "intrinsics .. of cam0, .* of another size", marks=pytest.mark.full),
    ],
)
def test_a_fixed_value_with_which_nothing_fits_is_named(simulation, name, words):
    """In a sentence, where nothing can be estimated with it, or as the first warning."""
    true = value(true_camera(simulation), name)
    wrong = {"rotation": true.T, "translation": 1e3 * true, "time_offset": true + 0.5}.get(name, 0.5 * true)
    rig = rig_for(simulation.scenario)
    camera = replace(rig.cameras[0], **{name: Parameter("fixed", wrong)})
    try:
        said = calibrate_measurements(rig.with_(cameras=(camera, *rig.cameras[1:])), simulation.measurements).wrong[0]
    except CalibrationError as error:
        said = str(error)
    assert re.search(f"the fixed value of {words}", said), said


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.full) for k in range(1, 8))])
def test_wild_guesses(simulation, seed):
    """Of any of the parameters, of any size: from an angle to 1e6 times what is true."""
    rng, truth = np.random.default_rng(seed), true_camera(simulation)
    wild = {}
    for name in ("rotation", "translation", "time_offset", "intrinsics", "distortion"):
        true = value(truth, name)
        if rng.random() < 0.7:
            sizes = 10.0 ** rng.uniform(-3.0, 6.0, true.shape) * rng.choice((-1.0, 1.0), true.shape)
            wild[name] = so3.exp(3.0 * rng.standard_normal(3)) if name == "rotation" else true * sizes
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    result = calibrate_measurements(guessed(rig, **wild), simulation.measurements)
    assert result.converged and worst(result, truth) < SIGMAS
