"""What the rig file states wrongly is said: noise of the IMU, and cameras that are taken for one another."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter
from tests.remarks import named, names
from tests.typed import not_none

from icalib.base.remark import Remark
from icalib.data.measurements import Measurements
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.tools.simulation import Simulation, handheld, rig_for, simulate


@pytest.fixture(scope="module")
def simulation() -> Simulation:
    return simulate(handheld(20.0), 1)


def with_noise(simulation: Simulation, times: float) -> Calibration:
    """Calibrated with densities that are so many times the true ones."""
    rig = rig_for(simulation.scenario)
    noise = not_none(rig.imu).noise
    names = ("gyro", "gyro_walk", "accel", "accel_walk")
    wrong = replace(noise, **{name: times * getattr(noise, name) for name in names})
    return calibrate_measurements(rig.with_(imu=replace(not_none(rig.imu), noise=wrong)), simulation.measurements)


RESIDUALS = ("imu_residuals_small", "residuals_exceed_noise", "residuals_unexplained")


def said(result: Calibration) -> list[Remark]:
    """Warnings on the noise of the IMU."""
    return [w for w in result.warnings if w.name.startswith("imu_noise_") or w.name in RESIDUALS]


def advised(words: str) -> dict[str, float]:
    """The densities that a sentence advises."""
    return {name: float(value) for name, value in re.findall(r"(\w+): ([\d.e-]+)", words)}


def test_the_right_noise_is_no_news(simulation):
    assert said(with_noise(simulation, 1.0)) == []


@pytest.mark.parametrize("times", [10.0, pytest.param(3.0, marks=pytest.mark.full)])
def test_corner_noise_that_is_far_too_large_is_no_fault_of_the_imu(simulation, times):
    """Residuals of the IMU are then small, too, as the motion follows it."""
    rig = rig_for(simulation.scenario)
    true = zip(rig.cameras, simulation.scenario.cameras, strict=True)
    cameras = tuple(replace(c, corner_noise_px=times * s.corner_noise_px) for c, s in true)
    result = calibrate_measurements(rig.with_(cameras=cameras), simulation.measurements)
    assert said(result) == []
    size = f"{1.0 / times:.2g}x"
    assert f"cam0 {size} and cam1 {size}" in named("corner_noise_overstated", result.warnings)


@pytest.mark.parametrize("times", [0.05, *(pytest.param(x, marks=pytest.mark.full) for x in (0.2, 0.1, 0.01))])
def test_noise_that_is_far_too_small_is_said(simulation, times):
    """The motion then follows the IMU, and hardly any degrees of freedom are left to judge it by."""
    result = with_noise(simulation, times)
    (words,) = said(result)
    assert words.name == "imu_noise_understated" and result.reasons[0] == words
    # At 0.2 errors are up to 6 standard deviations, at 0.1 up to 12: then no number is to be trusted.
    assert result.wrong == ((words,) if times < 0.2 else ())


@pytest.mark.parametrize("times", [0.1, pytest.param(0.5, marks=pytest.mark.full)])
def test_noise_that_is_stated_too_small_is_that_of_the_readings(simulation, times):
    """To two fifths. Calibrated with it there is nothing left to say."""
    (words,) = said(with_noise(simulation, times))
    assert words.name == "imu_noise_understated" and set(advised(words)) == {"gyro", "gyro_walk", "accel", "accel_walk"}
    rig = rig_for(simulation.scenario)
    true, noise = not_none(rig.imu).noise, advised(words)
    assert 0.6 < noise["gyro"] / true.gyro < 1.5 and 0.6 < noise["accel"] / true.accel < 1.5
    rig = rig.with_(imu=replace(not_none(rig.imu), noise=replace(true, **noise)))
    assert said(calibrate_measurements(rig, simulation.measurements)) == []


@pytest.mark.full
def test_noise_that_is_stated_too_large_becomes_smaller_until_it_fits(simulation):
    """The motion follows the corners, whose noise is in the residuals, too: the first advice is on the safe side. No
    reading shows a walk, which stays as stated."""
    rig = rig_for(simulation.scenario)
    true = not_none(rig.imu).noise
    noise, rounds = true.scaled(10.0), 0
    while rounds < 4:
        wrong = rig.with_(imu=replace(not_none(rig.imu), noise=noise))
        words = [w for w in said(calibrate_measurements(wrong, simulation.measurements)) if "imu_noise" in w.name]
        if not words:
            break
        assert words[0].name == "imu_noise_overstated"
        noise, rounds = replace(noise, **advised(words[0])), rounds + 1
        assert noise.gyro_walk == pytest.approx(10.0 * true.gyro_walk, rel=0.05)
    assert rounds in (1, 2, 3)
    assert 0.6 < noise.gyro / true.gyro < 2.0 and 0.6 < noise.accel / true.accel < 2.0, noise


def test_vibration_is_noise_as_far_as_readings_show_it(simulation):
    """Correlated over 20 readings: the noise of the readings explains a part, and the cause of the rest is unknown."""
    m = simulation.measurements
    noise = np.random.default_rng(3).normal(size=m.imu.accel.shape)
    shaken = np.asarray(lfilter([1.0], [1.0, -0.95], noise, axis=0))
    imu = replace(m.imu, accel=m.imu.accel + 0.1 * shaken)
    rig = rig_for(simulation.scenario)
    shown, unknown = said(calibrate_measurements(rig, m.with_streams(imu)))
    assert advised(shown)["accel"] < 2.0 * not_none(rig.imu).noise.accel
    assert names([shown, unknown]) == ["imu_noise_understated", "residuals_unexplained"]


def swapped(simulation: Simulation) -> Measurements:
    """Each camera's images under the other's name."""
    a, b = simulation.measurements.cameras
    return simulation.measurements.with_streams(replace(b, name=a.name), replace(a, name=b.name))


GUESSES: list[dict[str, Any]] = [
    {"rotation": "start", "translation": "start", "time_offset": "start", "intrinsics": "start"},
    {"rotation": "start", "translation": "start", "time_offset": "free", "intrinsics": "free"},
    {"rotation": "free", "translation": "free", "time_offset": "free", "intrinsics": "start"},
]


@pytest.mark.parametrize("modes", [GUESSES[0], *(pytest.param(modes, marks=pytest.mark.full) for modes in GUESSES[1:])])
def test_cameras_that_are_mixed_up_are_named(simulation, modes):
    rig = rig_for(simulation.scenario, distortion="free", **modes)
    result = calibrate_measurements(rig, swapped(simulation))
    assert names(result.wrong) == ["cameras_swapped"] and result.warnings[0] == result.wrong[0]
    assert result.wrong[0].startswith("cam0 and cam1 ")
    assert "cameras_swapped" not in names(calibrate_measurements(rig, simulation.measurements).warnings)


@pytest.mark.full
def test_a_poor_guess_is_not_taken_for_the_other_camera(simulation):
    """Of one camera, by as much as cameras are apart, and of both."""
    rig = rig_for(simulation.scenario, **GUESSES[0])
    for moved in ((0.11, 0.0), (0.3, 0.3)):
        cameras = tuple(
            replace(c, translation=replace(c.translation, value=not_none(c.translation.value) + [0.0, by, 0.0]))
            for c, by in zip(rig.cameras, moved, strict=True)
        )
        result = calibrate_measurements(rig.with_(cameras=cameras), simulation.measurements)
        assert "cameras_swapped" not in names(result.warnings)


@pytest.mark.parametrize("stated", [True, pytest.param(False, marks=pytest.mark.full)])
def test_a_lens_of_another_camera_that_is_fixed(simulation, stated):
    """The value that is wrong comes first; that corners fit worse than stated follows."""
    rig = rig_for(simulation.scenario, intrinsics="fixed", distortion="fixed")
    first, second = rig.cameras
    off = [1.0, 1.0] if stated else [0.8, 1.0]
    lens = replace(
        second.distortion, value=not_none(first.distortion.value) * [*off, 1.0, 1.0] * (1.05 if stated else 1.0)
    )
    cameras = (replace(first, distortion=lens, corner_noise_px=first.corner_noise_px if stated else None), second)
    result = calibrate_measurements(rig.with_(cameras=cameras), simulation.measurements)
    assert result.reasons[0].name == "fixed_value_contradicted" and "distortion k1 of cam0" in result.reasons[0]
    assert any("corners of cam0" in words for words in result.reasons[1:]) == stated
    assert not {"residuals_unexplained", "imu_noise_understated"} & {*names(result.reasons)}


def test_corners_that_are_off_with_no_cause_in_sight(simulation):
    """Twice as far as stated, and ten times as far as any detector is, white."""
    first, second = simulation.measurements.cameras
    rig, rng = rig_for(simulation.scenario), np.random.default_rng(1)
    for size, noise, name in ((0.5, 0.2, "corner_noise_understated"), (2.0, None, "corners_fit_poorly")):
        moved = replace(first, uv=first.uv + rng.normal(scale=size, size=first.uv.shape))
        cameras = (replace(rig.cameras[0], corner_noise_px=noise), rig.cameras[1])
        measured = simulation.measurements.with_streams(moved, second)
        result = calibrate_measurements(rig.with_(cameras=cameras), measured)
        assert result.reasons[0].name == name, result.reasons


def with_lens(simulation: Simulation, change: list[float], mode: str = "fixed") -> Calibration:
    """Of cam0 fx, fy, cx, cy are fixed at so much more than they are [px]; all else is right."""
    rig = rig_for(simulation.scenario, intrinsics="start", distortion="start")
    cam0, cam1 = (
        replace(c, intrinsics=replace(c.intrinsics, mode=mode), distortion=replace(c.distortion, mode=mode))
        for c in rig.cameras
    )
    value = cam0.intrinsics.value + np.array(change)
    cam0 = replace(cam0, intrinsics=replace(cam0.intrinsics, value=value))
    return calibrate_measurements(rig.with_(cameras=(cam0, cam1)), simulation.measurements)


def test_the_right_lens_is_no_news(simulation):
    result = with_lens(simulation, [0.0] * 4)
    assert result.wrong == () and "fixed_intrinsics_wrong" not in names(result.warnings)


def test_a_lens_that_is_nearly_right_is_not_taken_for_another(simulation):
    """What the factory says, or last year's calibration: its principal point is 3 px off, and rotations by 0.37 deg
    with it, 50 printed standard deviations. That the value is wrong is said, and that it makes the result wrong."""
    result = with_lens(simulation, [2.0, 2.0, -3.0, 3.0])
    (words,) = [w for w in result.wrong if "intrinsics" in w]
    assert words.name == "fixed_value_contradicted" and result.verdict == "not usable"
    assert "fixed_intrinsics_wrong" not in names(result.warnings)


@pytest.mark.parametrize(
    "change", [[0.0, 0.0, 13.0, 7.0], pytest.param([14.0, 14.0, 0.0, 0.0], marks=pytest.mark.full)]
)
def test_another_cameras_lens_is_named_with_what_the_images_want(simulation, change):
    result, truth = with_lens(simulation, change), simulation.scenario.cameras[0].intrinsics
    words = result.wrong[0]
    assert words.name == "fixed_intrinsics_wrong" and "of cam0" in words
    said = {name: (float(a), float(b)) for name, a, b in re.findall(r"(\w+) ([\d.]+) and not ([\d.]+)", words)}
    wanted = {name: t for name, t, c in zip(("fx", "fy", "cx", "cy"), truth, change, strict=True) if c}
    assert set(wanted) >= set(said) and said
    for name, (now, given) in said.items():
        assert abs(now - wanted[name]) < 0.35 * abs(given - wanted[name])


@pytest.mark.full
def test_a_lens_that_is_free_is_not_tested(simulation):
    assert with_lens(simulation, [8.0, 8.0, 0.0, 0.0], "free").wrong == ()
