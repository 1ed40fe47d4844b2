"""Positions in messages of a bag, by type of message, and in sentences of NMEA 0183.

ROS does not include the messages of receivers. Their definitions here have the fields in order, those of nested
messages in place of these, which makes the same bytes. Sources: gps_msgs/GPSFix, ublox_msgs/NavPVT,
ublox_ubx_msgs/UBXNavPVT, nmea_msgs/Sentence.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from icalib.data.messages import pose_of
from icalib.data.tables.table import read_bytes
from icalib.data.topics import MessageType
from icalib.errors import RecordingError
from icalib.sensors.position.spec import STATUSES

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
_STATUS = {0: SINGLE, 1: DIFFERENTIAL, 2: FIXED, 18: DIFFERENTIAL, 19: FIXED, 20: FLOAT, 33: DIFFERENTIAL}


def _satellites(m: Any) -> RecordedFix:
    """The fix of NavSatFix, or of GPSFix, whose errors are bounds of 95 %, 1.96 standard deviations; 0: unknown."""
    bounds = getattr(m, "errors", np.zeros(3))[[1, 1, 2]]
    covariance = m.position_covariance.reshape(3, 3) if m.position_covariance_type else np.diag((bounds / 1.96) ** 2)
    status = _STATUS.get(getattr(m.status, "status", m.status), NO_FIX)
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


def read_nmea(path: Path, note: Callable[[str], None]) -> list[tuple[int, RecordedFix]]:
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
        note(f"{path}: {damaged} damaged sentences were left out.")
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
