"""EuRoC's images: tables and files that are missing, empty or wrong."""

from __future__ import annotations

import pytest
from tests.cases import each

from icalib.data.recordings import open_recording
from icalib.errors import RecordingError


def complaint(call) -> str:
    with pytest.raises(RecordingError) as error:
        call()
    sentence = str(error.value)
    assert "\n" not in sentence and sentence.endswith(".")
    return sentence


def test_missing_and_empty_images(tmp_path, truth, write):
    root = write.euroc(tmp_path, truth)
    files = sorted((root / "mav0/cam0/data").iterdir())
    files[3].unlink()
    files[7].write_bytes(b"")
    recording = open_recording(root)
    kept = [t for k, t in enumerate(truth.image_stamps) if k not in (3, 7)]
    assert [f.stamp_ns for f in recording.images("cam0")] == kept
    assert f"2 of 12 images are missing or empty, the first is {files[3].name}" in recording.notes()[0]


def test_without_table_the_names_are_stamps(tmp_path, truth, write):
    root = write.euroc(tmp_path, truth)
    (root / "mav0/cam0/data.csv").unlink()
    assert [f.stamp_ns for f in open_recording(root).images("cam0")] == truth.image_stamps


def test_names_that_are_no_stamps(tmp_path, truth, write):
    root = write.euroc(tmp_path, truth)
    (root / "mav0/cam0/data.csv").unlink()
    (root / "mav0/cam0/data/left_1.png").touch()
    recording = open_recording(root)
    assert [f.stamp_ns for f in recording.images("cam0")] == truth.image_stamps
    assert "1 of 13 images were left out, the first left_1.png" in " ".join(recording.notes())
    for k in range(2, 14):
        (root / f"mav0/cam0/data/left_{k}.png").touch()
    sentence = complaint(lambda: list(open_recording(root).images("cam0")))
    assert "cam0 has no data.csv, and the name of left_1.png is not a stamp in ns" in sentence


@each("line", ["12", "12,", "1.5,a.png", "x,a.png"])
def test_line_that_is_none(line, tmp_path, truth, write):
    root = write.euroc(tmp_path, truth)
    table = root / "mav0/cam0/data.csv"
    table.write_text(table.read_text() + line + "\n")
    sentence = complaint(lambda: list(open_recording(root).images("cam0")))
    assert f"cam0/data.csv:14: '{line}' is not t [ns],file name; correct the line" in sentence


def test_table_without_rows(tmp_path, truth, write):
    root = write.euroc(tmp_path, truth)
    (root / "mav0/cam0/data.csv").write_text("#timestamp [ns],filename\n")
    assert "cam0/data.csv holds no rows" in complaint(lambda: list(open_recording(root).images("cam0")))


def test_table_that_cannot_be_read(tmp_path, truth, write):
    root = write.euroc(tmp_path, truth)
    (root / "mav0/cam0/data.csv").write_bytes(b"\xff\xfe1,\0")
    assert "cam0/data.csv cannot be read" in complaint(lambda: list(open_recording(root).images("cam0")))


def test_names_with_another_ending(tmp_path, truth, write):
    root = write.euroc(tmp_path, truth)
    table, data = root / "mav0/cam0/data.csv", root / "mav0/cam0/data"
    table.write_text(table.read_text().replace(".png", ".jpg"))
    recording = open_recording(root)
    assert [f.stamp_ns for f in recording.images("cam0")] == truth.image_stamps
    assert "12 images were found under the same name with another ending" in recording.notes()[0]
    table.write_text(table.read_text().replace(",", ",away_"))
    sentence = complaint(lambda: list(open_recording(root).images("cam0")))
    assert f"data.csv names away_{truth.image_stamps[0]}.jpg, and " in sentence
    assert "none of its 12 images is there; correct the names, or copy the images" in sentence
    assert data.is_dir()


@each("separator", [",", "; ", "\t", " "])
def test_a_table_in_other_units(tmp_path, truth, write, separator):
    root = write.euroc(tmp_path, truth)
    files = sorted((root / "mav0/cam0/data").iterdir())
    rows = [f"{t // 10**9}.{t % 10**9:09d}{separator}{f.name}" for t, f in zip(truth.image_stamps, files, strict=True)]
    (root / "mav0/cam0/data.csv").write_text("\n".join(["timestamp filename", *rows]))
    assert [f.stamp_ns for f in open_recording(root).images("cam0")] == truth.image_stamps
