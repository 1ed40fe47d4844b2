"""Cameras that follow points of the scene, without a target: truth recovered, and the covariance honest."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.typed import not_none

from icalib.data.measurements import Measurements, TrackStream
from icalib.estimate.inputs import inputs_for, origin_difference
from icalib.estimate.problem import assemble, keyframe_times, keyframes_for, resample
from icalib.estimate.solver import SolverOptions, minimise
from icalib.geometry.targets import NoTarget
from icalib.pipeline import calibrate_measurements
from icalib.rig import Parameter, Rig
from icalib.sensors.camera.initialize import initial_guesses, initial_state
from icalib.sensors.camera.model import MODEL
from icalib.tools.simulation import Scenario, load_scenario, rig_for, simulate, with_drawn_guess

SCENARIO = Path(__file__).parents[2] / "examples" / "paper" / "table2-3d.yaml"

CALIBRATED = ("rotation", "translation", "time_offset", "intrinsics", "distortion")
EXACT = 1e-7  # rad, m, s; relative for intrinsics


def table2(duration_s: float) -> Scenario:
    """IMU and three cameras of Table II that follow points of a room, alone."""
    return replace(load_scenario(SCENARIO), sensors=(), duration_s=duration_s)


def rig_of(scenario: Scenario, scale: float = 1.0) -> Rig:
    """No guess but intrinsics, focal lengths off by `scale`; the distortion free, from the truth."""
    rig = rig_for(scenario, intrinsics="start", distortion="start")
    cameras = []
    for camera in rig.cameras:
        guess = camera.intrinsics.value * np.array([scale, scale, 1.0, 1.0])
        cameras.append(replace(camera, intrinsics=Parameter("free", guess), track_noise_px=1.0))
    return rig.with_(target=NoTarget(), cameras=tuple(cameras))


def test_noiseless_tracks_are_recovered_from_nothing_but_rough_intrinsics():
    """In passes, each with keyframes and preintegration made anew from what the last one found."""
    scenario = table2(8.0)
    exact = {"imu_noise_enabled": False, "robot_noise_enabled": False}
    # At 1000 Hz the error of the interpolation between readings is that of rounding.
    scenario = replace(scenario, **exact, imu_rate_hz=1000.0, gyro_bias=(0.0,) * 3, accel_bias=(0.0,) * 3)
    simulation, rig = simulate(scenario, 1), rig_of(scenario, 1.03)
    inputs = inputs_for(rig, [simulation.measurements])
    state = initial_state(inputs, *initial_guesses(rig, inputs.bodies, [m.measurements for m in inputs.motions]))
    state = replace(state, bias=np.zeros_like(state.bias))  # the prior on the first biases then pulls nothing
    streams = inputs.measurements.cameras
    noise = MODEL.first_noise(rig.cameras, rig, inputs.measurements)
    last = None
    for _ in range(3):
        problem = assemble(inputs, state, noise, coarse=True)
        outcome = minimise(problem, state, SolverOptions(1e-10))
        assert outcome.converged, outcome.status
        last = problem, state, outcome
        state = outcome.state
        state = resample(state, keyframes_for(inputs, keyframe_times(inputs, state.values)), inputs)
    _is_the_same_in_its_own_room(*not_none(last))
    for camera, stream in zip(scenario.cameras, streams, strict=True):
        value, T = {name: state.values[camera.name, name] for name in CALIBRATED}, camera.T_imu_sensor
        offset = simulation.truth.time_offset[camera.name] + origin_difference(inputs.measurements, stream)
        assert Rotation.from_matrix(T[:3, :3].T @ value["rotation"]).magnitude() < EXACT
        assert np.abs(value["translation"] - T[:3, 3]).max() < EXACT
        assert abs(value["time_offset"][0] - offset) < EXACT
        assert value["intrinsics"] == pytest.approx(np.array(camera.intrinsics), rel=EXACT)
        assert np.abs(value["distortion"] - np.array(camera.distortion)).max() < EXACT


def _is_the_same_in_its_own_room(problem, state, outcome):
    """Solved once more in the pieces that the last solve left behind, to the last bit."""
    again = minimise(problem, state, SolverOptions(1e-10), outcome.workspace)
    assert again.workspace is outcome.workspace is not None
    np.testing.assert_array_equal(again.information, outcome.information)
    np.testing.assert_array_equal(again.state.position, outcome.state.position)


def check(consistency, duration_s: float, seeds: range, probability: float) -> None:
    scenario = table2(duration_s)
    found = consistency(scenario, rig_of(scenario, 1.02), seeds, probability)
    print({block: (round(c.mean, 3), round(c.low, 3), round(c.high, 3)) for block, c in found.items()})
    assert {block: c for block, c in found.items() if not c.consistent} == {}


def follower(scenario: Scenario, scale: float) -> Rig:
    """`rig_of`, with what users have by default against outliers; noise is found."""
    rig = rig_of(scenario, scale)
    cameras = tuple(replace(c, track_noise_px=None) for c in rig.cameras)
    return rig.with_(cameras=cameras, settings=replace(rig.settings, loss="huber", outlier_std=4.0))


def lost(measurements: Measurements) -> Measurements:
    """One observation of twenty is of something else, up to 30 px away on each axis."""
    rng = np.random.default_rng(5)
    return measurements.with_streams(*(_lost(t, rng) for t in measurements.tracks))


def _lost(stream: TrackStream, rng: np.random.Generator) -> TrackStream:
    uv, gone = stream.uv.copy(), rng.random(len(stream.uv)) < 0.05
    uv[gone] += rng.uniform(-30.0, 30.0, (int(gone.sum()), 2))
    return replace(stream, uv=uv)


@pytest.mark.parametrize("stated", [False, pytest.param(True, marks=pytest.mark.full)])
def test_outliers_are_set_aside_and_little_else(stated: bool):
    scenario = table2(8.0)
    rig = with_drawn_guess(follower(scenario, 1.0), scenario, 2)
    if stated:
        rig = rig.with_(cameras=tuple(replace(c, track_noise_px=1.0) for c in rig.cameras))
    measured = simulate(scenario, 2).measurements
    found = calibrate_measurements(rig, lost(measured))
    assert found.converged
    for r, true in zip(found.track_residuals, measured.tracks, strict=True):
        far = np.linalg.norm(r.uv - true.uv, axis=1) > 8.0
        assert far.sum() > 250
        assert not (far & r.used).any()
        good = (r.uv == true.uv).all(axis=1)
        assert r.rejected[good].mean() < 0.002 and r.used[good].mean() > 0.97
        fit = next(f for f in found.fits if f.sensor == r.sensor and f.kind == "features")
        assert r.sigma[0] == pytest.approx(1.0, abs=0.03) and fit.chi2_per_dof == pytest.approx(0.97, abs=0.05)


@pytest.mark.full
def test_many_recordings_with_outliers(consistency):
    scenario = table2(10.0)
    found = consistency(scenario, follower(scenario, 1.02), range(24), 0.99, seen=lost)
    print({block: (round(c.mean, 3), round(c.low, 3), round(c.high, 3)) for block, c in found.items()})
    assert {block: c for block, c in found.items() if not c.consistent} == {}


@pytest.mark.full
def test_a_few_recordings(consistency):
    check(consistency, 8.0, range(3), 0.9999)


@pytest.mark.full
def test_many_recordings(consistency):
    check(consistency, 10.0, range(24), 0.99)
