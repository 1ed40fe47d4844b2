"""Reads one point cloud from a file: .pcd (Point Cloud Library), .ply (Stanford) and .bin (KITTI)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from icalib.base.compiled import njit
from icalib.errors import RecordingError

_AXES = ("x", "y", "z")
_KITTI_COLUMNS = 4  # float32 x, y, z, reflectance
_LARGEST_RATIO = 88  # of sizes before and after LZF: 264 bytes for a copy of three
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_PLY_ORDERS = {"binary_big_endian": ">", "binary_little_endian": "<"}


def read_cloud(path: Path) -> np.ndarray:
    """(N, 3) float32 points [m] of the cloud at `path`. Raises RecordingError naming the file if it cannot be read."""
    parse = {".pcd": _pcd, ".ply": _ply, ".bin": _kitti}[path.suffix.lower()]
    try:
        points = np.ascontiguousarray(parse(path.read_bytes()), np.float32)
        if points.shape[1:] != (3,):
            raise ValueError("x, y and z are no single numbers")
        return points
    except (OSError, ValueError, LookupError, OverflowError, TypeError, MemoryError) as error:
        raise RecordingError(f"{path} is no complete point cloud ({error}); copy or write it again.") from error


def _kitti(content: bytes) -> np.ndarray:
    """Points of a file without a header, as KITTI's."""
    if not content:
        raise ValueError("it is empty")
    return np.frombuffer(content, "<f4").reshape(-1, _KITTI_COLUMNS)[:, :3]


def _pcd(content: bytes) -> np.ndarray:
    """Points of a file of the Point Cloud Library, in one of its three encodings."""
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        end = content.index(b"\n", at)
        word, *values = content[at:end].decode("ascii", "replace").split() or ["#"]
        header[word.upper()], at = values, end + 1
    counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
    names = [f"{name} {k}" if name not in _AXES else name for k, name in enumerate(header["FIELDS"])]
    n = _counted(int(header["WIDTH"][0]) * int(header["HEIGHT"][0]))
    encoding, body = header["DATA"][0], content[at:]
    if encoding == "ascii":
        before = np.concatenate([[0], np.cumsum([int(c) for c in counts])])
        return _of_text(body, [int(before[names.index(axis)]) for axis in _AXES], n)
    each = zip(names, header["TYPE"], header["SIZE"], counts, strict=True)
    dtype = np.dtype([(name, f"<{kind.lower()}{size}", (int(c),) if c != "1" else ()) for name, kind, size, c in each])
    if encoding == "binary":
        return _axes_of(np.frombuffer(body, dtype, n))
    if encoding != "binary_compressed":
        raise ValueError(f"DATA {encoding} is unknown")
    packed, size = (int(x) for x in np.frombuffer(body, "<u4", 2))
    if size != n * dtype.itemsize or size > _LARGEST_RATIO * packed:
        raise ValueError("its size is not that of its points")
    columns = decompress(np.frombuffer(body, np.uint8, packed, 8), size)
    starts = np.cumsum([0, *(n * dtype[name].itemsize for name in names)])
    at = dict(zip(names, starts[:-1].tolist(), strict=True))
    return np.stack([np.frombuffer(columns, dtype[axis], n, at[axis]) for axis in _AXES], axis=1)


def _counted(n: int) -> int:
    """The number of points that a header states."""
    if n < 0:
        raise ValueError(f"its header says {n} points")
    return n


def _ply(content: bytes) -> np.ndarray:
    """Points of a Stanford file whose vertices come first."""
    head, *bodies = re.split(rb"end_header\r?\n", content, maxsplit=1)
    if not bodies:
        raise ValueError("its header has no end")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    elements = [k for k, line in enumerate(lines) if line[:1] == ["element"]]
    if not elements or lines[elements[0]][1] != "vertex":
        raise ValueError("its first element is not vertex")
    n = _counted(int(lines[elements[0]][2]))
    properties = [p[1:] for p in lines[elements[0] : (elements + [len(lines)])[1]] if p[:1] == ["property"]]
    encoding = next((line[1] for line in lines if line[:1] == ["format"]), "")
    names = [name for _, name in properties]
    if encoding == "ascii":
        return _of_text(bodies[0], [names.index(axis) for axis in _AXES], n)
    if encoding not in _PLY_ORDERS:
        raise ValueError(f"its format is {encoding or 'missing'}")
    order = _PLY_ORDERS[encoding]
    return _axes_of(np.frombuffer(bodies[0], np.dtype([(name, order + _PLY_TYPES[t]) for t, name in properties]), n))


def _of_text(body: bytes, columns: list[int], n: int) -> np.ndarray:
    """(n, 3) the `columns` of n lines of numbers."""
    lines = [line for line in body.decode("ascii", "replace").splitlines() if line.strip()][:n]
    if len(lines) < n:
        raise ValueError(f"it has {len(lines)} of {n} points")
    return np.loadtxt(lines, usecols=columns, ndmin=2) if lines else np.empty((0, 3))


def _axes_of(points: np.ndarray) -> np.ndarray:
    """(N, 3) coordinates of structured `points` (N,)."""
    return np.stack([points[axis] for axis in _AXES], axis=1)


@njit(cache=True)
def decompress(packed, size):
    """(size,) bytes of LZF data (liblzf): runs of up to 32 literals, and copies of at least 3 earlier bytes. Raises
    ValueError for data that are damaged: compiled code does not check bounds by itself."""
    out = np.zeros(size, np.uint8)
    i, k = 0, 0
    while i < len(packed):
        control = int(packed[i])
        i += 1
        if control < 32:
            if i + control >= len(packed) or k + control >= size:
                raise ValueError("its compressed data are damaged")
            for _ in range(control + 1):
                out[k] = packed[i]
                i, k = i + 1, k + 1
            continue
        length = control >> 5
        if i + (length == 7) >= len(packed):
            raise ValueError("its compressed data are damaged")
        if length == 7:
            length += int(packed[i])
            i += 1
        start = k - ((control & 31) << 8) - int(packed[i]) - 1
        i += 1
        if start < 0 or k + length + 2 > size:
            raise ValueError("its compressed data are damaged")
        for j in range(length + 2):
            out[k] = out[start + j]
            k += 1
    if k != size:
        raise ValueError("its compressed data are damaged")
    return out
