"""Files with one point cloud each, and folders of one image and one cloud a stop."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from tests.cases import each
from tests.data.test_pictures import picture

from icalib.data.recordings import PictureFolder, open_recording
from icalib.errors import RecordingError
from icalib.rig import Lidar
from icalib.sensors.lidar.read import READER, scans
from icalib.sensors.lidar.read.cloud_files import read_cloud

POINTS = np.random.default_rng(1).uniform(-5.0, 5.0, (300, 3)).astype("<f4")


def pcd(encoding: str, body: bytes) -> bytes:
    head = "# .PCD v0.7\nVERSION 0.7\nFIELDS intensity x y z normal\nSIZE 1 4 4 4 4\nTYPE U F F F F\nCOUNT 1 1 1 1 2\n"
    return f"{head}WIDTH {len(POINTS)}\nHEIGHT 1\nPOINTS {len(POINTS)}\nDATA {encoding}\n".encode() + body


def ply(encoding: str, body: bytes) -> bytes:
    fields = "property double x\nproperty double y\nproperty double z\nproperty uchar red\n"
    head = f"ply\nformat {encoding} 1.0\nelement vertex {len(POINTS)}\n{fields}element face 0\nend_header\n"
    return head.encode() + body


def text(line: str) -> bytes:
    return "".join(line.format(*p) + "\n" for p in POINTS.tolist()).encode()


def rows() -> bytes:
    return b"".join(struct.pack("<B5f", 7, *p, 0.0, 1.0) for p in POINTS.tolist())


def compressed() -> bytes:
    """LZF: literals in runs of 32, except for the constant column, which repeats its first byte in two copies."""
    n = len(POINTS)
    columns = POINTS.T.tobytes() + np.tile(np.array([0.0, 1.0], "<f4"), n).tobytes()
    packed = bytes([0, 7]) + bytes([7 << 5, 255, 0]) + bytes([7 << 5, n - 1 - 264 - 9, 0])
    for a in range(0, len(columns), 32):
        part = columns[a : a + 32]
        packed += bytes([len(part) - 1]) + part
    return struct.pack("<II", len(packed), n + len(columns)) + packed


def doubles(order: str) -> bytes:
    return b"".join(struct.pack(f"{order}3dB", *p, 9) for p in POINTS.tolist())


FILES = {
    "text.pcd": lambda: pcd("ascii", text("7 {:.9g} {:.9g} {:.9g} 0 1")),
    "binary.pcd": lambda: pcd("binary", rows()),
    "compressed.pcd": lambda: pcd("binary_compressed", compressed()),
    "text.ply": lambda: ply("ascii", text("{:.9g} {:.9g} {:.9g} 9")),
    "little.ply": lambda: ply("binary_little_endian", doubles("<")),
    "big.ply": lambda: ply("binary_big_endian", doubles(">")),
    "kitti.bin": lambda: np.column_stack([POINTS, np.zeros(len(POINTS), "<f4")]).astype("<f4").tobytes(),
}


@each("name", FILES)
def test_points_are_read(tmp_path, name):
    (tmp_path / name).write_bytes(FILES[name]())
    np.testing.assert_array_equal(read_cloud(tmp_path / name), POINTS)


@each("name", FILES)
def test_cut_files_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(FILES[name]()[:-70] + b"\n")
    with pytest.raises(RecordingError, match=f"{name} is no complete point cloud .*copy or write it again"):
        read_cloud(tmp_path / name)


def lzf(*control: int, size: int = 17 * 300) -> bytes:
    return pcd("binary_compressed", struct.pack("<II", len(control), size) + bytes(control))


DAMAGED = {
    "literals beyond the end.pcd": lambda: lzf(31, 1, 2),
    "a copy from before the start.pcd": lambda: lzf(7 << 5, 255, 255, 0, *[0] * 60),
    "a copy without its place.pcd": lambda: lzf(0, 7, 7 << 5, *[0] * 60),
    "a copy beyond the end.pcd": lambda: lzf(0, 7, *[7 << 5, 255, 0] * 60),
    "too short.pcd": lambda: lzf(0, 7, *[0, 0] * 40),
    "a size of 4 GiB.pcd": lambda: lzf(0, 7, size=2**32 - 1),
    "huge.pcd": lambda: FILES["binary.pcd"]().replace(b"WIDTH 300", b"WIDTH " + b"9" * 30),
    "negative.pcd": lambda: FILES["binary.pcd"]().replace(b"WIDTH 300", b"WIDTH -1"),
    "of texts.pcd": lambda: FILES["binary.pcd"]().replace(b"TYPE U F", b"TYPE U O"),
    "several x.pcd": lambda: FILES["binary.pcd"]().replace(b"COUNT 1 1 1 1 2", b"COUNT 1 2 2 2 2"),
    "no points.pcd": lambda: pcd("ascii", b"\n"),
    "no format.ply": lambda: FILES["little.ply"]().replace(b"format", b"comment"),
    "other format.ply": lambda: FILES["little.ply"]().replace(b"little", b"middle"),
    "no end.ply": lambda: FILES["little.ply"]().replace(b"end_header", b""),
    "empty.bin": lambda: b"",
}


@each("name", DAMAGED)
def test_damaged_files_are_refused(tmp_path, name):
    (tmp_path / name).write_bytes(DAMAGED[name]())
    with pytest.raises(RecordingError, match="is no complete point cloud"):
        read_cloud(tmp_path / name)


def test_a_header_with_other_line_ends(tmp_path):
    head, end, body = FILES["little.ply"]().partition(b"end_header\n")
    (tmp_path / "a.ply").write_bytes((head + end).replace(b"\n", b"\r\n") + body)
    np.testing.assert_array_equal(read_cloud(tmp_path / "a.ply"), POINTS)


def stops(folder) -> PictureFolder:
    for number in (12, 3, 7):
        picture(folder / f"pose{number}.png", number)
        (folder / f"pose{number}.pcd").write_bytes(pcd("ascii", text("7 {:.9g} {:.9g} {:.9g} 0 1")))
    recording = open_recording(folder)
    assert isinstance(recording, PictureFolder)
    return recording


def test_a_cloud_and_an_image_with_the_same_number_are_of_one_stop(tmp_path):
    recording = stops(tmp_path)
    assert [(t.name, t.kind, t.count) for t in recording.topics()] == [(".", "image", 3), ("*.pcd", "points", 3)]
    stream = scans(recording, Lidar("lidar0", ""))
    assert stream.stamps_ns.tolist() == recording.stamps(".").tolist() == [3e9, 7e9, 12e9]
    assert len(stream.xyz) == 3 * len(POINTS) - 3 * int((np.linalg.norm(POINTS, axis=1) < 0.5).sum())
    assert READER.source(recording, Lidar("lidar0", "")) == recording.topics()[1]


def test_clouds_of_two_lidars_in_a_folder_are_two_topics(tmp_path):
    for number in range(4):
        picture(tmp_path / f"{number}.png", number)
        for side in ("left", "right"):
            (tmp_path / f"{side}_{number}.bin").write_bytes(np.ones((5, 4), "<f4").tobytes())
    topics = open_recording(tmp_path).topics()[1:]
    assert [(t.name, t.kind, t.count) for t in topics] == [("left_*.bin", "points", 4), ("right_*.bin", "points", 4)]
