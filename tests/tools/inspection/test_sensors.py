"""Inspect judges the sensors together: no "No" where `calibrate` works, no "Yes" where the rig file is refused."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from icalib.cli import main
from icalib.errors import CalibrationError
from icalib.rig import Rig
from icalib.rig.file import load_rig
from icalib.tools.inspection import draft_rig, inspect_recording

PAPER = Path(__file__).parents[3] / "examples" / "paper"
POSE = "  {name}: {{type: pose, rate: 50, T_imu_sensor: {T}, rotation_noise: 0.002, position_noise: 0.001}}\n"
BOARD = """
target:
  type: aprilgrid
  rows: 4
  cols: 10
  tag_size: 0.6
  tag_spacing: 0.3
  T_world_board: [[0, 0, 1, -5.9], [1, 0, 0, -3.9], [0, 1, 0, 0.1], [0, 0, 0, 1]]
"""
FILLED = {"rows:": "4", "cols:": "10", "tag_size:": "0.6", "tag_spacing:": "0.3", "resolution:": "[752, 480]"}


@pytest.fixture(scope="module")
def everything(tmp_path_factory) -> Path:
    """Tables of an IMU, a camera with corners and tracks, a LiDAR, wheels, and two pose sensors: 8 s over ramps."""
    folder = tmp_path_factory.mktemp("recorded")
    text = (PAPER / "table2-ramp.yaml").read_text().replace("duration: 60", "duration: 8")
    poses = "".join(POSE.format(name=n, T=np.eye(4).tolist()) for n in ("mocap0", "slam0"))
    text = text.replace("room:\n", poses + "room:\n", 1).replace("azimuth_steps: 1800", "azimuth_steps: 60") + BOARD
    (folder / "scenario.yaml").write_text(text)
    assert main(["simulate", str(folder / "scenario.yaml"), "-o", str(folder / "run"), "-q"]) == 0
    return folder / "run"


def recording(everything: Path, to: Path, parts: str) -> Path:
    """A copy of some `parts`: sensors by name, of a camera `cam0/corners` and `cam0/tracks`."""
    for part in parts.split():
        name, _, table = part.partition("/")
        (to / name).mkdir(parents=True, exist_ok=True)
        files = [f for f in (everything / name).iterdir() if f.name.startswith(table or "")]
        assert files, part
        for file in files:
            shutil.copy(file, to / name)
    return to


def drafted(folder: Path) -> Rig:
    """The rig of the draft, blanks filled in."""
    text = draft_rig(inspect_recording(folder))
    for field, value in FILLED.items():
        text = "\n".join(
            f"{line[: line.index(field)]}{field} {value}" if line.strip().startswith(field) else line
            for line in text.splitlines()
        )
    (folder / "rig.yaml").write_text(text + "\n")
    return load_rig(folder / "rig.yaml")


@pytest.mark.parametrize(
    ("parts", "sensors"),
    [
        ("imu0 cam0/corners", "imu0 cam0"),
        ("imu0 cam0/tracks", "imu0 cam0"),
        ("imu0 lidar0", "imu0 lidar0"),
        ("imu0 lidar0 cam0/tracks wheel0 mocap0", "imu0 cam0 lidar0"),
        ("imu0 mocap0", "imu0 mocap0"),
        ("imu0 mocap0 wheel0", "imu0 wheel0 mocap0"),
        ("mocap0 wheel0", "wheel0 mocap0"),
        ("mocap0 slam0", "mocap0 slam0"),
        ("lidar0 wheel0", "lidar0 wheel0"),
        ("lidar0 mocap0", "lidar0 mocap0"),
        ("cam0/corners lidar0", "cam0 lidar0"),
        ("cam0/corners", "cam0"),
        ("cam0/corners wheel0", "cam0"),
        ("cam0/corners mocap0", "cam0"),
    ],
)
def test_what_can_be_calibrated_is_not_refused(everything, tmp_path, parts, sensors):
    folder = recording(everything, tmp_path / "run", parts)
    found = inspect_recording(folder)
    assert found.verdict != "no", found.findings
    assert not any("no images" in f.sentence for f in found.findings)
    rig = drafted(folder)
    every = rig.sensors.values()
    assert [s.name for s in every] == sensors.split()


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ("imu0", "There is only an IMU"),
        ("imu0 wheel0", "wheel0 and imu0 do not determine the motion"),
        ("wheel0", "Without an IMU the motion is unknown from wheel0"),
        ("mocap0", "Beside mocap0 there is no sensor that can be calibrated without an IMU"),
        ("lidar0", "Beside lidar0 there is no sensor that can be calibrated without an IMU"),
    ],
)
def test_what_cannot_be_calibrated_is_named(everything, tmp_path, parts, words):
    folder = recording(everything, tmp_path / "run", parts)
    found = inspect_recording(folder)
    assert found.verdict == "no"
    (problem,) = [f.sentence for f in found.findings if f.severity == "problem"]
    assert words in problem and "record" in problem
    with pytest.raises(CalibrationError, match="no rig to draft"):
        draft_rig(found)


def test_a_plane_is_no_problem_for_poses(everything, tmp_path):
    """Turns about one axis leave a camera's rotation open, not that of a sensor whose path is known."""
    text = (everything.parent / "scenario.yaml").read_text().replace("kind: ramps", "kind: planar")
    text = re.sub(r"  slope_deg: .*\n", "", text)
    (tmp_path / "scenario.yaml").write_text(text)
    assert main(["simulate", str(tmp_path / "scenario.yaml"), "-o", str(tmp_path / "flat"), "-q"]) == 0
    found = {
        parts: inspect_recording(recording(tmp_path / "flat", tmp_path / parts.replace("/", ""), parts))
        for parts in ("imu0 cam0/corners", "imu0 mocap0 wheel0")
    }
    turning = {p: next(f for f in one.findings if "turns about" in f.sentence) for p, one in found.items()}
    assert turning["imu0 cam0/corners"].severity == "problem"
    assert turning["imu0 mocap0 wheel0"].severity == "warning"
    assert "drive over ramps" in turning["imu0 mocap0 wheel0"].sentence


def few(folder: Path, count: int) -> Path:
    """Pictures without stamps, of grey."""
    import cv2

    folder.mkdir()
    rng = np.random.default_rng(0)
    for k in range(count):
        cv2.imwrite(str(folder / f"{k:03d}.png"), rng.integers(90, 110, (120, 160), dtype=np.uint8))
    return folder


@pytest.mark.parametrize(("count", "severity"), [(1, "problem"), (5, "warning"), (12, "")])
def test_still_images_need_be_few(tmp_path, count, severity):
    """Beside an IMU 20 pairs of neighbours are needed; of stills two images are a calibration, if not a good one."""
    found = inspect_recording(few(tmp_path / "stills", count))
    said = [f.severity for f in found.findings if f"{count} images" in f.sentence or f"images ({count})" in f.sentence]
    assert said == ([severity] if severity else [])
    assert (found.verdict == "no") == (severity == "problem")


def test_tables_at_the_top_of_a_folder(everything, tmp_path):
    """Poses as TUM text of any name, fixes, two tables of an IMU; clouds of single files are named, and not read."""
    run = recording(everything, tmp_path / "run", "imu0 mocap0")
    rows = np.loadtxt(run / "mocap0/poses.csv", delimiter=",")
    rows[:, 0] *= 1e-9
    np.savetxt(tmp_path / "run/groundtruth.txt", rows, fmt="%.9f")
    fixes = np.column_stack(
        [rows[:, 0] * 1e9, 48.0 + 1e-5 * rows[:, 1:2], 11.0 + 1e-5 * rows[:, 2:3], 500.0 + rows[:, 3]]
    )
    np.savetxt(run / "gps.csv", fixes, fmt="%d,%.9f,%.9f,%.4f", header="time_ns,latitude,longitude,height", comments="")
    readings = np.loadtxt(run / "imu0/data.csv", delimiter=",")
    for name, at in (("Gyroscope", [0, 1, 2, 3]), ("Accelerometer", [0, 4, 5, 6])):
        np.savetxt(run / f"{name}.csv", readings[:, at], fmt="%d,%.9f,%.9f,%.9f")
    for name in ("imu0/data.csv", "mocap0/poses.csv"):
        (run / name).unlink()
    (run / "clouds").mkdir()
    (run / "notes.txt").write_text("recorded on a Monday, with all sensors\n")
    for k in range(3):
        (run / f"clouds/{k}.pcd").write_text("# .PCD v0.7\n")
    found = inspect_recording(run)
    topics = {s.topic.name: s.topic.kind for s in found.streams}
    tables = {"Gyroscope.csv": "imu", "Accelerometer.csv": "imu", "groundtruth.txt": "pose", "gps.csv": "position"}
    assert topics == tables | {"clouds/*.pcd": ""}
    assert list(found.sources.of("imu")) == ["imu0"] and found.verdict != "no", found.findings
    assert any("clouds/*.pcd holds clouds that have no stamps; record" in f.sentence for f in found.findings)
    assert "path: {gyro: Gyroscope.csv, accel: Accelerometer.csv}" in draft_rig(found)
