"""Motion that leaves something open: what is open is said, held where the guess has it, and the rest is right."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.rig import Parameter, Rig
from icalib.tools.simulation import Scenario, Simulation, handheld, rig_for, simulate

ROTATION_RAD, TRANSLATION_M, OFFSET_S = 0.087, 0.05, 0.02  # of a guess
MOST_SIGMA = 4.0
ImuQuality = Literal["datasheet", "noisy"]


def moving(kind: str, imu: ImuQuality = "datasheet") -> Scenario:
    scenario = handheld(20.0, imu=imu)
    return dataclasses.replace(scenario, motion=dataclasses.replace(scenario.motion, kind=kind))


def guessed(simulation: Simulation, seed: int, mode: str) -> Rig:
    """The rig with a guess drawn about the truth, as a prior or without a word on its size."""
    rng = np.random.default_rng([seed, 99])

    def parameter(value: np.ndarray, sigma: float) -> Parameter:
        if mode == "prior":
            return Parameter("prior", value, np.full(3 if value.ndim == 2 else len(value), sigma))
        return Parameter("free", value)

    rig, cameras = rig_for(simulation.scenario), []
    for camera in rig.cameras:
        T, offset = simulation.truth.T_imu_sensor[camera.name], simulation.truth.time_offset[camera.name]
        turn = Rotation.from_rotvec(ROTATION_RAD * rng.normal(size=3)).as_matrix()
        cameras.append(
            dataclasses.replace(
                camera,
                rotation=parameter(T[:3, :3] @ turn, ROTATION_RAD),
                translation=parameter(T[:3, 3] + TRANSLATION_M * rng.normal(size=3), TRANSLATION_M),
                time_offset=parameter(np.array([offset + OFFSET_S * rng.normal()]), OFFSET_S),
            )
        )
    return rig.with_(cameras=tuple(cameras))


def errors_in_sigma(result: Calibration, simulation: Simulation) -> dict[str, tuple[np.ndarray, tuple[str, ...]]]:
    """By block of a camera: errors over formal standard deviations, and verdicts."""
    found = {}
    for camera, T in simulation.truth.T_imu_sensor.items():
        R = result.group(camera, "rotation").value
        error = {
            "rotation": Rotation.from_matrix(T[:3, :3].T @ R).as_rotvec(),
            "translation": result.group(camera, "translation").value - T[:3, 3],
            "time_offset": result.group(camera, "time_offset").value - simulation.truth.time_offset[camera],
        }
        for name, e in error.items():
            g = result.group(camera, name)
            found[f"{camera}.{name}"] = e / g.std_formal, g.verdict
    return found


def axis_in_camera(simulation: Simulation, camera: str) -> np.ndarray:
    """The axis that the rig turned about, in imu axes."""
    R = simulation.truth.R_world_imu
    turns = Rotation.from_matrix(R[0].T @ R[::20]).as_rotvec()
    return np.linalg.svd(turns, full_matrices=False)[2][0]


def check(kind: str, imu: ImuQuality, seed: int, mode: str = "prior") -> None:
    simulation = simulate(moving(kind, imu), seed)
    rig = guessed(simulation, seed, mode)
    result = calibrate_measurements(rig, simulation.measurements)
    assert result.converged, result.status
    for block, (z, verdict) in errors_in_sigma(result, simulation).items():
        known = np.array([v in ("determined", "weak") for v in verdict])
        assert not known.any() or np.abs(z[known]).max() < MOST_SIGMA, f"seed {seed}: {block} {z} {verdict}"
    if kind != "motionless":
        check_lever_arm(result, simulation, rig)


def check_lever_arm(result: Calibration, simulation: Simulation, rig: Rig) -> None:
    """Open along the axis of rotation, alike for both cameras, and held there between the guesses."""
    axis = axis_in_camera(simulation, "cam0")
    assert any("translation" in sentence for sentence in result.unobservable)
    moved = []
    for camera in rig.cameras:
        group = result.group(camera.name, "translation")
        assert group.verdict[int(np.argmax(np.abs(axis)))] == "unobservable"
        moved.append((group.value - camera.translation.value) @ axis)
    # What the cameras see of each other is determined: only their common shift is held.
    assert abs(np.mean(moved)) < 1e-3


@pytest.mark.parametrize("mode", ["prior", "free"])
@pytest.mark.parametrize("kind", ["planar", "single_axis", "motionless"])
def test_what_is_open_is_said_and_the_rest_is_right(kind: str, mode: str):
    check(kind, "datasheet", 0, mode)


@pytest.mark.parametrize("kind", ["planar", "single_axis"])
def test_a_noisy_imu_does_not_make_it_up(kind: str):
    check(kind, "noisy", 1)


@pytest.mark.full
@pytest.mark.parametrize("imu", ["datasheet", "noisy"])
@pytest.mark.parametrize("kind", ["handheld", "planar", "single_axis", "motionless"])
def test_no_confident_wrong_number_in_a_hundred(kind: str, imu: ImuQuality):
    wrong = []
    for seed in range(100):
        simulation = simulate(moving(kind, imu), seed)
        result = calibrate_measurements(guessed(simulation, seed, "prior"), simulation.measurements)
        for block, (z, verdict) in errors_in_sigma(result, simulation).items():
            known = np.array([v in ("determined", "weak") for v in verdict])
            wrong += [(seed, block, x) for x in z[known & (np.abs(z) > MOST_SIGMA)]]
    assert not wrong


def test_free_motion_leaves_nothing_open():
    simulation = simulate(moving("handheld"), 0)
    result = calibrate_measurements(rig_for(simulation.scenario), simulation.measurements)
    assert not result.unobservable


def test_without_a_guess_a_single_axis_is_refused_with_the_missing_motion():
    simulation = simulate(moving("single_axis"), 0)
    with pytest.raises(
        EstimationError,
        match="turned about one axis only.*turn the rig about (the . and . axes of imu0|two axes perp.*) as well",
    ):
        calibrate_measurements(rig_for(simulation.scenario), simulation.measurements)


@pytest.fixture(scope="module")
def usual() -> tuple[Rig, Measurements, Calibration]:
    """A recording that determines everything, at the default tolerances."""
    simulation = simulate(handheld(10.0), 0)
    rig = rig_for(simulation.scenario, intrinsics="start")
    return rig, simulation.measurements, calibrate_measurements(rig, simulation.measurements)


@pytest.mark.parametrize(
    ("setting", "group", "unit"),
    [
        ("rotation_tolerance_deg", "rotation", 180.0 / np.pi),
        ("translation_tolerance_m", "translation", 1.0),
        ("time_tolerance_s", "time_offset", 1.0),
        ("pixel_tolerance", "intrinsics", 1.0),
    ],
)
def test_a_tighter_tolerance_makes_a_parameter_weak(
    usual: tuple[Rig, Measurements, Calibration], setting: str, group: str, unit: float
):
    rig, measurements, known = usual
    std = known.group("cam0", group).std_formal
    settings = dataclasses.replace(rig.settings, **{setting: unit * 0.4 * float(std.max())})
    strict = calibrate_measurements(dataclasses.replace(rig, settings=settings), measurements)
    for name in ("rotation", "translation", "time_offset", "intrinsics"):
        assert set(known.group("cam0", name).verdict) == {"determined"}
        assert ("weak" in strict.group("cam0", name).verdict) == (name == group)
    np.testing.assert_allclose(strict.group("cam0", group).std_formal, std, rtol=0.02)
