"""Folders of pictures without a clock: the number in a name says which were taken together."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from icalib.errors import RecordingError
from icalib.recordings import FolderRecording, PictureFolder, open_recording
from icalib.rig import Camera, ImuNoise, ImuSensor


def picture(path: Path, grey: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image = np.full((6, 8), grey, np.uint8)
    image[0] = np.arange(8)
    cv2.imwrite(str(path), image)


def camera(name: str, topic: str | None = None) -> Camera:
    return Camera(name, f"{name}/corners.csv", "eucm", (8, 6), topic=topic)


def greys(recording, name: str, topic: str | None = None) -> list[tuple[int, int]]:
    found = recording.images(recording.image_topic(camera(name, topic)))
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
    with pytest.raises(RecordingError, match=r"first\.png has no number in its name"):
        list(open_recording(tmp_path).payloads("a"))
    (tmp_path / "a" / "first.png").unlink()
    picture(tmp_path / "a" / "x_1.png", 1)
    picture(tmp_path / "a" / "y_1.png", 2)
    with pytest.raises(RecordingError, match="have the same number, 1"):
        list(open_recording(tmp_path).payloads("a"))
    assert [(t.name, t.count, t.first_ns) for t in open_recording(tmp_path).topics()] == [("a", 2, None)]
    with pytest.raises(RecordingError, match=r"has no pictures b/\*\.png"):
        next(iter(PictureFolder(tmp_path).payloads("b/*.png")))


def test_an_imu_needs_a_clock(tmp_path):
    picture(tmp_path / "1.png", 1)
    with pytest.raises(RecordingError, match="take the IMU out of the rig file"):
        open_recording(tmp_path).imu(ImuSensor("imu0", "imu0/data.csv", ImuNoise(1, 1, 1, 1)))


def test_folders_of_tables_and_of_euroc_stay_what_they_are(tmp_path):
    picture(tmp_path / "cam0" / "data" / "1000.png", 1)
    picture(tmp_path / "notes.png", 1)
    assert isinstance(open_recording(tmp_path), FolderRecording)
