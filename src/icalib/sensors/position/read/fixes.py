"""Fixes of a receiver from messages, NMEA sentences and RTKLIB files."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from icalib.base.remark import Remark
from icalib.data.images import Note, ignore
from icalib.data.measurements import far_origin_note
from icalib.data.messages import MessageType, pose_of
from icalib.data.tables import STAMP, TableKind, named, places_by_name, read_bytes, read_table
from icalib.errors import RecordingError
from icalib.geometry.geodesy import earth_centred, local_metres
from icalib.sensors.position.spec import STATUSES, PositionSensor, Status
from icalib.sensors.stream import RawReadings

# Positions in messages of a bag, by type of message, and in sentences of NMEA 0183.
#
# ROS does not include the messages of receivers. Their definitions here have the fields in order, those of nested
# messages in place of these, which makes the same bytes. Sources: gps_msgs/GPSFix, ublox_msgs/NavPVT,
# ublox_ubx_msgs/UBXNavPVT, nmea_msgs/Sentence.

NAVSAT, POINT, RECEIVER, SENTENCE = "navsat", "point", "receiver", "nmea"  # kinds of topics with positions alone
NO_FIX, SINGLE, DIFFERENTIAL, FLOAT, FIXED = range(-1, len(STATUSES))
UNKNOWN = np.zeros((3, 3))  # covariance of a fix that states none
_NS, _DAY_NS = 1_000_000_000, 86_400_000_000_000


class RecordedFix(NamedTuple):
    """A position: latitude, longitude [deg] and height [m], or x, y and z [m]. covariance (3, 3) m^2 in axes east,
    north and up, or x, y and z, or `UNKNOWN`. status: index into `STATUSES`, or NO_FIX. utc_ns: instant by the receiver
    [ns], of a sentence within the day; None: unknown, or the header has it."""

    position: tuple[float, ...]
    covariance: np.ndarray = UNKNOWN
    status: int = FIXED
    utc_ns: int | None = None


def _metric(m: Any) -> RecordedFix:
    """The position of PointStamped, a pose or Odometry."""
    point = m.point if hasattr(m, "point") else pose_of(m).position
    covariance = getattr(getattr(m, "pose", None), "covariance", np.zeros(36))
    return RecordedFix((point.x, point.y, point.z), covariance.reshape(6, 6)[:3, :3])


# NavSatStatus: 0 fix, 1 satellite-based, 2 ground-based augmentation (where receivers report RTK). GPSStatus has these
# and 18 differential, 19 RTK fixed, 20 RTK float, 33 WAAS.
_STATUS_OF_NAVSAT = {0: SINGLE, 1: DIFFERENTIAL, 2: FIXED, 18: DIFFERENTIAL, 19: FIXED, 20: FLOAT, 33: DIFFERENTIAL}


def _satellites(m: Any) -> RecordedFix:
    """The fix of NavSatFix, or of GPSFix, whose errors are bounds of 95 %, 1.96 standard deviations; 0: unknown."""
    bounds = getattr(m, "errors", np.zeros(3))[[1, 1, 2]]
    covariance = m.position_covariance.reshape(3, 3) if m.position_covariance_type else np.diag((bounds / 1.96) ** 2)
    status = _STATUS_OF_NAVSAT.get(getattr(m.status, "status", m.status), NO_FIX)
    return RecordedFix((m.latitude, m.longitude, m.altitude), covariance, status)


def _u_blox(m: Any, carrier: int, differential: bool, is_good: bool) -> RecordedFix:
    """A fix of two dimensions has an assumed height, and is none."""
    status = (DIFFERENTIAL if differential else SINGLE, FLOAT, FIXED, NO_FIX)[carrier & 3]
    sigma = np.array([m.h_acc, m.h_acc, m.v_acc]) * 1e-3
    position = m.lat * 1e-7, m.lon * 1e-7, m.height * 1e-3
    return RecordedFix(position, np.diag(sigma**2), status if is_good and m.fix_type in (3, 4) else NO_FIX)


def _nav_pvt(m: Any) -> RecordedFix:
    fix = _u_blox(m, m.flags >> 6, bool(m.flags & 2), bool(m.flags & 1))
    if m.valid & 7 != 7:  # date, time, or whole seconds are not known yet
        return fix
    month, day, hour, minute, second = m.clock.tolist()
    at = datetime(m.year, month, day, tzinfo=UTC) + timedelta(hours=hour, minutes=minute, seconds=second)
    return fix._replace(utc_ns=round(at.timestamp()) * _NS + m.nano)


# Quality of GGA: 1 single, 2 differential, 3 PPS, 4 RTK fixed, 5 RTK float; others are not measured.
_QUALITY = {"1": SINGLE, "2": DIFFERENTIAL, "3": SINGLE, "4": FIXED, "5": FLOAT}


def of_sentence(text: str) -> RecordedFix | None:
    """The fix of a GGA sentence, without accuracy; None for other sentences. Raises ValueError if it is damaged."""
    body, _, checksum = text[text.find("$") + 1 :].strip().partition("*")
    if body[2:6] != "GGA,":
        return None
    if checksum and reduce(xor, body.encode()) != int(checksum, 16):
        raise ValueError("the checksum of the sentence is wrong")
    _, clock, lat, south, lon, west, quality, _, _, height, _, undulation, *_ = body.split(",")
    if quality not in _QUALITY:
        return RecordedFix((np.nan,) * 3, status=NO_FIX)
    degrees = [
        (int(angle[:n]) + float(angle[n:]) / 60.0) * (-1.0 if side in ("S", "W") else 1.0)
        for angle, n, side in ((lat, 2, south), (lon, 3, west))
    ]
    within_day = int(clock[:2]) * 3600 + int(clock[2:4]) * 60 + float(clock[4:])
    above_ellipsoid = float(height) + float(undulation or 0.0)
    return RecordedFix((*degrees, above_ellipsoid), status=_QUALITY[quality], utc_ns=round(within_day * _NS))


def is_nmea(path: Path) -> bool:
    """Whether a file is a log of NMEA sentences."""
    return path.name.removesuffix(".gz").endswith((".nmea", ".txt")) and b"GGA," in read_bytes(path)


def read_nmea(path: Path, note: Note) -> list[tuple[int, RecordedFix]]:
    """Stamp [ns] and fix of each GGA sentence of a log, which may be gzipped. Stamps count from 1970 if an RMC sentence
    has the date, else from midnight. note: called with a sentence on damaged lines. Raises RecordingError without
    fixes."""
    text = read_bytes(path).decode("ascii", "replace")
    date = re.search(r"\$..RMC,(?:[^,\n]*,){8}(\d\d)(0[1-9]|1[0-2])(\d\d)", text)
    day, month, year = (int(part) for part in date.groups()) if date else (1, 1, -30)
    midnight_ns = round((datetime(2000 + year, month, 1, tzinfo=UTC) + timedelta(days=day - 1)).timestamp()) * _NS
    fixes: list[tuple[int, RecordedFix]] = []
    damaged = 0
    for line in text.splitlines():
        try:
            fix = of_sentence(line)
        except ValueError:
            damaged, fix = damaged + 1, None
        if fix is not None and fix.utc_ns is not None:
            if fixes and midnight_ns + fix.utc_ns < fixes[-1][0] - _DAY_NS // 2:
                midnight_ns += _DAY_NS
            fixes.append((midnight_ns + fix.utc_ns, fix))
    if not fixes:
        raise RecordingError(f"{path} holds no GGA sentence with a fix; log GGA, or write a table of positions.")
    if damaged:
        note(Remark("nmea_sentences_damaged", f"{path}: {damaged} damaged sentences were left out."))
    return fixes


_GPS_FIX = (
    "std_msgs/Header header, std_msgs/Header status_header, uint16 used, int32[] used_prn, uint16 visible, "
    "int32[] prn, int32[] elevation, int32[] azimuth, int32[] snr, int16 status, uint16[3] sources, float64 latitude, "
    "float64 longitude, float64 altitude, float64[7] motion, float64[5] dilution, float64[10] errors, "
    "float64[9] position_covariance, uint8 position_covariance_type"
)
_PLACE = (
    "int32 lon, int32 lat, int32 height, int32 h_msl, uint32 h_acc, uint32 v_acc, int32[5] velocity, "
    "uint32[2] velocity_acc, uint16 p_dop"
)
_ENDING = "int32 head_veh, int16 mag_dec, uint16 mag_acc"
_NAV_PVT = (
    "uint32 i_tow, uint16 year, uint8[5] clock, uint8 valid, uint32 t_acc, int32 nano, uint8 fix_type, uint8 flags, "
    f"uint8 flags2, uint8 num_sv, {_PLACE}, uint8[6] reserved, {_ENDING}"
)
_UBX_NAV_PVT = (
    "std_msgs/Header header, uint32 i_tow, uint16 year, uint8[5] clock, bool[4] valid, uint32 t_acc, int32 nano, "
    "uint8 fix_type, bool is_good, bool differential, uint8 power, bool head_valid, uint8 carrier, bool[3] confirmed, "
    f"uint8 num_sv, {_PLACE}, bool invalid, {_ENDING}"
)
_DECLARED: tuple[tuple[str, str, Callable[[Any], RecordedFix | None], str], ...] = (
    ("sensor_msgs/msg/NavSatFix", NAVSAT, _satellites, ""),
    ("geometry_msgs/msg/PointStamped", POINT, _metric, ""),
    *((f"geometry_msgs/msg/{n}Stamped", "pose", _metric, "") for n in ("Pose", "PoseWithCovariance", "Transform")),
    ("nav_msgs/msg/Odometry", "odometry", _metric, ""),
    *((f"{package}/msg/GPSFix", RECEIVER, _satellites, _GPS_FIX) for package in ("gps_common", "gps_msgs")),
    ("ublox_msgs/msg/NavPVT", RECEIVER, _nav_pvt, _NAV_PVT),
    (
        "ublox_ubx_msgs/msg/UBXNavPVT",
        RECEIVER,
        lambda m: _u_blox(m, m.carrier, m.differential, m.is_good and not m.invalid),
        _UBX_NAV_PVT,
    ),
    ("nmea_msgs/msg/Sentence", SENTENCE, lambda m: of_sentence(m.sentence), "std_msgs/Header header, string sentence"),
)
FIX_TYPES = {
    name: (MessageType(name, kind, fix_of is not _nav_pvt, definition=fields.replace(", ", "\n")), fix_of)
    for name, kind, fix_of, fields in _DECLARED
}


# Solutions of RTKLIB: text files `.pos`.
#
# Source: RTKLIB 2.4.3 manual, appendix B.1 "Positioning solution file", and `outsolhead` and `outpos` of its
# solution.c.

SUFFIX = ".pos"
_GPS_START = datetime(1980, 1, 6, tzinfo=UTC)
# Q of the file: 1 fixed, 2 float, 3 SBAS, 4 DGPS, 5 single, 6 PPP; 0: none.
_STATUS_OF_RTKLIB = {1: "fixed", 2: "float", 3: "differential", 4: "differential", 5: "single", 6: "float"}
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
    index = {q: STATUSES.index(status) for q, status in _STATUS_OF_RTKLIB.items()}
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


# Fixes as recorded, and as positions in metres relative to the first good one.
#
# Tables of positions: metric x, y, z, or latitude, longitude and height; with standard deviations where a header names
# them.

NO_COVARIANCE = np.zeros((0, 3, 3))
Recorded = Literal["geodetic", "earth", "local"]  # coordinates; latitude, longitude and height; Earth-centred; metric
MAX_DISTANCE_M = 20_000.0  # from the first fix: the vertical turns by 3 mrad, which is 0.03 m/s^2 of gravity


@dataclass(frozen=True)
class LocalFrame:
    """A frame relative to the recorded coordinates: origin + axes^T p is the recorded position of p (3,) m. origin (3,)
    m; axes (3, 3): R_local_recorded; on_earth: the recorded coordinates are Earth-centred, or latitude, longitude and
    height."""

    origin: np.ndarray
    axes: np.ndarray
    on_earth: bool = False

    def moved(self, by: np.ndarray) -> LocalFrame:
        """This frame with its origin shifted by `by` (3,) m along its axes."""
        return replace(self, origin=self.origin + by @ self.axes)


AS_RECORDED = LocalFrame(np.zeros(3), np.eye(3))


@dataclass(frozen=True)
class PositionReadings(RawReadings):
    """position (N, 3) m in `frame`, or latitude, longitude [deg] and height [m] until they are converted; covariance
    (N, 3, 3) m^2, or (0, 3, 3); status (N,) index into `STATUSES`, -1: no fix, or (0,) where none is stated."""

    position: np.ndarray
    covariance: np.ndarray
    status: np.ndarray
    frame: LocalFrame = AS_RECORDED

    def inside(self, what: str, frame: LocalFrame, owner: str) -> PositionReadings:
        """The readings in the frame of `owner`. Raises RecordingError if only one of the two frames is on the Earth."""
        if self.frame.on_earth != frame.on_earth:
            kind = "latitudes and longitudes" if self.frame.on_earth else "positions in metres"
            raise RecordingError(
                f"{what}: {kind} cannot be in the frame of {owner}; write frame: levelled in the rig file."
            )
        R = frame.axes @ self.frame.axes.T
        covariance = R @ self.covariance @ R.T if len(self.covariance) else self.covariance
        position = self.position @ R.T + frame.axes @ (self.frame.origin - frame.origin)
        return replace(self, position=position, covariance=covariance, frame=frame)


def good_fixes(status: np.ndarray, least: Status, n: int) -> np.ndarray:
    """(n,) bool: which of n fixes have at least the status `least`; all of them if status, (n,) or (0,), is empty."""
    return status >= STATUSES.index(least) if len(status) else np.ones(n, dtype=bool)


def left_out(what: str, status: np.ndarray, good: np.ndarray, least: Status) -> tuple[Remark, ...]:
    """A note on fixes that are not good."""
    if good.all():
        return ()
    none, worse = int((status < 0).sum()), int((~good & (status >= 0)).sum())
    parts = [f"{none} without a fix"] * (none > 0) + [f"{worse} worse than {least} (least_status)"] * (worse > 0)
    return (
        Remark(
            "fixes_left_out", f"{what}: {none + worse} of {len(good)} positions were left out, {' and '.join(parts)}."
        ),
    )


def from_geodetic(
    what: str, readings: PositionReadings, good: np.ndarray
) -> tuple[PositionReadings, tuple[Remark, ...]]:
    """Those of `readings` that are `good` (N,) bool, in metres east, north and up of the first, and a note. Covariances
    are in these axes already, positions latitude and longitude [deg] and height over the WGS84 ellipsoid [m].

    Raises RecordingError where latitudes, longitudes or heights cannot be right.
    """
    degrees = readings.position
    usable = good & np.isfinite(degrees).all(axis=1) & (np.abs(degrees[:, :2]) > 1e-9).any(axis=1)
    _refuse_heights(what, degrees, good)
    if not usable.any():
        raise RecordingError(f"{what}: no position has latitude, longitude and height; record again with a fix.")
    latitude, longitude, height = degrees.T
    if (np.abs(latitude[usable]) > 90.0).any():
        swapped = (np.abs(longitude[usable]) <= 90.0).all()
        cause = "latitude and longitude are swapped" if swapped else "it is not in degrees"
        raise RecordingError(
            f"{what}: the first latitude is {latitude[usable][0]:.6g} degrees, as if {cause}; say which "
            "column is which by `columns: [...]` in the rig file."
        )
    xyz = earth_centred(np.deg2rad(latitude), np.deg2rad(longitude), height)
    first = int(np.argmax(usable))
    position, axes = local_metres(xyz, xyz[first])
    away = float(np.linalg.norm(position[usable], axis=1).max())
    if away > MAX_DISTANCE_M:
        raise RecordingError(
            f"{what}: its fixes are up to {away / 1e3:.0f} km from the first one; the plane of east and north does not "
            "follow the Earth so far. Cut the recording with --from and --to, or leave out fixes without a solution."
        )
    note = Remark(
        "positions_from_geodetic",
        f"{what}: metres are east, north and up of the first fix, latitude {latitude[first]:.8f}, longitude "
        f"{longitude[first]:.8f}, height {height[first]:.3f} m.",
    )
    return replace(readings, position=position, frame=LocalFrame(xyz[first], axes, True)).some(usable), (note,)


def _refuse_heights(what: str, degrees: np.ndarray, good: np.ndarray) -> None:
    height = degrees[good, 2]
    if len(height) and (~np.isfinite(height)).mean() > 0.5:
        raise RecordingError(f"{what}: heights are missing (NaN); write the height over the WGS84 ellipsoid in metres.")
    if len(height) > 2 and (height == 0.0).all():
        raise RecordingError(
            f"{what}: all heights are 0, as if they were missing; write the height over the WGS84 ellipsoid in metres."
        )


def about_first(what: str, readings: PositionReadings) -> tuple[PositionReadings, tuple[Remark, ...]]:
    """Readings in metres, and a note. If the first position is more than 100 m from the origin of the frame, the origin
    moves to the first position, rounded to whole metres. Raises RecordingError if no position is finite."""
    p = readings.position
    finite = np.isfinite(p).all(axis=1)
    if not finite.any():
        raise RecordingError(f"{what}: no position is finite; correct the program that writes them.")
    origin = np.round(p[int(np.argmax(finite))])
    if np.linalg.norm(origin) <= 100.0:
        return readings, ()
    moved = replace(readings, position=p - origin, frame=readings.frame.moved(origin))
    return moved, (far_origin_note(what, origin),)


def from_fixes(name: str, stamped: Sequence[tuple[int, RecordedFix]]) -> PositionReadings:
    """Readings of fixes with their stamps [ns], geodetic ones not yet in metres."""
    fixes = [fix for _, fix in stamped]
    position = np.array([fix.position for fix in fixes]).reshape(-1, 3)
    covariance = np.array([fix.covariance for fix in fixes]).reshape(-1, 3, 3)
    status = np.array([fix.status for fix in fixes], np.int64)
    usable = usable_covariances(covariance, (status >= 0) & np.isfinite(position).all(axis=1))
    return PositionReadings(name, np.array([stamp for stamp, _ in stamped], np.int64), position, usable, status)


def usable_covariances(covariance: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """The covariances (N, 3, 3), or NO_COVARIANCE unless all that are `needed` (N,) are positive definite."""
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    if not needed.any() or not (np.linalg.eigvalsh(finite[needed])[:, 0] > 0.0).all():
        return NO_COVARIANCE
    return np.where(needed[:, None, None], finite, np.eye(3))


FIX_RATES_HZ = (1e-2, 1000.0)  # lowest and highest: other rates show another unit of the stamps
_SIGMA = r"(s|sd|std|stddev|sigma|std_dev)"
METRIC = TableKind(
    ("t [ns]",),
    ("x [m]", "y [m]", "z [m]"),
    (
        STAMP,
        (r"(p|pos|position|point|p_rs_r)_?x|x|east(ing)?|e",),
        (r"(p|pos|position|point|p_rs_r)_?y|y|north(ing)?|n",),
        (r"(p|pos|position|point|p_rs_r)_?z|z|up|u|height|h|altitude|alt",),
    ),
    FIX_RATES_HZ,
)
GEODETIC = TableKind(
    ("t [ns]",),
    ("latitude [deg]", "longitude [deg]", "height [m]"),
    (
        STAMP,
        (r"lat(itude)?(_deg)?",),
        (r"lon(g|gitude)?(_deg)?",),
        (r"(ellipsoid(al)?_)?h(eight)?(_m)?|alt(itude)?(_m)?|hgt|hae",),
    ),
    FIX_RATES_HZ,
)
_DEVIATIONS = (
    (rf"{_SIGMA}_?(x|e|east)",),
    (rf"{_SIGMA}_?(y|n|north)",),
    (rf"{_SIGMA}_?(z|u|up|h)",),
)


def read_position_table(sensor: PositionSensor, path: Path, note: Note = ignore) -> tuple[PositionReadings, Recorded]:
    """The positions in a table, and their coordinates, geodetic or local, as the rig file or the names of the columns
    say. Standard deviations are those of east, north and up, or of x, y and z. Raises
    RecordingError naming file and line."""
    layout, geodetic = sensor.layout, sensor.coordinates == "geodetic"
    if sensor.coordinates is None:
        geodetic = named(path, GEODETIC) if not layout.columns else places_by_name(GEODETIC, layout.columns) is not None
    kind = GEODETIC if geodetic else METRIC
    stated = _with_deviations(kind)
    kind = stated if len(layout.columns) == len(stated.names) or (not layout.columns and named(path, stated)) else kind
    table = read_table(path, kind, layout, note)
    values = table.decimals
    covariance = NO_COVARIANCE
    if values.shape[1] == 6 and (values[:, 3:] > 0.0).all():
        covariance = values[:, 3:, None] ** 2 * np.eye(3)
    readings = PositionReadings(
        sensor.name, table.integers[:, 0].copy(), values[:, :3].copy(), covariance, np.zeros(0, np.int64)
    )
    return readings, "geodetic" if geodetic else "local"


def _with_deviations(kind: TableKind) -> TableKind:
    return replace(kind, decimals=(*kind.decimals, "sx [m]", "sy [m]", "sz [m]"), known=(*kind.known, *_DEVIATIONS))
