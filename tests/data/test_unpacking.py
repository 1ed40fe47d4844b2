"""A few bytes that stand for terabytes are refused before they take the memory."""

from __future__ import annotations

import bz2
import gzip
import io
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each

from icalib.base.extras import load_lz4, load_zstd
from icalib.base.files import FREE_BYTES, TooLargeError, gunzipped, load_arrays, unpacked
from icalib.data.recordings import open_recording
from icalib.errors import RecordingError
from icalib.sensors.lidar.read import read_scans

LARGE = bytes(3 * FREE_BYTES)


def test_blocks_and_files_within_and_beyond_the_limit():
    lz4, zstd = load_lz4(), load_zstd()
    kinds = {
        bz2.BZ2Decompressor: bz2.compress,
        lz4.LZ4FrameDecompressor: lz4.compress,
        zstd.ZstdDecompressor: zstd.compress,
    }
    for kind, pack in kinds.items():
        assert unpacked(kind(), pack(LARGE[: FREE_BYTES // 2])) == LARGE[: FREE_BYTES // 2]
        if len(pack(LARGE)) * 256 < FREE_BYTES:
            with pytest.raises(TooLargeError, match="unpacks to more than 16 MiB and 256 times its size"):
                unpacked(kind(), pack(LARGE))
    assert gunzipped(gzip.compress(b"1,2\n") + gzip.compress(b"3,4\n")) == b"1,2\n3,4\n"
    with pytest.raises(TooLargeError):
        gunzipped(gzip.compress(LARGE[: 2 * FREE_BYTES]))


def mcap(block: bytes) -> bytes:
    """A file with one block that zstd compressed."""
    packed = load_zstd().compress(block)
    chunk = struct.pack("<QQQI", 0, 0, len(block), 0) + b"\4\0\0\0zstd" + struct.pack("<Q", len(packed)) + packed
    records = struct.pack("<BQ", 6, len(chunk)) + chunk + struct.pack("<BQ", 2, 20) + bytes(20)
    return b"\x89MCAP0\r\n" + records + b"\x89MCAP0\r\n"


def test_a_bag_whose_block_is_too_large_says_so(tmp_path: Path):
    (tmp_path / "run.mcap").write_bytes(mcap(LARGE))
    with pytest.raises(RecordingError, match=r"the block at byte \d+ is ignored: it unpacks to more than 16 MiB"):
        open_recording(tmp_path / "run.mcap")
    (tmp_path / "run.mcap").unlink()
    (tmp_path / "run.db3.zstd").write_bytes(load_zstd().compress(b"SQLite format 3\x00" + LARGE))
    with pytest.raises(RecordingError, match=r"it unpacks to more than 16 MiB.*zstd -d"):
        open_recording(tmp_path / "run.db3.zstd")


def archive(name: str, header: str, data: bytes = b"") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as file:
        text = header.encode("latin1") + b"\n"
        file.writestr(f"{name}.npy", b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data)
    return buffer.getvalue()


@each(
    "header",
    [
        "{'descr': '<f8', 'fortran_order': False, 'shape': (137438953472,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1, 2)}",
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,)}",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1,)",
        "{'descr': '<f8', 'shape': (1,)}",
        "((((((((",
    ],
)
def test_headers_of_arrays_that_lie(header: str):
    with pytest.raises(ValueError, match=r"\w"):
        load_arrays(archive("a", header, bytes(8)))


@each("plane", [2**31, 2**31 - 1, -2, 5])
def test_plane_ids_are_below_the_number_of_points(tmp_path: Path, plane: int):
    arrays = {
        "stamps_ns": np.arange(2) * 100_000_000,
        "start": np.array([0, 2, 4]),
        "offset_s": np.zeros(4, np.float32),
        "xyz": np.ones((4, 3), np.float32),
        "plane": np.array([0, -1, 1, plane]),
    }
    np.savez(tmp_path / "scans.npz", **arrays)
    with pytest.raises(RecordingError, match="plane must be -1 or a plane's number"):
        read_scans("lidar0", tmp_path / "scans.npz")
