"""Names of files whose bytes are not UTF-8 go through results, exports and comparisons."""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path

import pytest
from tests.remarks import remark
from tests.tools.allan.test_allan import at_rest

from icalib.base.files import printable
from icalib.cli import main
from icalib.export.formats import export, write_outputs
from icalib.result import Calibration, load_calibration
from icalib.tools.allan import study_imu, write_study
from icalib.tools.fleet.result import InputHashes, Job

ODD = os.fsdecode(b"B\xfcro")


@pytest.fixture(scope="module")
def odd(calibration: Calibration) -> Calibration:
    return dataclasses.replace(
        calibration,
        inputs={f"/{ODD}/rig.yaml": "0" * 64},
        notes=(remark(f"/{ODD}/rec: left out."),),
        warnings=(remark(ODD),),
    )


def test_a_result_keeps_its_paths(odd: Calibration, tmp_path: Path):
    write_outputs(odd, tmp_path / ODD)
    loaded = load_calibration(tmp_path / ODD)
    assert loaded.inputs == odd.inputs and loaded.notes == odd.notes
    for file in (tmp_path / ODD).glob("*.[hjy]*"):
        file.read_text(encoding="utf-8")


def test_commands_name_and_write_odd_paths(odd: Calibration, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    write_outputs(odd, tmp_path / ODD)
    assert main(["compare", str(tmp_path / ODD), str(tmp_path / ODD), "--json", str(tmp_path / "same.json")]) == 0
    assert json.loads((tmp_path / "same.json").read_text(encoding="utf-8"))["a"]["path"] == str(tmp_path / ODD)
    assert main(["inspect", str(tmp_path / ODD / "none")]) == 1
    assert "B\\udcfcro/none does not exist" in capsys.readouterr().err


def test_exports_are_utf8(odd: Calibration, tmp_path: Path):
    for text in export(odd, "json", {}, None, {}).files.values():
        assert json.loads(text.encode("utf-8"))["notes"] == list(odd.notes)
    write_study(study_imu(at_rest(30.0, 100.0, 1), f"/{ODD}/imu0"), tmp_path)
    for name in ("allan.html", "noise.yaml", "allan.json"):
        (tmp_path / name).read_text(encoding="utf-8")


def test_a_fleet_knows_recordings_of_odd_names(tmp_path: Path):
    (tmp_path / ODD).mkdir()
    (tmp_path / ODD / f"{ODD}.csv").write_text("1")
    found = InputHashes.of(Job("a", "robot", tmp_path / "rig.yaml", (tmp_path / ODD,), None))
    assert found.recordings[0] != "absent"


def test_good_text_stays_as_it_is():
    assert printable("Büro 東京") == "Büro 東京"
