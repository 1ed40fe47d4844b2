"""Fixes of GNSS receivers in messages that ROS does not include, and in sentences of NMEA, against what was written."""

from __future__ import annotations

from datetime import UTC, datetime
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.data.recording import Reading
from icalib.data.recordings import open_recording
from icalib.errors import RecordingError
from icalib.rig import Rig, by_name
from icalib.sensors.position.read import read
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.position.stream import PositionStream
from icalib.tools.inspection import draft_rig, inspect_recording

N = 40
START_NS = round(datetime(2025, 8, 28, 17, 30, tzinfo=UTC).timestamp()) * 10**9
STAMPS = [START_NS + 200_000_000 * k for k in range(N)]
LATE_NS = 40_000_000  # from the epoch to when the message is received
T = 0.2 * np.arange(N)
# Latitude, longitude [deg], height [m]: a curve of 20 m, in whole units of NavPVT (1e-7 deg, 1 mm).
WHERE = np.round(
    np.stack([48.1 + 1.8e-4 * np.sin(T / 3), 11.5 + 1.8e-4 * np.cos(T / 3), 500 + np.sin(T)], axis=1), [7][0]
)
WHERE[:, 2] = np.round(WHERE[:, 2], 3)


def gps_fix(package, status=19, known=2):
    def message(make, k):
        none = np.zeros(0, np.int32)
        header = make.header(STAMPS[k])
        inner = (header, 0, none, 0, none, none, none, none, status, 0, 0, 0)
        rest = [0.0] * 13 + [0.98, 0.98 * 2] + [0.0] * 7  # err_horz, err_vert: 95 %
        covariance = np.diag([0.01, 0.04, 0.09]).ravel() * known
        values = (header, make.make(f"{package}/msg/GPSStatus", *inner), *WHERE[k].tolist(), *rest, covariance, known)
        return make.make(f"{package}/msg/GPSFix", *values)

    return message


def place(k):
    lat, lon, height = WHERE[k]
    return (round(lon * 1e7), round(lat * 1e7), round(height * 1e3), 0, 20, 30, 1, 2, 3, 4, 5, 6, 7, 8)


def clock(k):
    """Time of week, and the date and time of day of NavPVT, with the fraction [ns]: rounded to whole seconds."""
    second, nano = divmod(STAMPS[k] + 500_000_000, 10**9)
    at = datetime.fromtimestamp(second, UTC)
    return (0, at.year, at.month, at.day, at.hour, at.minute, at.second), nano - 500_000_000


def nav_pvt(make, k, fix_type=3, flags=0b10000001, valid=7):
    at, nano = clock(k)
    values = (*at, valid, 20, nano, fix_type, flags, 0, 12, *place(k), np.zeros(6, np.uint8), 0, 0, 0)
    return make.make("ublox_msgs/msg/NavPVT", *values)


def ubx_nav_pvt(make, k):
    at, nano = clock(k)
    kind = "ublox_ubx_msgs/msg"
    fix, power, carrier = (make.make(f"{kind}/{n}", v) for n, v in (("GpsFix", 3), ("PSMPVT", 0), ("CarrSoln", 2)))
    flags = (True, True, True, False, 20, nano, fix, True, True, power, False, carrier, True, True, True, 12)
    return make.make(f"{kind}/UBXNavPVT", make.header(STAMPS[k]), *at, *flags, *place(k), False, 0, 0, 0)


def gga(k, quality=4):
    at = datetime.fromtimestamp(STAMPS[k] // 10**9, UTC)
    lat, lon, height = WHERE[k]
    angles = f"{int(lat):02d}{lat % 1 * 60:010.7f},N,{int(lon):03d}{lon % 1 * 60:010.7f},E"
    seconds = at.second + STAMPS[k] % 10**9 * 1e-9
    clock = f"{at.hour:02d}{at.minute:02d}{seconds:05.2f}"
    return sentence(f"GNGGA,{clock},{angles},{quality},12,0.6,{height - 45.5:.3f},M,45.5,M,1.0,0000")


def sentence(body):
    return f"${body}*{reduce(xor, body.encode()):02X}"


def nmea(make, k):
    return make.make("nmea_msgs/msg/Sentence", make.header(STAMPS[k]), gga(k))


KINDS = {
    "gps_common/msg/GPSFix": gps_fix("gps_common"),
    "gps_msgs/msg/GPSFix": gps_fix("gps_msgs"),
    "ublox_msgs/msg/NavPVT": nav_pvt,
    "ublox_ubx_msgs/msg/UBXNavPVT": ubx_nav_pvt,
    "nmea_msgs/msg/Sentence": nmea,
}


def bag(write, path, kind, message_of, form="ros2", others=()):
    make = write.maker(form)
    name = kind.rpartition("/")[2].lower()
    messages = [(f"/gnss/{name}", kind, STAMPS[k] + LATE_NS, message_of(make, k)) for k in range(N)]
    messages += [(topic, kind, stamp, content(make)) for topic, kind, stamp, content in others]
    return (write.ros1 if form == "ros1" else write.ros2)(path / ("run.bag" if form == "ros1" else "run"), messages)


def imu():
    """Readings of an IMU for `others` of `bag`."""
    stamps = range(STAMPS[0], STAMPS[-1], 20_000_000)
    rows = np.random.default_rng(1).normal([0, 0, 0, 0, 0, 9.8], 0.1, (len(stamps), 6))
    return [
        ("/imu0", "sensor_msgs/msg/Imu", t, lambda make, t=t, row=row: make.imu(t, row[:3], row[3:]))
        for t, row in zip(stamps, rows, strict=True)
    ]


def stream_of(path, place="gnss0/positions.csv", **fields):
    sensor = PositionSensor("gnss0", place, **fields)
    recording = open_recording(path)
    ((stream, notes),) = read(recording, [sensor], Reading(Rig(by_name(sensor)), lambda stream, what: stream))
    return instance(stream, PositionStream), (*recording.notes(), *notes)


def metres():
    """East, north and up of the first fix, on the ellipsoid's radii of curvature at that latitude."""
    a, e2 = 6378137.0, 6.69437999014e-3
    s = np.sin(np.deg2rad(WHERE[0, 0]))
    north = a * (1 - e2) / (1 - e2 * s**2) ** 1.5 + WHERE[0, 2]
    east = (a / np.sqrt(1 - e2 * s**2) + WHERE[0, 2]) * np.cos(np.deg2rad(WHERE[0, 0]))
    d = WHERE - WHERE[0]
    return np.stack([np.deg2rad(d[:, 1]) * east, np.deg2rad(d[:, 0]) * north, d[:, 2]], axis=1)


@each("form", ["ros1", "ros2"])
@each("kind", KINDS)
def test_messages_of_receivers(tmp_path, write, kind, form):
    stream, notes = stream_of(bag(write, tmp_path, kind, KINDS[kind], form))
    np.testing.assert_allclose(stream.stamps_ns, STAMPS, atol=0)
    np.testing.assert_allclose(stream.position, metres(), atol=2e-3)
    stated = {"GPSFix": [0.02, 0.08, 0.18], "Sentence": None}.get(kind.rpartition("/")[2], [4e-4, 4e-4, 9e-4])
    if stated is None:
        assert not len(stream.covariance)
    else:
        np.testing.assert_allclose(stream.covariance, np.tile(np.diag(stated), (N, 1, 1)), atol=1e-7)
    assert ("its stamps are the receiver's time (UTC)." in " ".join(notes)) == (kind == "ublox_msgs/msg/NavPVT")


def test_errors_of_gps_fix_where_the_covariance_is_unknown(tmp_path, write):
    path = bag(write, tmp_path, "gps_msgs/msg/GPSFix", gps_fix("gps_msgs", known=0))
    np.testing.assert_allclose(stream_of(path)[0].covariance[3], np.diag([0.25, 0.25, 1.0]))


def test_fixes_of_a_lesser_status_or_without_height(tmp_path, write):
    """Float and fixed ambiguities, two dimensions, dead reckoning alone, and no time yet."""

    def message(make, k):
        fix_type, flags, valid = {0: (3, 1, 3), 1: (2, 1, 7), 2: (1, 1, 7), 3: (3, 0, 7), 4: (3, 65, 7)}.get(
            k, (4, 129, 7)
        )
        return nav_pvt(make, k, fix_type, flags, valid)

    path = bag(write, tmp_path, "ublox_msgs/msg/NavPVT", message)
    stream, notes = stream_of(path, least_status="fixed")
    assert stream.stamps_ns.tolist() == STAMPS[5:]
    assert "(UTC); 1 fixes without it were left out." in " ".join(notes)
    assert "4 of 39 positions were left out, 3 without a fix and 1 worse than fixed" in " ".join(notes)


def test_sentences_that_are_damaged_or_say_other_things(tmp_path, write):
    def message(make, k):
        text = gga(k).replace(",N,", ",S,") if k == 7 else sentence("GPVTG,0,T") if k % 2 else gga(k)
        return make.make("nmea_msgs/msg/Sentence", make.header(STAMPS[k]), text + "\r\n")

    stream, notes = stream_of(bag(write, tmp_path, "nmea_msgs/msg/Sentence", message))
    assert stream.stamps_ns.tolist() == STAMPS[::2]
    assert "1 of 40 messages are damaged and were left out" in notes[0]
    assert "the checksum of the sentence is wrong" in notes[0]


def test_navsat_fixes_go_first(tmp_path, write):
    def navsat(k):
        def content(make):
            status = make.make("sensor_msgs/msg/NavSatStatus", 2, 1)
            values = (status, *WHERE[k].tolist(), np.zeros(9), 0)
            return make.make("sensor_msgs/msg/NavSatFix", make.header(STAMPS[k]), *values)

        return content

    others = imu() + [("/gnss/fix", "sensor_msgs/msg/NavSatFix", STAMPS[k], navsat(k)) for k in range(N)]
    path = bag(write, tmp_path, "ublox_msgs/msg/NavPVT", nav_pvt, others=others)
    assert not len(stream_of(path)[0].covariance)
    assert len(stream_of(path, topic="/gnss/navpvt")[0].covariance) == N
    draft = draft_rig(inspect_recording(path))
    assert "topic: /gnss/fix" in draft
    assert "navpvt" not in draft


@each("kind", KINDS)
def test_drafts_of_receivers(tmp_path, write, kind):
    path = bag(write, tmp_path, kind, KINDS[kind], others=imu())
    draft = draft_rig(inspect_recording(path))
    assert "type: position" in draft
    assert f"topic: /gnss/{kind.rpartition('/')[2].lower()}  # {kind}" in draft


def log(tmp_path: Path, lines, name="track.nmea"):
    (tmp_path / "gnss0").mkdir()
    (tmp_path / "gnss0" / name).write_text("\r\n".join(lines) + "\r\n")
    return tmp_path


@pytest.mark.parametrize("name", ["track.nmea", "track.txt"])
def test_logs_of_sentences(tmp_path, name):
    """With the date of RMC, a damaged line, and a fix that is none."""
    lines = [sentence("GNRMC,173000.00,A,4806.0,N,01130.0,E,0.1,0.0,280825,,,A")]
    lines += [gga(k, 0 if k == 3 else 4) for k in range(N)]
    lines[8] = lines[8].replace("4806", "4906")
    folder = log(tmp_path, lines, name)
    stream, notes = stream_of(folder, f"gnss0/{name}")
    assert stream.stamps_ns.tolist() == [s for k, s in enumerate(STAMPS) if k not in (3, 7)]
    np.testing.assert_allclose(np.delete(metres(), [3, 7], axis=0), stream.position, atol=2e-3)
    assert "1 damaged sentences were left out" in notes[0]
    readings = "".join(f"{t},0,0,{k % 2},0,0,9.8\n" for k, t in enumerate(range(STAMPS[0], STAMPS[-1], 20_000_000)))
    (folder / "imu0").mkdir()
    (folder / "imu0" / "data.csv").write_text("t,wx,wy,wz,ax,ay,az\n" + readings)
    assert f"path: gnss0/{name}  # log of NMEA sentences" in draft_rig(inspect_recording(folder))


def test_a_log_over_midnight_without_date(tmp_path):
    body = "GPGGA,{},4806.00{:02d},N,01130.0,E,1,8,1.0,500.0,M,45.5,M,,"
    lines = [sentence(body.format(c, k)) for k, c in enumerate(("235959.00", "235959.50", "000000.00", "000000.50"))]
    stream, _ = stream_of(log(tmp_path, lines), "gnss0/track.nmea")
    assert stream.stamps_ns.tolist() == [86_399_000_000_000 + k * 500_000_000 for k in range(4)]


def test_a_log_without_a_fix(tmp_path):
    with pytest.raises(RecordingError, match="track.nmea holds no GGA sentence with a fix; log GGA"):
        stream_of(log(tmp_path, [gga(k, 0) for k in range(N)]), "gnss0/track.nmea")
