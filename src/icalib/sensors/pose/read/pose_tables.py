"""Recorded poses of a sensor, and their reader for tables: CSV and TUM text."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from icalib.data.images.image_checks import Note, ignore
from icalib.data.messages import unit_rotations
from icalib.data.tables.columns import STAMP, TableKind, in_axes, split_kind, vector_names
from icalib.data.tables.table import Table, holds, read_table
from icalib.errors import RecordingError
from icalib.rig import PLAIN_TABLE, PoseSensor, TableLayout
from icalib.sensors.pose.spec import METRES
from icalib.sensors.stream import RawReadings

POSE_RATE_HZ = (1e-3, 5000.0)  # lowest and highest plausible rate
POSE_TABLE = TableKind(
    ("t [ns]",),
    ("x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw"),
    (
        STAMP,
        *vector_names("p|pos|position|t|trans|translation|p_rs_r|"),
        *vector_names("q|quat|quaternion|orientation|r|rot|rotation|q_rs", "xyzw"),
    ),
    POSE_RATE_HZ,
)
_THREE = TableKind(("t [ns]",), (*POSE_TABLE.decimals[:3], "rx", "ry", "rz"), rate_hz=POSE_RATE_HZ)
# Rows of a 3 x 4 or 4 x 4 matrix one after another
_MATRICES = tuple(
    TableKind(("t [ns]",), tuple(f"m{i}{k}" for i in range(1, rows + 1) for k in range(1, 5)), rate_hz=POSE_RATE_HZ)
    for rows in (3, 4)
)
POSE_TABLES = (POSE_TABLE, _THREE, *_MATRICES)
# Only the stamps, so that a row whose pose cannot be read still counts as a row.
_STAMPS = TableKind(("t [ns]",), known=(STAMP,), rate_hz=POSE_RATE_HZ, more=True)
_TUM_SUFFIXES = (".tum", ".txt")
MAX_QUATERNION_ERROR = 1e-2  # largest deviation of a quaternion's length from 1, as in rounded text


@dataclass(frozen=True)
class PoseReadings(RawReadings):
    """Recorded poses: rotation R_frame_sensor (N, 3, 3), NaN if invalid; position p_frame_sensor (N, 3) [m]."""

    rotation: np.ndarray
    position: np.ndarray
    numbers: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))  # see `PoseStream`


def as_frame_sensor(read: PoseReadings, sensor: PoseSensor) -> PoseReadings:
    """The poses as T_frame_sensor. They are converted if the rig file states inverted poses, or another unit or
    other axes of positions."""
    read = replace(read, position=read.position * METRES[sensor.position_unit])
    if sensor.position_axes is not None:
        read = replace(read, position=in_axes(read.position, sensor.position_axes))
    if not sensor.inverted:
        return read
    R = np.ascontiguousarray(read.rotation.transpose(0, 2, 1))
    return replace(read, rotation=R, position=-np.einsum("nij,nj->ni", R, read.position))


def is_tum_text(path: Path) -> bool:
    """Whether a file is TUM text, by its suffix. Its stamps are in seconds."""
    return path.suffix.lower() in _TUM_SUFFIXES


def read_pose_file(
    name: str, path: Path, layout: TableLayout = PLAIN_TABLE, note: Note = ignore, how: str | None = None
) -> PoseReadings:
    """The poses of the sensor `name` in the table at `path`, with columns t [ns], x, y, z, qx, qy, qz, qw.

    how: `rotations` of the sensor. Without it a table of 7 columns has angles or rotation vectors, one of 13 or 17
    columns has matrices. Three numbers are then read as angles about fixed axes until `conventions` compares all.

    Stamps of .tum and .txt files are in seconds. Rotations of invalid quaternions are NaN. `note` is called with a
    sentence on omitted rows. Raises RecordingError naming file and line, or if most quaternions are invalid.
    """
    table = _table(path, how, layout, note)
    stamps_ns, values = table.integers[:, 0].copy(), table.decimals
    if values.shape[1] >= 12:
        T = values[:, :12].reshape(-1, 3, 4)
        values = np.hstack([T[:, :, 3], T[:, :, :3].reshape(-1, 9)])
    numbers = values[:, 3:].copy()
    if numbers.shape[1] == 4:
        _refuse_no_quaternions(name, path, stamps_ns, numbers)
    how = how or {3: f"xyz, {angle_unit(numbers)}", 4: "xyzw", 9: "matrix"}[numbers.shape[1]]
    return PoseReadings(name, stamps_ns, rotations_of(numbers, how), values[:, :3].copy(), numbers)


def _table(path: Path, how: str | None, layout: TableLayout, note: Note) -> Table:
    """The table at `path` by the first kind that it fits, of those that `how` allows."""
    kinds = POSE_TABLES
    if how is not None:
        in_order = replace(POSE_TABLE, known=())  # the header may name another order than that stated
        kinds = {"matrix": _MATRICES, "xyzw": (in_order,), "wxyz": (in_order,)}.get(how, (_THREE,))
    failed: RecordingError | None = None
    for kind in kinds:
        if failed and not (len(layout.columns) == len(kind.names) or (not layout.columns and holds(path, kind))):
            continue
        try:
            return read_table(path, replace(kind, unit="s") if is_tum_text(path) else kind, layout, note)
        except RecordingError as error:
            failed = failed or error
    assert failed is not None
    raise failed


def angle_unit(numbers: np.ndarray) -> str:
    """The unit of angles or rotation vectors: degrees if any number is larger than a full turn in radians."""
    return "degrees" if np.abs(numbers).max(initial=0.0) > 2.0 * np.pi else "radians"


def rotations_of(numbers: np.ndarray, how: str) -> np.ndarray:
    """Rotations (N, 3, 3) that are written as `how` (`PoseSensor.rotations`) in numbers (N, 3, 4 or 9); NaN where they
    are none."""
    name, _, unit = how.partition(", ")
    if name == "vector":
        return Rotation.from_rotvec(numbers, degrees=unit == "degrees").as_matrix()
    if unit:
        return Rotation.from_euler(name, numbers, degrees=unit == "degrees").as_matrix()
    if name != "matrix":
        xyzw = numbers if name == "xyzw" else numbers[:, [1, 2, 3, 0]]
        return unit_rotations(xyzw, np.abs(_lengths(xyzw) - 1.0) < MAX_QUATERNION_ERROR)
    R = np.clip(numbers, -2.0, 2.0).reshape(-1, 3, 3)
    error = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    good = (error < 2.0 * MAX_QUATERNION_ERROR) & (np.linalg.det(R) > 0.0)
    out = np.full(R.shape, np.nan)
    out[good] = Rotation.from_matrix(R[good]).as_matrix()
    return out


def _lengths(xyzw: np.ndarray) -> np.ndarray:
    """(N,) lengths of quaternions (N, 4)."""
    return np.linalg.norm(np.clip(xyzw, -1e9, 1e9), axis=1)  # clipped so that squares do not overflow


def _refuse_no_quaternions(name: str, path: Path, stamps_ns: np.ndarray, xyzw: np.ndarray) -> None:
    """Raise RecordingError if most quaternions (N, 4) have another length than 1."""
    length = _lengths(xyzw)
    wrong = ~(np.abs(length - 1.0) < MAX_QUATERNION_ERROR)
    if 2 * wrong.sum() > len(wrong):
        i = int(np.argmax(wrong))
        raise RecordingError(
            f"{path} ({name}): the quaternion at {stamps_ns[i]} ns has length {length[i]:.3g}, not 1, and most are "
            "no better; check the order of the columns, x, y, z, qx, qy, qz, qw."
        )


def stamps_by_row(table: Path, layout: TableLayout, note: Note) -> tuple[dict[int, int], int]:
    """Stamps [ns] of readable rows by row number, from 0; and the number of all rows."""
    kind = replace(_STAMPS, unit="s") if is_tum_text(table) else _STAMPS
    stamps = 1 if split_kind(POSE_TABLE, layout.columns) is None else 2  # the first columns of a pose
    read = read_table(table, kind, replace(layout, columns=layout.columns[:stamps]), note)
    return dict(zip(read.numbers.tolist(), read.integers[:, 0].tolist(), strict=True)), read.written
