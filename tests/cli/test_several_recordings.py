"""Several recordings on the command line and from Python: the shipped excerpt cut into two folders."""

from __future__ import annotations

import gzip
import re
from pathlib import Path

import numpy as np
import pytest

import icalib
from icalib.cli import main
from icalib.errors import RecordingError
from icalib.result import load_calibration

EXAMPLE = Path(__file__).parents[2] / "examples" / "euroc"
RIG = """\
sensors:
  imu0:
    type: imu
    noise: {gyro: 1.6968e-4, gyro_walk: 1.9393e-5, accel: 2.0e-3, accel_walk: 3.0e-3}
  cam0:
    type: camera
    model: pinhole-radtan
    resolution: [752, 480]
    intrinsics: {fixed: [458.654, 457.296, 367.215, 248.375]}
    distortion: {fixed: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]}
target: {type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}
settings: {board_shape: false, segments: 0}
"""
PARTS = {"morning": (0, 9, 0), "evening": (20, 29, 3_600)}  # seconds of the excerpt; how much later its clocks were


def lines_of(name: str) -> list[str]:
    text = gzip.decompress((EXAMPLE / "recording" / name).read_bytes()).decode()
    return [line for line in text.splitlines() if line[0].isdigit()]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A rig, and two recordings."""
    tables = {"imu0/data.csv": lines_of("imu0/data.csv.gz"), "cam0/corners.csv": lines_of("cam0/corners.csv.gz")}
    origin = int(tables["imu0/data.csv"][0].split(",", 1)[0])
    for part, (begin, end, later) in PARTS.items():
        for name, lines in tables.items():
            stamped = [(int(t), rest) for t, _, rest in (line.partition(",") for line in lines)]
            own = [(t, x) for t, x in stamped if begin * 10**9 <= t - origin < end * 10**9]
            path = tmp_path / part / name
            path.parent.mkdir(parents=True)
            path.write_text("\n".join(f"{t + later * 10**9},{x}" for t, x in own) + "\n")
    (tmp_path / "rig.yaml").write_text(RIG)
    return tmp_path


def run(folder: Path, *names: str) -> int:
    recordings = [str(folder / name) for name in names]
    return main(["calibrate", str(folder / "rig.yaml"), *recordings, "--output", str(folder / "out")])


def test_two_recordings_on_the_command_line(folder: Path, capsys):
    assert run(folder, *PARTS) == 0
    printed = capsys.readouterr().out
    assert "Note: recording 2, evening: 9.0 s from " in printed
    found = load_calibration(folder / "out")
    assert [r.name for r in found.recordings] == ["morning", "evening"]
    assert {Path(name).parents[1].name for name in found.inputs if name.endswith(".csv")} == set(PARTS)
    alone = [icalib.calibrate(folder / "rig.yaml", folder / name) for name in PARTS]
    together = icalib.calibrate(folder / "rig.yaml", [folder / name for name in PARTS])
    for name in ("translation", "time_offset"):
        np.testing.assert_allclose(together.group("cam0", name).value, found.group("cam0", name).value, atol=1e-9)
        best = np.min([a.group("cam0", name).std_formal for a in alone], axis=0)
        assert (together.group("cam0", name).std_formal < best).all()


@pytest.mark.parametrize("missing", ["imu0/data.csv", "cam0/corners.csv"])
def test_a_bad_second_recording_is_named(folder: Path, capsys, missing: str):
    (folder / "evening" / missing).unlink()
    assert run(folder, *PARTS) == 1
    assert re.fullmatch(rf"icalib: .*evening.*{missing.split('/')[0]}.*\n", capsys.readouterr().err)
    assert not any((folder / "out").iterdir())


def test_a_broken_line_of_the_second_recording_is_named(folder: Path, capsys):
    path = folder / "evening" / "cam0" / "corners.csv"
    path.write_text(path.read_text().replace("\n", "\nnonsense\n"))
    assert run(folder, *PARTS) == 1
    assert re.fullmatch(r"icalib: .*evening.*corners\.csv.*2.*\n", capsys.readouterr().err)


def test_recordings_that_are_open_already(folder: Path):
    opened = [icalib.open_recording(folder / name) for name in PARTS]
    found = icalib.calibrate(folder / "rig.yaml", opened)
    assert [r.name for r in found.recordings] == ["recording 1", "recording 2"]


def test_a_recording_given_twice_is_refused(folder: Path, capsys):
    assert run(folder, "morning", "morning") == 1
    assert "morning is given twice; give each recording once." in capsys.readouterr().err
    with pytest.raises(RecordingError, match="no recording was given"):
        icalib.calibrate(folder / "rig.yaml", [])
