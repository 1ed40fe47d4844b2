"""Folders of pictures without a clock: the number in a name says which were taken together."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.data.measurements import ImuStream
from icalib.data.recordings import FolderRecording, PictureFolder, open_recording
from icalib.errors import RecordingError
from icalib.rig import Camera, ImuNoise, ImuSensor
from icalib.sensors.imu.read import readings as imu_readings
from icalib.tools.inspection import find_sources


def picture(path: Path, grey: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((6, 8), grey, np.uint8)
    image[0] = np.arange(8)
    cv2.imwrite(str(path), image)


def camera(name: str, topic: str | None = None) -> Camera:
    return Camera(name, f"{name}/corners.csv", "eucm", (8, 6), topic=topic)


def greys(recording, name: str, topic: str | None = None) -> list[tuple[int, int]]:
    found = recording.images(recording.image_topic(name, topic))
    return [(f.stamp_ns // 1_000_000_000, int(f.image[3, 3])) for f in found]


def test_a_folder_for_each_camera(tmp_path):
    for i in (2, 10, 1):
        picture(tmp_path / "left" / f"IMG_{i:04d}.png", 10 * i)
        picture(tmp_path / "right" / f"{i}.png", 10 * i + 1)
    recording = open_recording(tmp_path)
    assert isinstance(recording, PictureFolder)
    assert [(t.name, t.count) for t in recording.topics()] == [("left", 3), ("right", 3)]
    assert greys(recording, "left") == [(1, 10), (2, 20), (10, 100)]
    assert greys(recording, "right") == [(1, 11), (2, 21), (10, 101)]
    assert len(recording.files()) == 6


def test_one_folder_is_one_camera(tmp_path):
    for i in range(3):
        picture(tmp_path / f"DSC{i}.png", 50 + i)
    assert greys(open_recording(tmp_path), "anything") == [(0, 50), (1, 51), (2, 52)]


def test_a_pattern_for_each_camera(tmp_path):
    for i in range(12):
        picture(tmp_path / "images" / f"{i}_0.png", 10 + i)
        picture(tmp_path / "images" / f"{i}_1.png", 30 + i)
    recording = open_recording(tmp_path)
    assert greys(recording, "cam0", "images/*_0.png") == [(i, 10 + i) for i in range(12)]
    assert greys(recording, "cam1", "images/*_1.png") == [(i, 30 + i) for i in range(12)]


def test_wrong_names_are_said(tmp_path):
    picture(tmp_path / "a" / "first.png", 1)
    with pytest.raises(RecordingError, match=r"the name of .*first\.png has neither a number"):
        list(open_recording(tmp_path).payloads("a"))
    (tmp_path / "a" / "first.png").unlink()
    picture(tmp_path / "a" / "x_1.png", 1)
    picture(tmp_path / "a" / "y_1.png", 2)
    with pytest.raises(RecordingError, match="have the same number, 1"):
        list(open_recording(tmp_path).payloads("a"))
    assert [(t.name, t.count, t.first_ns) for t in open_recording(tmp_path).topics()] == [("a", 2, None)]
    with pytest.raises(RecordingError, match=r"has no images b/\*\.png"):
        next(iter(PictureFolder(tmp_path).payloads("b/*.png")))


@each(
    ("left", "right", "names"),
    [
        ("left{}.png", "right{}.png", ("left", "right")),
        ("left-{:04d}.bmp", "right-{:04d}.bmp", ("cam0", "cam1")),
        ("{:03d}_cam0.pgm", "{:03d}_cam1.pgm", None),
    ],
)
@each("folder", ["", "images"])
def test_pictures_of_two_cameras_in_one_folder(tmp_path, left, right, names, folder):
    for i in range(9, 13):
        picture(tmp_path / folder / left.format(i), 10 + i)
        picture(tmp_path / folder / right.format(i), 30 + i)
    recording = open_recording(tmp_path)
    topics = [t.name for t in recording.topics()]
    assert len(topics) == 2 and all("*" in t for t in topics)
    first, second = [(n, None) for n in names] if names else [("a", topics[0]), ("b", topics[1])]
    assert greys(recording, *first) == [(i, 10 + i) for i in range(9, 13)]
    assert greys(recording, *second) == [(i, 30 + i) for i in range(9, 13)]


def test_names_of_one_camera_that_differ_are_one_folder(tmp_path):
    for i, name in enumerate(["IMG_0001.png", "IMG_0002.png", "DSC_0003.png", "IMG_0004.png"]):
        picture(tmp_path / name, 10 + i)
    assert [t.name for t in open_recording(tmp_path).topics()] == ["."]


def test_single_pictures_that_are_odd_are_left_out_and_named(tmp_path):
    for i in range(12):
        picture(tmp_path / f"p{i}.png", 10 + i)
    cv2.imwrite(str(tmp_path / "p3.png"), np.full((20, 30), 9, np.uint8))
    (tmp_path / "p5.png").write_text("not an image\n")
    (tmp_path / "p7.png").write_bytes((tmp_path / "p7.png").read_bytes()[:40])
    recording = open_recording(tmp_path)
    assert [n for n, _ in greys(recording, "cam0")] == [i for i in range(12) if i not in (3, 5, 7)]
    notes = " ".join(recording.notes())
    for reason, name in (("another size than 8 x 6 px", "p3"), ("are not images", "p5"), ("are damaged", "p7")):
        assert f"{reason} were left out, the first {name}.png." in notes


@each(
    ("names", "odd"),
    [
        ("IMG_000{}.png", "preview.png"),
        ("IMG_000{}.png", "99999999999999999999.png"),
        ("170000000{}000000000.png", "preview.png"),
        ("170000000{}000000000.png", "preview2.png"),
    ],
)
def test_a_picture_without_a_number_is_left_out_and_named(tmp_path, names, odd):
    for i in range(4):
        picture(tmp_path / names.format(i), 10 + i)
    picture(tmp_path / odd, 1)
    recording = open_recording(tmp_path)
    assert [(t.name, t.count) for t in recording.topics()] == [(".", 4)]
    assert [grey for _, grey in greys(recording, "cam0")] == [10, 11, 12, 13]
    assert f"1 of 5 images were left out, the first {odd}: its name" in " ".join(recording.notes())


def test_a_picture_without_a_number_is_of_no_pattern(tmp_path):
    for i in range(4):
        picture(tmp_path / f"left{i}.png", 10 + i)
        picture(tmp_path / f"right{i}.png", 30 + i)
    picture(tmp_path / "preview.png", 1)
    assert [t.name for t in open_recording(tmp_path).topics()] == ["left*.png", "right*.png"]


def test_a_picture_without_a_stamp_beside_kalibrs_and_numbered_ones(tmp_path):
    for i in range(4):
        picture(tmp_path / "cam0" / "data" / f"{50_000_000 * i}.png", 10 + i)
    picture(tmp_path / "cam0" / "data" / "preview.png", 1)
    recording = FolderRecording(tmp_path)
    assert len(greys(recording, "cam0")) == 4
    assert "1 of 5 images were left out, the first preview.png" in " ".join(recording.notes())


def test_an_imu_needs_a_clock(tmp_path):
    picture(tmp_path / "1.png", 1)
    with pytest.raises(RecordingError, match="Remove imu0 from the rig file"):
        imu_readings(open_recording(tmp_path), ImuSensor("imu0", "imu0/data.csv", ImuNoise(1, 1, 1, 1)))


STAMPS = [1_700_000_000_123_456_789 + 100_000_000 * k for k in range(4)]
NAMES = {
    "ns": [f"{t}" for t in STAMPS],
    "us": [f"frame_{t // 1000}" for t in STAMPS],
    "ms": [f"{t // 1_000_000}" for t in STAMPS],
    "s": [f"left-{t // 10**9}.{t % 10**9:09d}" for t in STAMPS],
}


@each("unit", NAMES)
def test_names_that_are_stamps(tmp_path, unit):
    digits = {"ms": 1_000_000, "us": 1000}.get(unit, 1)
    for k, name in enumerate(NAMES[unit]):
        picture(tmp_path / "left" / f"{name}.png", 10 + k)
        picture(tmp_path / "right" / f"{name}.png", 30 + k)
    recording = open_recording(tmp_path)
    for side in ("left", "right"):
        assert recording.stamps(side).tolist() == [t // digits * digits for t in STAMPS]
    with pytest.raises(RecordingError, match=r"holds images, and no data of imu0; add the table imu0/data\.csv"):
        imu_readings(recording, ImuSensor("imu0", "imu0/data.csv", ImuNoise(1, 1, 1, 1)))
    picture(tmp_path / "left" / f"x{NAMES[unit][0].removeprefix('left-').removeprefix('frame_')}.png", 1)
    with pytest.raises(RecordingError, match="have the same stamp, 1"):
        recording.stamps("left")


def test_a_pattern_whose_star_is_a_stamp(tmp_path):
    for k, t in enumerate(STAMPS):
        picture(tmp_path / f"{t}_0.png", 10 + k)
        picture(tmp_path / f"{t}_1.png", 30 + k)
    assert open_recording(tmp_path).stamps("*_1.png").tolist() == STAMPS


def test_dates_of_a_camera_are_no_stamps(tmp_path):
    for k in range(3):
        picture(tmp_path / f"IMG_20240131_12345{k}.png", 10 + k)
    assert open_recording(tmp_path).stamps(".").tolist() == [123450 * 10**9, 123451 * 10**9, 123452 * 10**9]


def test_kalibrs_folder(tmp_path):
    for k, t in enumerate(STAMPS):
        picture(tmp_path / "cam0" / f"{t}.png", 10 + k)
    head = "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z\n"
    (tmp_path / "imu0.csv").write_text(head + "".join(f"{t},1,2,3,4,5,6\n" for t in STAMPS))
    recording = open_recording(tmp_path)
    assert isinstance(recording, FolderRecording)
    assert [f.stamp_ns for f in recording.images("cam0")] == STAMPS
    imu = imu_readings(recording, ImuSensor("imu0", "imu0/data.csv", ImuNoise(1, 1, 1, 1)))
    assert instance(imu, ImuStream).stamps_ns.tolist() == STAMPS and imu.accel[0].tolist() == [4, 5, 6]
    assert [(t.name, t.kind, t.count) for t in recording.topics()] == [("cam0", "image", 4), ("imu0.csv", "imu", 4)]
    assert recording.stamps("imu0.csv").tolist() == STAMPS
    found = find_sources(recording.topics())
    assert list(found.of("camera")) == ["cam0"] and list(found.of("imu")) == ["imu0"]


def test_a_table_of_something_else_beside_pictures(tmp_path):
    picture(tmp_path / "left" / "1.png", 1)
    (tmp_path / "notes.csv").write_text("picture,good\n1,yes\n")
    assert isinstance(open_recording(tmp_path), PictureFolder)


def test_folders_of_tables_and_of_euroc_stay_what_they_are(tmp_path):
    picture(tmp_path / "cam0" / "data" / "1000.png", 1)
    picture(tmp_path / "notes.png", 1)
    assert isinstance(open_recording(tmp_path), FolderRecording)
