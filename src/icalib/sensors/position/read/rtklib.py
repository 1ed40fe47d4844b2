"""Solutions of RTKLIB: text files `.pos`.

Source: RTKLIB 2.4.3 manual, appendix B.1 "Positioning solution file", and `outsolhead` and `outpos` of its solution.c.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

from icalib.data.tables.table import read_bytes
from icalib.errors import RecordingError
from icalib.sensors.position.read.readings import PositionReadings, Recorded, usable_covariances
from icalib.sensors.position.spec import STATUSES

SUFFIX = ".pos"
_GPS_START = datetime(1980, 1, 6, tzinfo=UTC)
# Q of the file: 1 fixed, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP; 0: none.
_STATUS = {1: "fixed", 2: "float", 3: "differential", 4: "differential", 5: "single", 6: "float"}
_SIGMAS = {
    "geodetic": ("sdn", "sde", "sdu", "sdne", "sdeu", "sdun"),
    "earth": ("sdx", "sdy", "sdz", "sdxy", "sdyz", "sdzx"),
    "local": ("sde", "sdn", "sdu", "sden", "sdnu", "sdue"),
}
_EPOCH_NS = 1_000_000_000


def read_pos(name: str, path: Path) -> tuple[PositionReadings, Recorded]:
    """The solutions in a `.pos` file, which may be gzipped, and their coordinates. Stamps are in its scale of time,
    GPST or UTC, from 1970 on without leap seconds. Raises RecordingError naming file and line."""
    lines = read_bytes(path).decode("utf-8", "replace").splitlines()
    header = next((line for line in reversed(lines) if line.startswith("%") and "Q" in line.split()), "")
    names = [name.split("(")[0] for name in header.lstrip("% ").replace(",", " ").split()]
    kind = _kind(path, header, names)
    rows = [(k, line) for k, line in enumerate(lines, 1) if line.strip() and not line.startswith("%")]
    if not rows:
        raise RecordingError(f"{path} holds no solutions; run the positioning again.")
    fields = [(k, line.replace(",", " ").split()) for k, line in rows]
    sexagesimal = "(d'\")" in header
    stamps_ns, numbers = [], []
    for k, row in fields:
        try:
            stamps_ns.append(_stamp_ns(row[0], row[1]))
            values = [float(x) for x in row[2:]]
            numbers.append(_in_degrees(values) if sexagesimal else values)
        except (ValueError, IndexError) as error:
            raise RecordingError(f"{path}:{k}: the line is not a solution of RTKLIB; correct or remove it.") from error
    width = min(len(row) for row in numbers)
    table, columns = np.array([row[:width] for row in numbers]), names[1:]
    quality = table[:, columns.index("Q")].astype(int)
    index = {q: STATUSES.index(status) for q, status in _STATUS.items()}
    status = np.array([index.get(int(q), -1) for q in quality])
    covariance = _covariance(table, columns, kind)
    return PositionReadings(name, np.array(stamps_ns, np.int64), table[:, :3], covariance, status), kind


def _kind(path: Path, header: str, names: list[str]) -> Recorded:
    kinds: dict[str, Recorded] = {"latitude": "geodetic", "x-ecef": "earth", "e-baseline": "local"}
    if len(names) > 4 and names[1] in kinds:
        return kinds[names[1]]
    words = header.strip() or "there is no line that starts with % and names the columns"
    raise RecordingError(
        f"{path}: the header does not name the columns of an RTKLIB solution ({words:.80}); write the file with its "
        "header, with latitude, longitude and height, or x, y and z."
    )


def _stamp_ns(first: str, second: str) -> int:
    """Nanoseconds since 1970 of the first two columns: date and time, or GPS week and seconds."""
    if "/" in first:
        year, month, day = (int(x) for x in first.split("/"))
        hours, minutes, seconds = second.split(":")
        integer, _, fraction = seconds.partition(".")
        at = datetime(year, month, day, tzinfo=UTC) + timedelta(
            hours=int(hours), minutes=int(minutes), seconds=int(integer)
        )
    else:
        integer, _, fraction = second.partition(".")
        at = _GPS_START + timedelta(weeks=int(first), seconds=int(integer))
    return round(at.timestamp()) * _EPOCH_NS + int(f"{fraction:0<9.9}")


def _in_degrees(values: list[float]) -> list[float]:
    """The row with latitude and longitude [deg] from three columns each: degrees, minutes, seconds."""
    angles = []
    for k in (0, 3):
        degrees, minutes, seconds = values[k : k + 3]
        sign = -1.0 if np.copysign(1.0, degrees) < 0.0 else 1.0
        angles.append(sign * (abs(degrees) + minutes / 60.0 + seconds / 3600.0))
    return [*angles, *values[6:]]


def _covariance(table: np.ndarray, columns: list[str], kind: str) -> np.ndarray:
    """(N, 3, 3) m^2 in axes east, north and up, or x, y and z; (0, 3, 3) where the file has none. Off the diagonal the
    file has the signed root of the absolute covariance."""
    names = _SIGMAS[kind]
    if any(name not in columns or columns.index(name) >= table.shape[1] for name in names[:3]):
        return np.zeros((0, 3, 3))
    sigmas = [
        table[:, columns.index(n)] if n in columns and columns.index(n) < table.shape[1] else np.zeros(len(table))
        for n in names
    ]
    a, b, c = (x**2 for x in sigmas[:3])
    ab, bc, ca = (np.copysign(x**2, x) for x in sigmas[3:])
    if kind == "geodetic":  # north, east, up
        a, b, ab, bc, ca = b, a, ab, ca, bc
    rows = np.stack([a, ab, ca, ab, b, bc, ca, bc, c], axis=1).reshape(-1, 3, 3)
    return usable_covariances(rows, np.ones(len(rows), bool))
