"""Poses of a sensor as they were written: tables of a folder, TUM's text, messages of a bag."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from icalib.errors import RecordingError
from icalib.recordings.streams import unit_rotations
from icalib.recordings.table import header_of, read_table

STAMP = ("t [ns]",)
POSE = ("x [m]", "y [m]", "z [m]", "qx", "qy", "qz", "qw")
FILES = ("poses.csv", "poses.tum", "poses.txt")  # that a folder's sensor may have
_TEXTS = (".tum", ".txt")
_UNIT = 1e-2  # of the length of a quaternion: of few digits


@dataclass(frozen=True)
class PoseReadings:
    """stamps_ns (N,) int64, which may still repeat or run backwards; R_frame_sensor (N, 3, 3), NaN where there is
    none; p_frame_sensor (N, 3) m."""

    name: str
    stamps_ns: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


def is_tum_text(path: Path) -> bool:
    """Whether a file is told by its name to be TUM's text; else it is a table of comma-separated columns."""
    return path.suffix.lower() in _TEXTS


def read_pose_file(name: str, path: Path) -> PoseReadings:
    """The poses of the sensor `name` in the table at `path`: t [ns], x, y, z, qx, qy, qz, qw, or, where its header
    names the quaternion's w first, as EuRoC's, in that order; a file .tum or .txt is TUM's, t [s] and the same,
    separated by blanks. Rotations of quaternions that are none are NaN. Raises RecordingError naming file and line, and
    where most quaternions are none."""
    if is_tum_text(path):
        stamps_ns, values = _read_text(path)
    else:
        table = read_table(path, STAMP, POSE)
        stamps_ns, values = table.integers[:, 0].copy(), table.decimals
        if _w_first(header_of(path)):
            values = values[:, [0, 1, 2, 4, 5, 6, 3]]
    xyzw = values[:, 3:]
    length = np.linalg.norm(xyzw, axis=1)
    wrong = ~(np.abs(length - 1.0) < _UNIT)
    if 2 * wrong.sum() > len(wrong):
        i = int(np.argmax(wrong))
        raise RecordingError(
            f"{path} ({name}): the quaternion at {stamps_ns[i]} ns has length {length[i]:.3g}, not 1, and most are "
            "no better; check the order of the columns, x, y, z, qx, qy, qz, qw."
        )
    return PoseReadings(name, stamps_ns, unit_rotations(xyzw, ~wrong), values[:, :3].copy())


def _w_first(header: str) -> bool:
    names = [part.split("[")[0].strip().lower() for part in header.lstrip("# ").split(",")]
    return len(names) == 1 + len(POSE) and names[4].endswith("w")


def _read_text(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (N,) ns and x, y, z, qx, qy, qz, qw (N, 7)."""
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path} cannot be read ({reason}); check the file and its permissions.") from None
    stamps, rows = [], []
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            stamp, *values = line.split()
            row = tuple(map(float, values))
            if len(row) != len(POSE) or not np.isfinite(row).all():
                raise ValueError
            stamps.append(_nanoseconds(stamp))
        except ValueError:
            raise RecordingError(
                f"{path}:{number}: the line is not TUM's t x y z qx qy qz qw, all finite numbers; correct or remove it."
            ) from None
        rows.append(row)
    if not rows:
        raise RecordingError(f"{path} holds no poses; write one line for each, t x y z qx qy qz qw.")
    return np.array(stamps, np.int64), np.array(rows)


def _nanoseconds(text: str) -> int:
    """Seconds as whole nanoseconds: those since 1970 with nine digits are no float64."""
    if not text.replace(".", "", 1).lstrip("-").isdigit():
        return round(float(text) * 1e9)
    whole, _, fraction = text.partition(".")
    size = int(whole.lstrip("-") or "0") * 1_000_000_000 + int((fraction + "0" * 9)[:9])
    return -size if whole.startswith("-") else size
