"""A result's rig: loads back, with its values fixed, as priors or as guesses, and never over a file of the user."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from icalib.cli import main
from icalib.errors import RigError
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.result.saving import TREATMENTS, Treatment, rig_of_result
from icalib.rig.file import load_rig, rig_from_dict, rig_to_dict
from icalib.sensors.parameter import Parameter
from icalib.tools.simulation import handheld, rig_for, simulate

ESTIMATED = [("cam0", "rotation"), ("cam0", "intrinsics"), ("lidar0", "translation"), ("wheel0", "radii")]


def parameter(rig: Any, sensor: str, name: str) -> Parameter:
    found = rig.sensors[sensor]
    return getattr(found, name)


@pytest.mark.parametrize("treatment", TREATMENTS)
def test_the_file_loads_back(robot: Calibration, tmp_path: Path, treatment: Treatment):
    robot.save(tmp_path / "out")
    file = tmp_path / "rig.yaml"
    assert main(["rig", str(tmp_path / "out"), "--as", treatment, "-o", str(file), "-q"]) == 0
    loaded = load_rig(file)
    assert rig_to_dict(loaded) == rig_to_dict(rig_of_result(robot, treatment)[0])
    for sensor, name in ESTIMATED:
        p, g = parameter(loaded, sensor, name), robot.group(sensor, name)
        assert p.mode == {"guess": "free"}.get(treatment, treatment)
        np.testing.assert_array_equal(p.value, g.value)
        assert p.sigma is None if treatment != "prior" else (p.sigma == g.std).all()
    assert parameter(loaded, "cam0", "distortion").mode == "fixed"  # as in the rig file of the result
    same = rig_from_dict(robot.rig, "the rig")
    assert (loaded.target, loaded.settings, loaded.gravity) == (same.target, same.settings, same.gravity)


def test_what_is_unobservable_is_never_fixed(robot: Calibration, capsys: pytest.CaptureFixture[str], tmp_path: Path):
    rig, sentences = rig_of_result(robot, "fixed")
    assert sentences == ("cam1: translation is not fixed, because y is unobservable.",)
    assert parameter(rig, "cam1", "translation").mode == "free" and parameter(rig, "cam1", "rotation").mode == "fixed"
    robot.save(tmp_path / "out")
    assert main(["rig", str(tmp_path / "out"), "--as", "fixed", "-o", str(tmp_path / "rig.yaml")]) == 0
    assert f"Note: {sentences[0]}\nWrote {tmp_path / 'rig.yaml'}.\n" == capsys.readouterr().out
    assert f"# {sentences[0]}\n" in (tmp_path / "rig.yaml").read_text()


def test_priors_of_the_rig_file_stay_beside_guesses(robot: Calibration):
    prior = {"prior": [0.1, 0.1], "sigma": [1e-3, 1e-3]}
    sensors = robot.rig["sensors"]
    stated = robot.rig | {"sensors": sensors | {"wheel0": sensors["wheel0"] | {"radii": prior}}}
    c = dataclasses.replace(robot, rig=stated)
    kept = parameter(rig_of_result(c, "guess")[0], "wheel0", "radii")
    assert kept.mode == "prior" and kept.sigma is not None and kept.sigma.tolist() == [1e-3, 1e-3]
    taken = parameter(rig_of_result(c, "prior")[0], "wheel0", "radii")
    assert taken.sigma is not None and (taken.sigma == robot.group("wheel0", "radii").std).all()


def test_clocks_that_restart_and_unknown_uncertainty(robot: Calibration):
    offsets = dataclasses.replace(
        robot.group("cam0", "time_offset"), labels=("1", "2"), value=np.zeros(2), verdict=("determined",) * 2
    )
    endless = dataclasses.replace(robot.group("cam1", "rotation"), std=np.full(3, np.inf))
    changed = {("cam0", "time_offset"): offsets, ("cam1", "rotation"): endless}
    c = dataclasses.replace(robot, groups=tuple(changed.get((g.sensor, g.name), g) for g in robot.groups))
    rig, sentences = rig_of_result(c, "prior")
    assert parameter(rig, "cam0", "time_offset") == Parameter()
    assert parameter(rig, "cam1", "rotation").mode == "free"
    assert sentences == (
        "cam0: each recording has a time offset of its own, so time_offset stays free.",
        "cam1: rotation has no finite standard deviation, so it is a guess.",
    )
    with pytest.raises(RigError, match="become fixed, prior, guess, not 'free'"):
        rig_of_result(robot, "free")  # pyright: ignore[reportArgumentType]


def test_a_file_of_the_user_stays(robot: Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    robot.save(tmp_path / "out")
    file = tmp_path / "rig.yaml"
    command = ["rig", str(tmp_path / "out"), "--as", "guess", "-o", str(file)]
    assert main(command) == 0
    written = file.read_text()
    for text in (written, "sensors: {}\n"):  # a file of icalib stays, too: the user may work with it
        file.write_text(text)
        capsys.readouterr()
        assert main(command) == 1
        assert "rig.yaml exists and was not changed; give another name" in capsys.readouterr().err
        assert file.read_text() == text
    assert main(["rig", str(tmp_path / "no"), "--as", "guess", "-o", str(file)]) == 1
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.slow
def test_a_second_recording_improves_on_priors_from_the_first():
    scenario = handheld(8.0)
    rig = rig_for(scenario, intrinsics="start", distortion="start")
    first = calibrate_measurements(rig, simulate(scenario, 1).measurements)
    second = calibrate_measurements(rig_of_result(first, "prior")[0], simulate(scenario, 2).measurements)
    assert not second.wrong and second.verdict == first.verdict
    for camera in scenario.cameras:
        error = second.value(camera.name, "translation") - camera.T_imu_sensor[:3, 3]
        std = second.std(camera.name, "translation")
        assert (np.abs(error) < 4.0 * std).all() and (std < 0.9 * first.std(camera.name, "translation")).all()
