"""Whether a calibration still holds: on simulated recordings of the same rig, of a changed one, and of poor motion."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from markupsafe import escape
from scipy.spatial.transform import Rotation
from scipy.stats import norm
from tests.pages import figures_of

import icalib
from icalib.cli import main
from icalib.data.measurements import Measurements
from icalib.errors import CalibrationError, RecordingError
from icalib.geometry.targets import AprilGrid
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.result.saving import rig_of_result
from icalib.rig.file import rig_to_dict
from icalib.tools.check import Check, check_html, check_measurements, joint_limit, lines, verdict, with_places
from icalib.tools.simulation import Scenario, handheld, rig_for, simulate, write_tables

pytestmark = pytest.mark.slow
SECONDS = 8.0
TURN_DEG = 0.3  # ten and more sigma of such a recording


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return handheld(SECONDS)


@pytest.fixture(scope="module")
def known(scenario: Scenario) -> Calibration:
    rig = rig_for(scenario, intrinsics="start", distortion="start")
    return calibrate_measurements(rig, simulate(scenario, 1).measurements)


def turned(scenario: Scenario, names: tuple[str, ...], from_left: bool = False) -> Scenario:
    """The scenario with cameras turned about their own x axes, or with the IMU's frame turned below them."""
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_euler("x", TURN_DEG, degrees=True).as_matrix()
    cameras = tuple(
        replace(c, T_imu_sensor=turn @ c.T_imu_sensor if from_left else c.T_imu_sensor @ turn) if c.name in names else c
        for c in scenario.cameras
    )
    return replace(scenario, cameras=cameras)


@pytest.mark.parametrize("seed", [2, *(pytest.param(k, marks=pytest.mark.full) for k in (3, 4, 5))])
def test_the_same_rig_is_valid(known: Calibration, scenario: Scenario, seed: int):
    found = check_measurements(known, simulate(scenario, seed).measurements)
    assert (found.validity, found.exit_code, found.unknown) == ("valid", 0, ())
    assert found.untested == ("imu0 intrinsics",)
    assert verdict(found) == (
        f"Valid: no parameter changed by more than {found.limit:.1f} sigma. Not tested, as the rig file fixes them: "
        "imu0 intrinsics."
    )
    assert found.fits[1] and all(f.chi2_per_dof is None or f.chi2_per_dof < 1.5 for f in found.fits[1])


def moved_camera(scenario: Scenario) -> Scenario:
    return turned(scenario, ("cam1",))


def moved_imu(scenario: Scenario) -> Scenario:
    return turned(scenario, ("cam0", "cam1"), from_left=True)


@pytest.mark.parametrize(("change", "name"), [(moved_camera, "cam1"), (moved_imu, "imu0")])
def test_a_sensor_that_moved_is_named(
    known: Calibration, scenario: Scenario, change: Callable[[Scenario], Scenario], name: str
):
    found = check_measurements(known, simulate(change(scenario), 6).measurements)
    assert (found.validity, found.exit_code) == ("changed", 1)
    words = lines(found)
    assert words[-1].startswith(f"Changed: the pose of {name} (") and words[-1].endswith(" sigma). Calibrate again.")
    assert any(re.match(r"  CHANGED  cam1 turned by -?0\.(2[789]|3[0-3]) deg about", line) for line in words)
    (drift,) = (d for d in found.drifts if (d.sensor, d.name) == ("cam1", "rotation"))
    true = np.array([np.deg2rad(TURN_DEG), 0.0, 0.0])
    if name == "imu0":  # about the x axis of the IMU
        true = scenario.cameras[1].T_imu_sensor[:3, :3].T @ true
    assert (np.abs(np.array(drift.change) - true) < 4.0 * np.array(drift.std)).all()
    assert drift.sigmas is not None and drift.sigmas > found.limit
    # The old values do not fit the new data, which the new ones do.
    worst = [max(f.chi2_per_dof or 0.0 for f in fits) for fits in found.fits]
    assert worst[1] > 2.0 > worst[2] and worst[0] < 2.0


def test_motion_that_does_not_determine_everything(known: Calibration, scenario: Scenario):
    planar = replace(scenario, motion=replace(scenario.motion, kind="planar"))
    found = check_measurements(known, simulate(planar, 4).measurements)
    assert (found.validity, found.exit_code) == ("cannot say", 3)
    assert found.unknown == ("cam0 translation", "cam1 translation") and not found.changed
    assert "does not determine cam0 translation, cam1 translation; all else is unchanged" in verdict(found)


def test_an_imu_whose_scale_changed_is_named(scenario: Scenario):
    rig = rig_for(scenario).with_("imu0", intrinsics=icalib.prior(np.zeros(24), np.repeat([0.05, 0.01], [15, 9])))
    known = calibrate_measurements(rig, simulate(scenario, 1).measurements)
    intrinsics = np.zeros(24)
    assert check_measurements(known, simulate(scenario, 2).measurements).validity == "valid"
    intrinsics[8] = 0.02  # scale of the gyroscope's y axis
    found = check_measurements(known, simulate(replace(scenario, imu_intrinsics=intrinsics), 2).measurements)
    assert [(d.sensor, d.what) for d in found.changed] == [("imu0", "intrinsics")]
    assert "the intrinsics of imu0 (" in verdict(found)


def test_a_target_of_another_size_is_the_reason_and_not_a_change(known: Calibration, scenario: Scenario):
    larger = replace(scenario, target=AprilGrid(6, 6, 0.0968, 0.3))
    found = check_measurements(known, simulate(larger, 2).measurements)
    assert found.validity == "cannot say" and found.new is not None and found.reason == found.new.reasons[0]
    assert "the target is 1.09" in verdict(found)


def first(measurements: Measurements, seconds: float) -> Measurements:
    assert measurements.imu is not None
    imu = measurements.imu
    n = int(np.searchsorted(imu.seconds, seconds))
    return measurements.with_streams(replace(imu, stamps_ns=imu.stamps_ns[:n], gyro=imu.gyro[:n], accel=imu.accel[:n]))


def test_a_recording_that_is_too_short_and_one_of_another_rig(known: Calibration, scenario: Scenario):
    measured = simulate(scenario, 7).measurements
    found = check_measurements(known, first(measured, 0.5))
    assert (found.validity, found.exit_code, found.new) == ("cannot say", 3, None)
    assert lines(found) == [f"Cannot say: {found.reason}"] and "the recording is too short" in found.reason
    page = check_html(found, "out on short")
    assert escape(lines(found)[0]) in page and re.findall('<section id="([^"]+)"', page) == ["trust"]
    with pytest.raises(CalibrationError, match="sigma must be a number above 0, but is -1"):
        check_measurements(known, measured, sigma=-1.0)
    with pytest.raises(RecordingError, match="cam1"):
        check_measurements(known, measured.only("imu0", "cam0"))


def test_the_limit_of_many_tests_is_that_of_one():
    for sigma in (2.0, 3.0, 5.0):
        for tests in (1, 7, 40):
            joint = tests * 2.0 * norm.sf(joint_limit(sigma, tests))
            assert joint == pytest.approx(2.0 * norm.sf(sigma), rel=1e-6)
    assert joint_limit(3.0, 0) == pytest.approx(3.0)
    assert joint_limit(40.0, 5) == 40.0  # beyond what doubles can tell


@pytest.fixture(scope="module")
def folders(known: Calibration, scenario: Scenario, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result, a recording of the same rig, and one without its second camera."""
    folder = tmp_path_factory.mktemp("check")
    known.save(folder / "out")
    simulation = simulate(scenario, 8)
    write_tables(simulation, 8, folder / "same")
    write_tables(simulation, 8, folder / "other")
    for file in sorted((folder / "other").rglob("*")):
        if "cam1" in str(file.relative_to(folder)) and file.is_file():
            file.unlink()
    (folder / "rig.yaml").write_text(yaml.safe_dump(rig_to_dict(rig_for(scenario))))
    return folder


def test_the_command(folders: Path, capsys: pytest.CaptureFixture[str]):
    file, page = folders / "check.json", folders / "check.html"
    arguments = ["check", str(folders / "out"), str(folders / "same"), "--json", str(file), "--html", str(page)]
    assert main(arguments) == 0
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("Residuals on the new recording") and printed[-1].startswith("Valid: ")
    plain = json.loads(file.read_text())
    assert (plain["validity"], plain["sentence"], plain["changed"]) == ("valid", printed[-1], [])
    notes = [line.removeprefix("Note on the new recording: ") for line in printed if line.startswith("Note on the")]
    assert notes == plain["notes"]
    text = page.read_text()
    assert f'<p class="answer">{printed[-1]}</p>' in text and "out on same</title>" in text
    shown = [line.strip() for line in printed[1:-1]]
    assert all(escape(line.removeprefix("same").strip()) in text for line in shown if not line.endswith(":"))
    assert set(figures_of(text)) == {"changes-in-sigma"} and text.count(">same</span>") == len(plain["differences"])
    names = {(d["sensor"], d["name"]) for d in plain["drifts"]}
    assert {("cam0", "rotation"), ("cam1", "time_offset"), ("cam1", "distortion")} <= names
    assert {f["kind"] for f in plain["residuals"]["fixed"]} >= {"corners", "gyroscope"}
    assert main([*arguments, "--quiet", "--from", "1", "--to", "6"]) == 0 and capsys.readouterr().out == ""


def test_a_browser_draws_its_page(
    known: Calibration, scenario: Scenario, assert_drawn: Callable[[str, set[str]], None]
):
    found = check_measurements(known, simulate(turned(scenario, ("cam1",)), 9).measurements)
    page = check_html(found, "out on turned")
    assert ">changed</span>" in page and '<section id="trust" class="bad">' in page
    assert_drawn(page, {"changes-in-sigma"})


def test_other_paths_and_topics(folders: Path, known: Calibration, capsys: pytest.CaptureFixture[str]):
    shutil.copytree(folders / "same", folders / "moved")
    (folders / "moved" / "cam1").rename(folders / "moved" / "left")
    arguments = ["check", str(folders / "out"), str(folders / "moved"), "--quiet"]
    assert main(arguments) == 2
    assert main([*arguments, "--path", "cam1=left/corners.csv"]) == 0
    capsys.readouterr()
    assert main([*arguments, "--topic", "cam9=/left"]) == 2
    assert "the calibration has no sensor cam9; it has imu0, cam0, cam1." in capsys.readouterr().err
    moved = rig_of_result(with_places(known, topic={"cam0": "/a"}, path={"cam1": "b.csv"}), "guess")[0]
    assert [(c.topic, c.path) for c in moved.cameras] == [
        ("/a", known.rig["sensors"]["cam0"].get("path", "cam0/corners.csv")),
        (None, "b.csv"),
    ]


@pytest.mark.parametrize(
    ("result", "recording", "words"),
    [("out", "other", "cam1"), ("out", "nowhere", "nowhere"), ("same", "same", "result.json")],
)
def test_errors_are_one_sentence(
    folders: Path, capsys: pytest.CaptureFixture[str], result: str, recording: str, words: str
):
    assert main(["check", str(folders / result), str(folders / recording)]) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1 and "Traceback" not in error


def test_what_changed_is_named_in_a_few_words(known: Calibration, scenario: Scenario):
    """Several sensors at once, and a clock: `named` lists pairs."""
    both = turned(turned(scenario, ("cam1",)), ("cam0",), from_left=True)
    cameras = tuple(replace(c, time_offset_s=c.time_offset_s + 5e-3 * (c.name == "cam0")) for c in both.cameras)
    found: Check = check_measurements(known, simulate(replace(both, cameras=cameras), 9).measurements)
    assert found.validity == "changed"
    for words in ("the pose of cam0 relative to imu0 (", "cam1 relative to cam0 (", "the time offset of cam0 ("):
        assert words in verdict(found), verdict(found)
