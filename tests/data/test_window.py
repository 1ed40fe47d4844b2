"""Part of a recording, in seconds from its start."""

from __future__ import annotations

import dataclasses
from math import inf, nan
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.cli import main
from icalib.data.measurements import ImuStream
from icalib.data.recordings import open_all, open_recording
from icalib.data.stamps import Window, start_of
from icalib.errors import RecordingError
from icalib.pipeline import calibrate
from icalib.rig import Camera, ImuSensor, PoseSensor, TwoSources, Wheels
from icalib.sensors.camera.read import tracks as recorded_tracks
from icalib.sensors.imu.read import ImuHalves
from icalib.sensors.imu.read import readings as imu_readings
from icalib.sensors.imu.spec import class_noise
from icalib.sensors.pose.read import readings as pose_readings
from icalib.sensors.wheels.read import readings as wheel_readings
from icalib.tools.inspection import inspect_recording

IMU = ImuSensor("imu0", "imu0/data.csv", class_noise("consumer"))
S = 1_000_000_000


@each("form", ["euroc", "ros1", "ros2 sqlite3", "mcap"])
def test_of_folders_and_bags(form, tmp_path, truth, write):
    path = write.small(form, tmp_path, truth)
    start = truth.imu_stamps[0]
    begin, end = (truth.image_stamps[3] - start) * 1e-9, (truth.image_stamps[7] - start) * 1e-9
    recording = open_recording(path, begin, end)
    imu = imu_readings(recording, IMU)
    inside = [t for t in truth.imu_stamps if truth.image_stamps[3] <= t < truth.image_stamps[7]]
    assert instance(imu, ImuStream).stamps_ns.tolist() == inside and len(imu.gyro) == len(inside)
    camera = Camera("cam0", "cam0/corners.csv", "eucm", (8, 6))
    topic = recording.image_topic(camera.name, camera.topic)
    assert [f.stamp_ns for f in recording.images(topic)] == truth.image_stamps[3:7]
    assert recording.stamps(topic).tolist() == truth.image_stamps[3:7]
    assert f"only the part from {begin:g} s after its start to {end:g} s is used" in recording.notes()[0]
    assert instance(imu_readings(open_recording(path), IMU), ImuStream).stamps_ns.tolist() == truth.imu_stamps
    late = imu_readings(open_recording(path, begin), IMU)
    assert instance(late, ImuStream).stamps_ns.tolist() == [t for t in truth.imu_stamps if t >= truth.image_stamps[3]]
    with pytest.raises(
        RecordingError, match=r"there is nothing from 900 s to the end, the whole lasts .* correct --from"
    ):
        imu_readings(open_recording(path, 900.0), IMU)


def write_tables(folder: Path, origin: int, apart: int) -> None:
    """Ten seconds of every kind; those of wheels and the pose sensor on another clock, a second later."""
    stamps = origin + S // 10 * np.arange(100)
    files = {
        "imu0/data.csv": "".join(f"{t},1,2,3,4,5,6\n" for t in stamps),
        "imu0/gyro.csv": "".join(f"{t},1,2,3\n" for t in stamps),
        "imu0/accel.csv": "".join(f"{t},4,5,6\n" for t in stamps),
        "cam0/corners.csv": "".join(f"{t + S},0,{k},{k},2\n" for t in stamps for k in range(4)),
        "cam0/tracks.csv": "".join(f"{t + S},7,1,2\n" for t in stamps),
        "wheel0/rates.csv": "".join(f"{t + apart},1,2\n" for t in stamps),
        "mocap0/poses.csv": "".join(f"{t + apart},1,2,3,0,0,0,1\n" for t in stamps + S),
    }
    for name, text in files.items():
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_text(text)
    (folder / "lidar0").mkdir()
    np.savez(
        folder / "lidar0" / "scans.npz",
        stamps_ns=stamps,
        start=np.arange(101),
        offset_s=np.zeros(100, np.float32),
        xyz=np.ones((100, 3), np.float32),
    )


def test_every_table_and_clocks_of_other_origins(tmp_path):
    origin, apart = 1_700_000_000 * S, -1_000_000_000 * S
    write_tables(tmp_path, origin, apart)
    recording = open_recording(tmp_path, 2.0, 4.0)
    camera = Camera("cam0", "cam0/corners.csv", "eucm", (8, 6), tracks="cam0/tracks.csv")
    streams = {
        "imu0": imu_readings(recording, IMU),
        "tracks": recorded_tracks(recording, camera),
        "wheel0": wheel_readings(recording, Wheels("wheel0", "wheel0/rates.csv")),
        "mocap0": pose_readings(recording, PoseSensor("mocap0", "mocap0/poses.csv")),
    }
    for name, stream in streams.items():
        own = origin + (apart if name in ("wheel0", "mocap0") else 0)
        assert (stream.stamps_ns[0] - own, stream.stamps_ns[-1] - own) == (2 * S, 39 * S // 10), name
    halves = imu_readings(recording, dataclasses.replace(IMU, path=TwoSources("imu0/gyro.csv", "imu0/accel.csv")))
    assert isinstance(halves, ImuHalves)
    assert halves.gyro_ns.tolist() == halves.accel_ns.tolist() == streams["imu0"].stamps_ns.tolist()
    assert len(halves.gyro) == len(halves.accel) == 20
    assert recording.stamps("lidar0/scans.npz").tolist() == [origin + 2 * S + k * S // 10 for k in range(20)]
    assert recording.stamps("cam0/corners.csv")[0] == origin + 2 * S


def test_the_start_of_clocks():
    assert start_of((100, 200), [(100, 200), (150, 300), (290, 400), (1000, 1100)]) == 100
    assert start_of((290, 400), [(100, 200), (150, 300), (290, 400), (1000, 1100)]) == 100
    assert start_of((1000, 1100), [(100, 200), (1000, 1100)]) == 1000
    assert start_of((0, 10**18), [(100, 200)]) == 0


def test_pictures(tmp_path):
    for k in range(4):
        (tmp_path / "left").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "left" / f"{1_700_000_000 + k}.{k}00.png"), np.full((6, 8), 7 + k, np.uint8))
    assert open_recording(tmp_path, 1.0, 3.0).stamps("left").tolist() == [
        1_700_000_001 * S + S // 10,
        1_700_000_002 * S + S // 5,
    ]
    for k, path in enumerate(sorted((tmp_path / "left").iterdir())):
        path.rename(path.with_name(f"{k}.png"))
    with pytest.raises(
        RecordingError, match="images without timestamps, so --from and --to cannot be used; leave them out"
    ):
        open_recording(tmp_path, 1.0, 3.0).stamps("left")


@each(
    ("start_s", "end_s", "words"),
    [
        (-1.0, inf, "--from must be seconds after the start of the recording, not -1"),
        (nan, inf, "--from must be seconds"),
        (inf, inf, "--from must be seconds"),
        (5.0, 5.0, r"--to must be seconds after --from \(5\), not 5"),
        (5.0, nan, "--to must be seconds"),
    ],
)
def test_what_is_no_part(start_s, end_s, words, tmp_path):
    with pytest.raises(RecordingError, match=words):
        Window(start_s, end_s)
    with pytest.raises(RecordingError, match=words):
        open_recording(tmp_path, start_s, end_s)


def test_the_command_line(tmp_path, truth, write, capsys):
    path = write.small("mcap", tmp_path, truth)
    rig = tmp_path / "rig.yaml"
    rig.write_text(
        "sensors:\n  imu0: {type: imu}\n  cam0: {type: camera, model: eucm, resolution: [8, 6]}\n"
        "target: {type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}\n"
    )
    command = ["calibrate", str(rig), str(path), "-o", str(tmp_path / "out"), "--from"]
    assert main([*command, "3", "--to", "2"]) == 1
    assert capsys.readouterr().err == "icalib: --to must be seconds after --from (3), not 2.\n"
    assert main([*command, "900"]) == 1
    assert "run.mcap: there is nothing from 900 s to the end" in capsys.readouterr().err
    found = inspect_recording(path, end_s=0.2)
    counts = [s.timing.count for s in found.streams if s.timing is not None]
    assert counts == [
        len([t for t in of if t < truth.imu_stamps[0] + S // 5])
        for of in (truth.image_stamps, truth.image_stamps, truth.imu_stamps)
    ]
    assert main(["inspect", str(path), "--to", "0.2", "--quiet"]) == 0
    opened = open_all(path, 0.1, 0.2)
    with pytest.raises(RecordingError, match="start_s and end_s do not apply to an opened recording"):
        calibrate(rig, list(opened.values()), start_s=0.1)
