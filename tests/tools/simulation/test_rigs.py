"""The rig of a simulated recording, the ready scenarios, and what simulation may import."""

import ast
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.typed import not_none

import icalib.tools.simulation
from icalib.rig import Parameter, Settings, Wheels
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import (
    ADIS16448,
    GuessError,
    handheld,
    load_scenario,
    rig_for,
    settings_for,
    simulate,
    with_drawn_guess,
)

EXAMPLES = Path(__file__).parents[3] / "examples" / "paper"
ALLOWED = (
    "icalib.base",
    "icalib.data.measurements",
    "icalib.errors",
    "icalib.geometry.targets",
    "icalib.kinds",
    "icalib.rig",
    "icalib.sensors.camera.spec",
    "icalib.sensors.fields",
    "icalib.sensors.imu.spec",
    "icalib.sensors.sensor",
    "icalib.sensors.stream",
    "icalib.tools.simulation",
)


def test_rig_states_truth_and_noise():
    scenario = handheld(imu="noisy", noiseless=True)
    prior = Parameter("prior", np.zeros(3), np.full(3, 0.1))
    rig = rig_for(scenario, translation=prior, time_offset="start", bloom="fixed")
    cam0, truth = rig.cameras[0], scenario.cameras[0]
    assert (
        not_none(rig.imu).noise.gyro == 10.0 * ADIS16448.gyro
        and not_none(rig.imu).noise.accel_walk == 10.0 * ADIS16448.accel_walk
    )
    assert (
        cam0.corner_noise_px == 0.2 and rig.gravity == 9.81 and rig.target == replace(scenario.target, size_sigma=0.0)
    )
    assert cam0.rotation == Parameter("free")
    assert cam0.translation is prior
    assert cam0.time_offset.mode == "free" and cam0.time_offset.value == pytest.approx([0.0042])
    assert cam0.bloom.mode == "fixed" and cam0.bloom.value == [0.0]
    assert cam0.intrinsics.mode == "fixed"
    np.testing.assert_array_equal(cam0.intrinsics.value, truth.intrinsics)
    np.testing.assert_array_equal(cam0.distortion.value, truth.distortion)
    np.testing.assert_array_equal(not_none(rig.imu).intrinsics.value, np.zeros(24))


def test_cameras_of_a_room_track_images_where_there_are_no_tables_of_tracks():
    scenario = load_scenario(EXAMPLES / "table2-3d.yaml")
    assert rig_for(scenario).cameras[0].tracks == "cam0/tracks.csv"
    assert {c.tracks for c in rig_for(replace(scenario, features=None)).cameras} == {"images"}
    assert rig_for(replace(scenario, features=None, board=True)).cameras[0].tracks is None


def test_a_rig_that_is_told_nothing_of_slip_allows_for_what_real_wheels_may_have():
    scenario = load_scenario(EXAMPLES / "table2-ramp.yaml")
    for told, expected in ((None, Wheels.lateral_slip), (1e-4, 1e-4)):
        wheels = tuple(replace(w, allowed_slip=told) for w in scenario.of(SimWheels))
        (found,) = rig_for(scenario.with_sensors(*wheels)).wheels
        assert (found.lateral_slip, found.vertical_slip) == (expected, expected)


def test_settings_model_what_is_simulated():
    plain = settings_for(handheld())
    assert (plain.bloom, plain.board_shape, plain.blur_noise, plain.common_error, plain.outlier_std > 0.0) == (
        False,
    ) * 5
    scenario = replace(handheld(), bow=(1e-3, 0.0, 0.0), blur_s=1e-3, shift_px=0.1, outlier_fraction=0.01)
    scenario = replace(scenario, cameras=(replace(scenario.cameras[0], bloom_px=0.3), scenario.cameras[1]))
    full = settings_for(scenario)
    assert (full.bloom, full.board_shape, full.blur_noise, full.common_error, full.outlier_std > 0.0) == (True,) * 5
    chosen = Settings(scheme="pose")
    assert rig_for(scenario, settings=chosen).settings is chosen


def test_asynchronous_cameras_are_half_a_period_apart():
    for asynchronous, apart in ((False, 0.0), (True, 0.025)):
        truth = simulate(handheld(duration_s=1.0, asynchronous=asynchronous), seed=1).truth
        assert truth.corners["cam1"].seconds[0] - truth.corners["cam0"].seconds[0] == pytest.approx(apart, abs=2e-9)


def test_simulation_imports_nothing_that_it_is_to_check():
    for path in Path(icalib.tools.simulation.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            for name in names:
                allowed = name == "icalib.sensors" or name.startswith(ALLOWED)  # the list of kinds
                assert not name.startswith("icalib") or allowed, f"{path.name} imports {name}"


def test_guesses_are_drawn_about_the_truth_with_the_given_spread():
    scenario = handheld()
    error = GuessError(rotation=0.1, translation=0.2, time_offset=0.3, relative=0.04)
    found = {"turn": [], "move": [], "offset": [], "focal": []}
    for seed in range(400):
        cam0, truth = with_drawn_guess(rig_for(scenario), scenario, seed, error).cameras[0], scenario.cameras[0]
        turn = truth.T_imu_sensor[:3, :3].T @ cam0.rotation.value
        found["turn"] += Rotation.from_matrix(turn).as_rotvec().tolist()
        found["move"] += (cam0.translation.value - truth.T_imu_sensor[:3, 3]).tolist()
        found["offset"] += (not_none(cam0.time_offset.value) - truth.time_offset_s).tolist()
        drawn = with_drawn_guess(rig_for(scenario, intrinsics="free"), scenario, seed, error).cameras[0].intrinsics
        found["focal"].append(not_none(drawn.value)[0] / truth.intrinsics[0] - 1.0)
        assert not_none(drawn.value)[1] / truth.intrinsics[1] == pytest.approx(
            not_none(drawn.value)[0] / truth.intrinsics[0]
        )
    sizes = {name: float(np.std(values)) for name, values in found.items()}
    assert sizes == pytest.approx({"turn": 0.1, "move": 0.2, "offset": 0.3, "focal": 0.04}, rel=0.1)


def test_guesses_are_of_what_is_free_and_the_same_for_a_seed():
    scenario = handheld()
    rig = rig_for(scenario, translation="fixed", distortion="free")
    first, second = (with_drawn_guess(rig, scenario, 3).cameras[1] for _ in range(2))
    assert (
        first.rotation.mode == "free"
        and not_none(first.rotation.value).tolist() == not_none(second.rotation.value).tolist()
    )
    assert first.translation is rig.cameras[1].translation and first.intrinsics is rig.cameras[1].intrinsics
    assert first.distortion.value is None
    other = with_drawn_guess(rig, scenario, 4).cameras[1]
    assert first.time_offset.value != other.time_offset.value
