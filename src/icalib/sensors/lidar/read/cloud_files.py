"""Reads one point cloud from a file: .pcd (Point Cloud Library), .ply (Stanford) and .bin (KITTI)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from icalib.base.compiled import njit
from icalib.errors import RecordingError

_AXES = ("x", "y", "z")
_KITTI_COLUMNS = 4  # float32 x, y, z, reflectance
_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip


def read_cloud(path: Path) -> np.ndarray:
    """(N, 3) float32 points [m] of the cloud at `path`. Raises RecordingError naming the file if it cannot be read."""
    parse = {".pcd": _pcd, ".ply": _ply, ".bin": _kitti}[path.suffix.lower()]
    try:
        return np.ascontiguousarray(parse(path.read_bytes()), np.float32)
    except (OSError, ValueError, KeyError, IndexError) as error:
        raise RecordingError(f"{path} is no complete point cloud ({error}); copy or write it again.") from error


def _kitti(content: bytes) -> np.ndarray:
    """Points of a file without a header, as KITTI's."""
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
    n = int(header["WIDTH"][0]) * int(header["HEIGHT"][0])
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
    columns = decompress(np.frombuffer(body, np.uint8, packed, 8), size)
    starts = np.cumsum([0, *(n * dtype[name].itemsize for name in names)])
    by_name = {name: columns[a:].tobytes() for name, a in zip(names, starts[:-1].tolist(), strict=True)}
    return np.stack([np.frombuffer(by_name[axis], dtype[axis], n) for axis in _AXES], axis=1)


def _ply(content: bytes) -> np.ndarray:
    """Points of a Stanford file whose vertices come first."""
    head, _, body = content.partition(b"end_header\n")
    lines = [line.split() for line in head.decode("ascii", "replace").splitlines()]
    elements = [k for k, line in enumerate(lines) if line[:1] == ["element"]]
    if not elements or lines[elements[0]][1] != "vertex":
        raise ValueError("its first element is not vertex")
    n = int(lines[elements[0]][2])
    properties = [p[1:] for p in lines[elements[0] : (elements + [len(lines)])[1]] if p[0] == "property"]
    encoding = next(line[1] for line in lines if line[:1] == ["format"])
    names = [name for _, name in properties]
    if encoding == "ascii":
        return _of_text(body, [names.index(axis) for axis in _AXES], n)
    order = ">" if encoding == "binary_big_endian" else "<"
    return _axes_of(np.frombuffer(body, np.dtype([(name, order + _PLY_TYPES[t]) for t, name in properties]), n))


def _of_text(body: bytes, columns: list[int], n: int) -> np.ndarray:
    """(n, 3) the `columns` of n lines of numbers."""
    if not n:
        return np.empty((0, 3))
    points = np.loadtxt(body.decode("ascii", "replace").splitlines()[:n], usecols=columns, ndmin=2)
    if len(points) < n:
        raise ValueError(f"it has {len(points)} of {n} points")
    return points


def _axes_of(points: np.ndarray) -> np.ndarray:
    """(N, 3) coordinates of structured `points` (N,)."""
    return np.stack([points[axis] for axis in _AXES], axis=1)


@njit(cache=True)
def decompress(packed, size):
    """(size,) bytes of LZF data (liblzf): runs of up to 32 literals, and copies of at least 3 earlier bytes."""
    out = np.zeros(size, np.uint8)
    i, k = 0, 0
    while i < len(packed):
        control = int(packed[i])
        i += 1
        if control < 32:
            for _ in range(control + 1):
                out[k] = packed[i]
                i, k = i + 1, k + 1
            continue
        length = control >> 5
        if length == 7:
            length += int(packed[i])
            i += 1
        start = k - ((control & 31) << 8) - int(packed[i]) - 1
        i += 1
        for j in range(length + 2):
            out[k] = out[start + j]
            k += 1
    return out
