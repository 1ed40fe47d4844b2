"""Recorded poses of a sensor, and their reader for tables: CSV and TUM text."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from icalib.data.images.image_checks import Note, ignore
from icalib.data.messages import unit_rotations
from icalib.data.tables.columns import STAMP, TableKind, in_axes, split_kind, vector_names
from icalib.data.tables.table import read_table
from icalib.errors import RecordingError
from icalib.rig import PLAIN_TABLE, PoseSensor, TableLayout
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
# Only the stamps, so that a row whose pose cannot be read still counts as a row.
_STAMPS = TableKind(("t [ns]",), known=(STAMP,), rate_hz=POSE_RATE_HZ, more=True)
_TUM_SUFFIXES = (".tum", ".txt")
MAX_QUATERNION_ERROR = 1e-2  # largest deviation of a quaternion's length from 1, as in rounded text


@dataclass(frozen=True)
class PoseReadings(RawReadings):
    """Recorded poses: rotation R_frame_sensor (N, 3, 3), NaN if invalid; position p_frame_sensor (N, 3) [m]."""

    rotation: np.ndarray
    position: np.ndarray


def as_frame_sensor(read: PoseReadings, sensor: PoseSensor) -> PoseReadings:
    """The poses as T_frame_sensor. They are converted if the rig file states inverted poses or other axes of
    positions."""
    if sensor.position_axes is not None:
        read = replace(read, position=in_axes(read.position, sensor.position_axes))
    if not sensor.inverted:
        return read
    R = np.ascontiguousarray(read.rotation.transpose(0, 2, 1))
    return replace(read, rotation=R, position=-np.einsum("nij,nj->ni", R, read.position))


def is_tum_text(path: Path) -> bool:
    """Whether a file is TUM text, by its suffix. Its stamps are in seconds."""
    return path.suffix.lower() in _TUM_SUFFIXES


def read_pose_file(name: str, path: Path, layout: TableLayout = PLAIN_TABLE, note: Note = ignore) -> PoseReadings:
    """The poses of the sensor `name` in the table at `path`, with columns t [ns], x, y, z, qx, qy, qz, qw.

    Stamps of .tum and .txt files are in seconds. Rotations of invalid quaternions are NaN. `note` is called with a
    sentence on omitted rows. Raises RecordingError naming file and line, or if most quaternions are invalid.
    """
    kind = replace(POSE_TABLE, unit="s") if is_tum_text(path) else POSE_TABLE
    table = read_table(path, kind, layout, note)
    stamps_ns, values = table.integers[:, 0].copy(), table.decimals
    xyzw = values[:, 3:]
    length = np.linalg.norm(np.clip(xyzw, -1e9, 1e9), axis=1)  # clipped so that squares do not overflow
    wrong = ~(np.abs(length - 1.0) < MAX_QUATERNION_ERROR)
    if 2 * wrong.sum() > len(wrong):
        i = int(np.argmax(wrong))
        raise RecordingError(
            f"{path} ({name}): the quaternion at {stamps_ns[i]} ns has length {length[i]:.3g}, not 1, and most are "
            "no better; check the order of the columns, x, y, z, qx, qy, qz, qw."
        )
    return PoseReadings(name, stamps_ns, unit_rotations(xyzw, ~wrong), values[:, :3].copy())


def stamps_by_row(table: Path, layout: TableLayout, note: Note) -> tuple[dict[int, int], int]:
    """Stamps [ns] of readable rows by row number, from 0; and the number of all rows."""
    kind = replace(_STAMPS, unit="s") if is_tum_text(table) else _STAMPS
    stamps = 1 if split_kind(POSE_TABLE, layout.columns) is None else 2  # the first columns of a pose
    read = read_table(table, kind, replace(layout, columns=layout.columns[:stamps]), note)
    return dict(zip(read.numbers.tolist(), read.integers[:, 0].tolist(), strict=True)), read.written
