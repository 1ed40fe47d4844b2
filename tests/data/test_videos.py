"""Video files: their frames are images, with the stamps of a table beside them, or their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.cases import each
from tests.remarks import named

from icalib.data.recordings import decode, open_recording
from icalib.errors import RecordingError
from icalib.geometry.targets import Markers
from icalib.rig import Camera
from icalib.sensors.camera.read.detected_corners import find_corners
from icalib.tools.inspection import inspect_recording

cv2 = pytest.importorskip("cv2")
SIZE, FRAMES, RATE = (64, 48), 12, 20.0
ORIGIN_NS = 1_700_000_000_000_000_000
CAMERA = Camera("cam0", "cam0/corners.csv", "pinhole-radtan", SIZE)


def write_video(path: Path, frames: int = FRAMES) -> Path:
    """Each frame is brighter than the one before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    code = cv2.VideoWriter_fourcc(*("MJPG" if path.suffix == ".avi" else "mp4v"))
    video = cv2.VideoWriter(str(path), code, RATE, SIZE)
    assert video.isOpened()
    for k in range(frames):
        video.write(np.full((SIZE[1], SIZE[0], 3), 20 + 15 * k, np.uint8))
    video.release()
    return path


def times(path: Path, n: int, header: str = "") -> np.ndarray:
    """Stamps at an uneven rate in a table beside the video."""
    stamps = ORIGIN_NS + 50_000_000 * np.arange(n) + 3_000_000 * (np.arange(n) % 3)
    path.write_text(header + "".join(f"{t},{k}\n" for k, t in enumerate(stamps.tolist())))
    return stamps


@each("name", ["cam0.mp4", "cam0.avi", "cam0/video.mp4", "mav0/cam0.mp4"])
def test_frames_are_images_with_the_stamps_of_the_video(tmp_path, name):
    write_video(tmp_path / name)
    recording = open_recording(tmp_path)
    topic = recording.image_topic(CAMERA.name, CAMERA.topic)
    assert topic == name
    found = list(recording.payloads(topic))
    np.testing.assert_allclose([p.stamp_ns for p in found], 5e7 * np.arange(FRAMES), atol=1e6)
    grey = [float(decode(p).mean()) for p in found]
    np.testing.assert_allclose(grey, 20 + 15 * np.arange(FRAMES), atol=3.0)
    assert recording.files() == [tmp_path / name]


@pytest.mark.parametrize("ending", [".csv", ".txt"])
def test_a_table_beside_the_video_has_the_stamps(tmp_path, ending):
    write_video(tmp_path / "cam0.mp4")
    stamps = times(tmp_path / f"cam0{ending}", FRAMES, "#timestamp [ns],frame\n")
    recording = open_recording(tmp_path)
    assert [p.stamp_ns for p in recording.payloads("cam0.mp4")] == stamps.tolist()
    assert recording.stamps("cam0.mp4").tolist() == stamps.tolist()
    (topic,) = [t for t in recording.topics() if t.kind == "image"]
    assert (topic.count, topic.first_ns, topic.last_ns) == (FRAMES, stamps[0], stamps[-1])


def test_a_part_of_the_video(tmp_path):
    write_video(tmp_path / "cam0.mp4")
    times(tmp_path / "cam0.csv", FRAMES)
    part = list(open_recording(tmp_path, 0.2, 0.41).payloads("cam0.mp4"))
    assert [p.name for p in part] == [f"frame {k}" for k in range(4, 9)]


@pytest.mark.parametrize(
    ("rows", "words"), [(FRAMES - 2, f"has more than {FRAMES - 2} frames"), (FRAMES + 1, f"has {FRAMES} frames")]
)
def test_a_table_of_another_length_is_refused(tmp_path, rows, words):
    write_video(tmp_path / "cam0.mp4")
    times(tmp_path / "cam0.csv", rows)
    with pytest.raises(RecordingError, match=f"{words}, and its table {rows} stamps"):
        list(open_recording(tmp_path).payloads("cam0.mp4"))


@each(
    ("table", "words"),
    [
        ("100\n150\nlate\n", r"cam0\.csv:3: 'late' has no stamp"),
        ("frame\n" + "\n".join(map(str, range(FRAMES))), r"cam0\.csv counts frames and has no stamps"),
        ("notes on this video\n", r"cam0\.csv holds no stamps"),
    ],
)
def test_a_table_that_holds_no_stamps_is_named_when_it_is_read(tmp_path, table, words):
    write_video(tmp_path / "cam0.mp4")
    (tmp_path / "cam0.csv").write_text(table)
    recording = open_recording(tmp_path)
    assert [t.count for t in recording.topics() if t.kind == "image"] == [1]
    with pytest.raises(RecordingError, match=words):
        list(recording.payloads("cam0.mp4"))


def test_a_table_of_another_name_is_found_by_its_number_of_rows(tmp_path):
    """Beside tables of other lengths, of another video, and without order."""
    write_video(tmp_path / "cam0.mp4")
    write_video(tmp_path / "cam1.mp4")
    times(tmp_path / "cam1.csv", FRAMES)
    times(tmp_path / "short.csv", FRAMES - 1)
    (tmp_path / "sizes.txt").write_text("".join(f"{(7 * k) % 12}\n" for k in range(FRAMES)))
    stamps = 7 + times(tmp_path / "frames.csv", FRAMES, "#time [ns],frame\n")
    (tmp_path / "frames.csv").write_text("time_ns\n" + "\n".join(map(str, stamps.tolist())))
    recording = open_recording(tmp_path)
    assert [p.stamp_ns for p in recording.payloads("cam0.mp4")] == stamps.tolist()
    assert "frames.csv" in named("video_stamps_from_table", recording.notes())
    assert set(recording.files()) == {tmp_path / "cam0.mp4", tmp_path / "frames.csv"}
    times(tmp_path / "again.csv", FRAMES)
    with pytest.raises(RecordingError, match=r"again\.csv and frames\.csv both .* rename the right one to"):
        list(open_recording(tmp_path).payloads("cam0.mp4"))


def test_the_header_names_the_column_of_the_stamps(tmp_path):
    write_video(tmp_path / "cam0.mp4")
    rows = "".join(f"{k},{ORIGIN_NS + 50_000_000 * k}\n" for k in range(FRAMES))
    (tmp_path / "cam0.csv").write_text("frame,timestamp_ns\n" + rows)
    stamps = open_recording(tmp_path).stamps("cam0.mp4")
    assert stamps.tolist() == [ORIGIN_NS + 50_000_000 * k for k in range(FRAMES)]


def test_a_file_that_is_no_video_is_refused(tmp_path):
    (tmp_path / "cam0.mp4").write_bytes(b"\0\0\0 ftypisom" + bytes(100))
    recording = open_recording(tmp_path)
    with pytest.raises(RecordingError, match=r"cam0\.mp4 cannot be decoded as a video; copy it again"):
        list(recording.payloads("cam0.mp4"))
    assert any("cannot be decoded as a video" in f.sentence for f in inspect_recording(tmp_path).findings)


def test_a_target_is_found_in_a_video(tmp_path, monkeypatch):
    monkeypatch.setenv("ICALIB_CACHE", str(tmp_path / "cache"))
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    video = cv2.VideoWriter(str(tmp_path / "cam0.avi"), cv2.VideoWriter_fourcc(*"MJPG"), RATE, (240, 160))
    for k in range(4):
        image = np.full((160, 240), 200, np.uint8)
        image[30:110, 40 + 5 * k : 120 + 5 * k] = cv2.aruco.generateImageMarker(family, 3, 80)
        video.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    video.release()
    camera = Camera("cam0", "", "pinhole-radtan", (240, 160))
    corners, _ = find_corners(open_recording(tmp_path), camera, Markers("tag36h11", 0.1, (3,)))
    assert np.diff(corners.start).tolist() == [4] * 4
    moved = corners.uv.reshape(4, 4, 2)[1:] - corners.uv.reshape(4, 4, 2)[:-1]
    np.testing.assert_allclose(moved, np.broadcast_to([5.0, 0.0], moved.shape), atol=0.2)


def test_two_videos_are_told_by_their_names(tmp_path):
    for name in ("cam0.mp4", "cam1.mp4"):
        write_video(tmp_path / name)
    recording = open_recording(tmp_path)
    assert recording.image_topic(CAMERA.name, CAMERA.topic) == "cam0.mp4"
    found = inspect_recording(tmp_path)
    assert list(found.sources.of("camera")) == ["cam0", "cam1"]
