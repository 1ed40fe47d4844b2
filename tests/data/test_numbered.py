"""Pictures that have numbers but no stamps, beside poses of a robot's hand: which belong together."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.cases import each

from icalib.data.recordings import open_recording
from icalib.errors import RecordingError
from icalib.rig import Camera, PoseSensor, TableLayout
from icalib.sensors.pose.read import readings as pose_readings

START, STEP = 1_700_000_000_500_000_000, 2_000_000_000
HAND = PoseSensor("hand", "hand/poses.csv")
CAMERA = Camera("cam0", "cam0/corners.csv", "pinhole-radtan", (16, 12))


def pictures(folder: Path, names: list[str]) -> None:
    folder.mkdir(parents=True)
    for k, name in enumerate(names):
        cv2.imwrite(str(folder / name), np.full((12, 16), 20 + k, np.uint8))


def poses(path: Path, rows: int, head: str = "t,x,y,z,qx,qy,qz,qw\n", separator: str = ",", unit: int = 1) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    stamps = [START + k * STEP for k in range(rows)]
    texts = [str(t) if unit == 1 else f"{t // unit}.{t % unit:09d}" for t in stamps]
    lines = [[text, str(0.1 * k), "0", "0.3", "0", "0", "0", "1"] for k, text in enumerate(texts)]
    path.write_text(head + "".join(separator.join(line) + "\n" for line in lines))


def row_of_each(root: Path) -> list[int]:
    """By its stamp, and by what is in it: which row each picture has."""
    recording = open_recording(root)
    topic = recording.image_topic(CAMERA.name, CAMERA.topic)
    stamps = recording.stamps(topic)
    seen = [(f.stamp_ns, int(f.image[0, 0]) - 20) for f in recording.images(topic)]
    assert [t for t, _ in seen] == stamps.tolist() and [k for _, k in seen] == list(range(len(seen)))
    return ((stamps - START) // STEP).tolist()


NAMES = {
    "padded": lambda k: f"{k:04d}.png",
    "plain": lambda k: f"{k}.png",
    "word": lambda k: f"image_{k}.jpg",
    "two numbers": lambda k: f"cam0_{k:06d}.png",
}


@each("name", NAMES)
@each("place", ["cam0", "cam0/data"])
@each("first", [0, 1, 7])
def test_as_many_pictures_as_poses(tmp_path, name, place, first):
    """In order; ten comes after nine whatever the names' alphabetical order is."""
    pictures(tmp_path / place, [NAMES[name](k) for k in range(first, first + 12)])
    poses(tmp_path / "hand" / "poses.csv", 12)
    assert row_of_each(tmp_path) == list(range(12))
    recording = open_recording(tmp_path)
    assert pose_readings(recording, HAND).stamps_ns.tolist() == recording.stamps("cam0").tolist()
    list(recording.images("cam0"))
    (note,) = [n for n in recording.notes() if n.name == "images_stamped_by_rows"]
    assert "12 images" in note and "in order" in note


@pytest.mark.parametrize("first", [0, 1])
def test_pictures_that_are_missing_leave_their_rows(tmp_path, first):
    kept = [0, 1, 3, 4, 8, 9]
    pictures(tmp_path / "cam0", [f"{first + k}.png" for k in kept])
    poses(tmp_path / "hand" / "poses.csv", 11)
    assert row_of_each(tmp_path) == kept


@pytest.mark.parametrize("name", ["poses.tum", "poses.txt"])
def test_rows_of_tum(tmp_path, name):
    pictures(tmp_path / "cam0", [f"{k}.png" for k in range(5)])
    poses(tmp_path / "hand" / name, 5, "# t x y z qx qy qz qw\n", " ", 10**9)
    assert row_of_each(tmp_path) == list(range(5))


def test_a_row_that_is_no_pose_counts_as_one(tmp_path):
    pictures(tmp_path / "cam0", [f"{k}.png" for k in range(20)])
    path = tmp_path / "hand" / "poses.csv"
    poses(path, 20)
    lines = path.read_text().splitlines()
    lines[5] = lines[5].replace("0.3", "nan")
    path.write_text("\n".join(lines) + "\n")
    assert row_of_each(tmp_path) == list(range(20))
    assert len(pose_readings(open_recording(tmp_path), HAND).stamps_ns) == 19


@each("kept", [range(12), [0, 1, 2, 5, 8, 9, 11]])
@each("bad", [0, 5, 11])
@each("stamp", ["", "x17", "nan", "9" * 25])
def test_a_row_whose_stamp_cannot_be_read_leaves_its_picture_alone(tmp_path, kept, bad, stamp):
    """All other pictures keep their rows, paired in order or by number."""
    pictures(tmp_path / "cam0", [f"{k}.png" for k in kept])
    path = tmp_path / "hand" / "poses.csv"
    poses(path, 12)
    lines = path.read_text().splitlines()
    lines[1 + bad] = stamp + lines[1 + bad][lines[1 + bad].index(",") :]
    path.write_text("\n".join(lines) + "\n")
    recording = open_recording(tmp_path)
    seen = {kept[int(f.image[0, 0]) - 20]: (f.stamp_ns - START) // STEP for f in recording.images("cam0")}
    assert seen == {row: row for row in kept if row != bad}
    notes = " ".join(recording.notes())
    assert f"poses.csv:{2 + bad}: " in notes
    assert (f"1 of {len(kept)} images are ignored, the first is {bad}.png" in notes) == (bad in kept)


def test_many_rows_without_a_stamp_are_refused(tmp_path):
    pictures(tmp_path / "cam0", [f"{k}.png" for k in range(6)])
    path = tmp_path / "hand" / "poses.csv"
    poses(path, 6)
    path.write_text(path.read_text().replace(str(START + 2 * STEP), "?"))
    with pytest.raises(RecordingError, match=r"poses\.csv:4: t \[ns\] is '\?', which is not a number"):
        row_of_each(tmp_path)


def test_parts_of_a_stamp_that_cannot_be_read(tmp_path):
    """Seconds and nanoseconds are joined after the rows are read, and rows are left out there, too."""
    pictures(tmp_path / "cam0", [f"{k}.png" for k in range(12)])
    stamps = [divmod(START + k * STEP, 10**9) for k in range(12)]
    lines = [f"{s},{ns if k != 4 else 3 * 10**9},{0.1 * k},0,0.3,0,0,0,1" for k, (s, ns) in enumerate(stamps)]
    (tmp_path / "hand").mkdir()
    (tmp_path / "hand" / "poses.csv").write_text("\n".join(["secs,nsecs,x,y,z,qx,qy,qz,qw", *lines]) + "\n")
    found = [(f.stamp_ns - START) // STEP for f in open_recording(tmp_path).images("cam0")]
    assert found == [k for k in range(12) if k != 4]


@each("unit", ["ms", "us", "s"])
@each("place", ["hand/poses.csv", "arm/flange.csv"])
@each("split", [False, True])
def test_stamps_are_read_as_the_rig_file_describes_the_poses(tmp_path, unit, place, split):
    """The stamp is not the first column, no name of it is known, and its rate would be one in nanoseconds, too."""
    pictures(tmp_path / "cam0", [f"{k}.png" for k in range(8)])
    names = ["x", "y", "z", "qx", "qy", "qz", "qw", "extra", *(["secs", "nsecs"] if split else ["when"])]
    stamps = [f"{1_000 + 2 * k},5" if split else str(10**9 + 1_000_000 * k) for k in range(8)]
    rows = [f"{0.1 * k},0,0.3,0,0,0,1,7,{stamp}" for k, stamp in enumerate(stamps)]
    path = tmp_path / place
    path.parent.mkdir()
    path.write_text("\n".join([",".join(names), *rows]) + "\n")
    hand = PoseSensor("hand", place, layout=TableLayout((*names[8:], *names[:7]), None if split else unit))
    recording = open_recording(tmp_path)
    recording.use_layouts([hand])
    found = recording.stamps(recording.image_topic(CAMERA.name, CAMERA.topic))
    np.testing.assert_array_equal(found, pose_readings(recording, hand).stamps_ns)
    scale = {"s": 10**9, "ms": 10**6, "us": 10**3}[unit]
    assert np.diff(found).tolist() == [2 * 10**9 if split else scale * 1_000_000] * 7


def test_stamps_as_names_stay_stamps(tmp_path):
    stamps = [START + k * STEP for k in range(6)]
    pictures(tmp_path / "cam0", [f"{t}.png" for t in stamps])
    pictures(tmp_path / "cam1" / "data", [f"{1_000_000_000 * k}.png" for k in range(1, 7)])
    poses(tmp_path / "hand" / "poses.csv", 9)
    recording = open_recording(tmp_path)
    assert recording.stamps("cam0").tolist() == stamps
    assert recording.stamps("cam1").tolist() == [1_000_000_000 * k for k in range(1, 7)]


@pytest.mark.parametrize(
    ("names", "rows", "words"),
    [
        (["1.png", "2.png", "9.png"], 5, "up to number 9, and .*poses.csv has 5 rows; number each image as the row"),
        (["a1.png", "b1.png", "a2.png"], 5, "have the same number, 1; number each image as the row of its pose"),
    ],
)
def test_pictures_without_a_row_are_refused(tmp_path, names, rows, words):
    pictures(tmp_path / "cam0", names)
    poses(tmp_path / "hand" / "poses.csv", rows)
    with pytest.raises(RecordingError, match=words):
        row_of_each(tmp_path)
