"""One sentence for each thing that can be wrong, and no file half written."""

from __future__ import annotations

import dataclasses
import shutil
import sys
from pathlib import Path

import pytest

from icalib.base.extras import load_rerun
from icalib.cli import main
from icalib.errors import CalibrationError
from icalib.result import Calibration
from icalib.tools.view import view


@pytest.fixture
def complaint(capsys):
    """The one line on standard error that a command ends with."""

    def run(*arguments: object) -> str:
        assert main(["view", *map(str, arguments)]) == 1
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        return lines[0]

    return run


@pytest.fixture
def drive(shown, tmp_path) -> Path:
    """A copy of the recording, to be spoilt."""
    return Path(shutil.copytree(shown.recording, tmp_path / "drive"))


def _changed(c: Calibration, folder: Path, **changes) -> Path:
    dataclasses.replace(c, **changes).save(folder)
    return folder


def test_no_result(complaint, tmp_path):
    assert "is not a folder; give the folder that a calibration was written to." in complaint(tmp_path / "absent")
    assert f"{tmp_path} holds no result.json" in complaint(tmp_path)


def test_no_recording(complaint, shown, tmp_path):
    said = complaint(shown.result, tmp_path / "absent", "--save", tmp_path / "a.rrd")
    assert f"{tmp_path / 'absent'} does not exist" in said


@pytest.mark.parametrize("sensor", ["imu0", "lidar0"])
def test_a_recording_without_a_sensor_of_the_result(complaint, shown, drive, tmp_path, sensor):
    shutil.rmtree(drive / sensor)
    said = complaint(shown.result, drive, "--save", tmp_path / "a.rrd")
    assert f"{drive} has no {sensor}/" in said
    assert not (tmp_path / "a.rrd").exists()


def test_a_recording_without_anything_of_a_camera(complaint, shown, drive, tmp_path):
    shutil.rmtree(drive / "cam0")
    assert f"{drive} has no cam0/corners.csv" in complaint(shown.result, drive, "--save", tmp_path / "a.rrd")


def test_a_recording_with_corners_but_no_images_is_shown_without(shown, drive, tmp_path):
    shutil.rmtree(drive / "cam0" / "data")
    assert view(shown.result, drive, tmp_path / "a.rrd") == ["cam0: the recording holds no images of it."]


def test_images_of_another_camera_are_not_shown(shown, drive, tmp_path):
    (drive / "other").mkdir()
    for name in ("data", "data.csv"):
        (drive / "cam0" / name).rename(drive / "other" / name)
    assert view(shown.result, drive, tmp_path / "a.rrd") == ["cam0: the recording holds no images of it."]


def test_a_recording_of_another_time(complaint, shown, tmp_path):
    c = shown.calibration
    later = dataclasses.replace(c.recordings[0], origin_ns=c.recordings[0].origin_ns + 10**12)
    result = _changed(c, tmp_path / "out", recordings=(later,))
    said = complaint(result, shown.recording, "--save", tmp_path / "a.rrd")
    assert f"{shown.recording} holds no data of imu0 from the time of the result; give the recording drive" in said


def test_a_recording_that_is_none_of_several(complaint, shown, drive, tmp_path):
    c = shown.calibration
    spans = tuple(dataclasses.replace(c.recordings[0], name=name) for name in ("monday", "friday"))
    result = _changed(c, tmp_path / "out", recordings=spans)
    said = complaint(result, drive, "--save", tmp_path / "a.rrd")
    assert f"{drive} is not a recording of the result, which has monday, friday; give one of them." in said
    renamed = drive.rename(tmp_path / "friday")
    assert main(["view", str(result), str(renamed), "--save", str(tmp_path / "a.rrd"), "--quiet"]) == 0


def test_a_result_that_does_not_know_when_it_was(complaint, shown, tmp_path):
    result = _changed(shown.calibration, tmp_path / "out", recordings=())
    view(result, save=tmp_path / "alone.rrd")
    said = complaint(result, shown.recording, "--save", tmp_path / "a.rrd")
    assert "does not tell the time of its recording; calibrate again to see both." in said


def test_a_damaged_image_is_left_out_which_is_said(shown, drive, tmp_path):
    damaged = sorted((drive / "cam0" / "data").iterdir())[3]
    damaged.write_bytes(damaged.read_bytes()[:60])
    assert view(shown.result, drive, tmp_path / "a.rrd") == ["cam0: 1 damaged images are not shown."]


def test_rerun_is_missing(complaint, shown, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun.blueprint", None)
    assert 'rerun-sdk, which is not installed; run pip install ".[view]" in the checkout' in complaint(shown.result)


def test_an_output_that_cannot_be_written(complaint, shown, tmp_path):
    place = tmp_path / "absent" / "a.rrd"
    assert f"{place} cannot be written (" in complaint(shown.result, "--save", place)
    said = complaint(shown.result, "--save", tmp_path)
    assert f"{tmp_path} cannot be written (it is a folder); choose another place." in said


def test_what_fails_half_way_leaves_the_old_file(complaint, shown, drive, tmp_path):
    (drive / "lidar0" / "scans.npz").write_bytes(b"no scans")
    folder = tmp_path / "kept"
    folder.mkdir()
    (folder / "a.rrd").write_text("old")
    complaint(shown.result, drive, "--save", folder / "a.rrd")
    assert [(p.name, p.read_text()) for p in folder.iterdir()] == [("a.rrd", "old")]


def test_without_a_file_the_viewer_is_started_with_the_layout(shown, monkeypatch):
    rr, started = load_rerun(), []
    monkeypatch.setattr(rr.RecordingStream, "spawn", lambda self, **options: started.append(options))
    assert view(shown.result) == []
    assert [type(options["default_blueprint"]).__name__ for options in started] == ["Blueprint"]


def test_a_viewer_that_does_not_answer(shown, monkeypatch):
    def refuse(self, **options):
        raise RuntimeError("no connection\nafter 6 s")

    monkeypatch.setattr(load_rerun().RecordingStream, "spawn", refuse)
    with pytest.raises(CalibrationError, match=r"does not answer \(no connection\); write a file by --save\.$"):
        view(shown.result)
