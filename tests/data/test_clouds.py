"""Clouds of points as drivers write them, packed by hand: where each point is, and when it was measured."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import LidarStream
from icalib.data.recordings import BagRecording
from icalib.errors import RecordingError
from icalib.rig import Lidar
from icalib.rig.file import load_rig
from icalib.sensors.lidar.read import scans as recorded_scans
from icalib.sensors.lidar.read.point_clouds import checked_lidar
from icalib.tools.inspection import draft_rig, inspect_recording

POINTS = "sensor_msgs/msg/PointCloud2"
ORIGIN, PERIOD, SCANS = 1_700_000_000_123_456_789, 100_000_000, 12  # ns
RINGS, COLUMNS = 4, 90
CODES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


@dataclass(frozen=True)
class Scans:
    """Points of a LiDAR that turns, in the order of firing, column by column: stamps (S,) of each scan's first point,
    since (N,) that [ns], xyz (S, N, 3), ring (N,)."""

    stamps: np.ndarray
    since: np.ndarray
    xyz: np.ndarray
    ring: np.ndarray


def scans(direction: int = 1) -> Scans:
    rng = np.random.default_rng(5)
    column, ring = (a.ravel() for a in np.meshgrid(np.arange(COLUMNS), np.arange(RINGS), indexing="ij"))
    since = (column * (PERIOD // COLUMNS) + ring * 2_304).astype(np.int64)
    azimuth = 1.3 + direction * 2 * np.pi * since / PERIOD
    elevation = np.deg2rad([-10.0, -3.0, 3.0, 10.0])[ring]
    beam = np.stack([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)], 1)
    xyz = rng.uniform(1.0, 20.0, (SCANS, len(since), 1)) * beam
    return Scans(ORIGIN + PERIOD * np.arange(SCANS), since, xyz.astype(np.float32), ring)


def cloud(make: Any, stamp_ns: int, dtype: np.dtype, columns: dict[str, np.ndarray], height: int = 1) -> Any:
    rows = np.zeros(len(columns["x"]), dtype)
    for name, values in columns.items():
        rows[name] = values
    assert dtype.fields is not None
    fields = [
        make.make("sensor_msgs/msg/PointField", name, int(at[1]), CODES[at[0].str[1:]], 1)
        for name, at in dtype.fields.items()
    ]
    width, size = len(rows) // height, dtype.itemsize
    big = any(at[0].str.startswith(">") for at in dtype.fields.values())
    data = rows.view(np.uint8).reshape(-1)
    return make.make(POINTS, make.header(stamp_ns), height, width, fields, big, size, size * width, data, False)


def layout(itemsize: int, **fields: tuple[str, int]) -> np.dtype:
    fields = {"x": ("f4", 0), "y": ("f4", 4), "z": ("f4", 8)} | fields
    formats, offsets = zip(*fields.values(), strict=True)
    return np.dtype({"names": list(fields), "formats": formats, "offsets": offsets, "itemsize": itemsize})


VELODYNE = layout(22, intensity=("f4", 12), ring=("u2", 16), time=("f4", 18))
OUSTER = layout(48, intensity=("f4", 16), t=("u4", 20), reflectivity=("u2", 24), ring=("u1", 26), range=("u4", 32))
HESAI = layout(32, intensity=("f4", 12), timestamp=("f8", 16), ring=("u2", 24))
LIVOX = layout(26, intensity=("f4", 12), tag=("u1", 16), line=("u1", 17), timestamp=("f8", 18))
LIVOX_OFFSET = layout(18, offset_time=("u4", 12), line=("u1", 16), tag=("u1", 17))
PLAIN = layout(16, intensity=("f4", 12))


@pytest.fixture
def read(tmp_path, write):
    """Messages at their stamps -> the LiDAR's stream and the notes."""

    def build(messages: list[tuple[int, Any]], **fields: Any) -> tuple[LidarStream, tuple[str, ...]]:
        place = tmp_path / f"run{len(list(tmp_path.iterdir()))}"
        path = write.ros2(place, [("/lidar0/points", POINTS, t + 5, m) for t, m in messages])
        bag, lidar = BagRecording(path), Lidar("lidar0", "", **fields)
        stream, notes = checked_lidar(recorded_scans(bag, lidar), bag.where(lidar))
        return stream, bag.notes() + notes

    return build


def packed(
    make: Any, found: Scans, dtype: np.dtype, times: Any, stamp_at: int = 0, **others: Any
) -> list[tuple[int, Any]]:
    """A message for each scan, stamped `stamp_at` after its first point; times: scan, message's stamp -> columns."""
    messages = []
    for k, first in enumerate(found.stamps.tolist()):
        xyz = dict(zip("xyz", found.xyz[k].T, strict=True))
        ring = {name: found.ring for name in ("ring", "line") if name in (dtype.names or ())}
        stamp = first + stamp_at
        messages.append((stamp, cloud(make, stamp, dtype, xyz | ring | times(first + found.since, stamp), **others)))
    return messages


def check(stream: LidarStream, found: Scans, within_ns: float):
    """The points are where they were, at the instants at which they were measured."""
    assert stream.start.tolist() == [k * len(found.since) for k in range(SCANS + 1)]
    np.testing.assert_array_equal(stream.xyz, found.xyz.reshape(-1, 3))
    assert (stream.plane == -1).all()
    instants = (found.stamps[:, None] + found.since).ravel()
    scan = np.repeat(np.arange(SCANS), np.diff(stream.start))
    error = (stream.stamps_ns[scan] - instants) + np.float64(1e9) * stream.offset_s
    assert np.abs(error).max() < within_ns


LAST = int(scans().since[-1])
DRIVERS = {
    "velodyne, first stamped": (VELODYNE, lambda t, s: {"time": (t - s) * 1e-9}, 0, {}, 10),
    "velodyne, last stamped": (VELODYNE, lambda t, s: {"time": (t - s) * 1e-9}, LAST, {}, 10),
    "ouster": (OUSTER, lambda t, s: {"t": t - s}, 0, {}, 10),
    "ouster, big endian": (OUSTER.newbyteorder(">"), lambda t, s: {"t": t - s}, 0, {}, 10),
    "hesai": (HESAI, lambda t, s: {"timestamp": t // 10**9 + t % 10**9 * 1e-9}, 0, {}, 130),
    "robosense, last stamped": (HESAI, lambda t, s: {"timestamp": t // 10**9 + t % 10**9 * 1e-9}, LAST, {}, 130),
    "hesai, own clock": (HESAI, lambda t, s: {"timestamp": (t - ORIGIN) * 1e-9 + 77.0}, 0, {"point_time": "start"}, 10),
    "hesai, relative": (HESAI, lambda t, s: {"timestamp": (t - s) * 1e-9}, 0, {}, 10),
    "livox, absolute ns": (LIVOX, lambda t, s: {"timestamp": t.astype(np.float64)}, 3_000_000, {}, 140),
    "livox, offset": (LIVOX_OFFSET, lambda t, s: {"offset_time": t - s}, 0, {}, 10),
    "counted from the first, stamped at the last": (
        VELODYNE,
        lambda t, s: {"time": (t - t[0]) * 1e-9},
        LAST,
        {"point_time": "end"},
        10,
    ),
    "counted to the last, stamped at the first": (
        VELODYNE,
        lambda t, s: {"time": (t - t[-1]) * 1e-9},
        0,
        {"point_time": "start"},
        10,
    ),
}


@each("driver", DRIVERS)
def test_points_are_timed_as_drivers_write_it(write, read, driver):
    dtype, times, stamp_at, fields, within_ns = DRIVERS[driver]
    found = scans()
    stream, notes = read(packed(write.maker(), found, dtype, times, stamp_at), **fields)
    check(stream, found, within_ns)
    assert notes == ()


def test_points_on_a_clock_of_their_own(write, read):
    """The clock started 77 s before the first scan; the stream is on it."""
    found = scans()
    messages = packed(write.maker(), found, HESAI, lambda t, s: {"timestamp": (t - ORIGIN) * 1e-9 + 77.0}, 20_000_000)
    stream, notes = read(messages)
    moved = Scans(found.stamps - ORIGIN + 77_000_000_000, found.since, found.xyz, found.ring)
    check(stream, moved, 10)
    assert len(notes) == 1 and "the point times `timestamp` are from another clock than the message stamps" in notes[0]


@each("direction", [1, -1])
@each("order", ["columns", "rows", "organised"])
def test_points_are_timed_by_azimuth(write, read, direction, order):
    """Within the firing of a column; the second message begins with a hole of a quarter of a turn."""
    found = scans(direction)
    if order != "columns":
        by_ring = np.lexsort((found.since, found.ring))
        found = Scans(found.stamps, found.since[by_ring], found.xyz[:, by_ring], found.ring[by_ring])
    if order == "organised":
        found.xyz[1, found.since < PERIOD // 4] = np.nan
    height = RINGS if order == "organised" else 1
    messages = packed(write.maker(), found, PLAIN, lambda t, s: {}, height=height)
    stream, notes = read(messages, point_time="azimuth")
    assert "from the azimuth, " + ("counterclockwise" if direction > 0 else "clockwise") in " ".join(notes)
    if order == "organised":
        lost = np.isnan(found.xyz[1, :, 0])
        assert lost.any() and f"{lost.sum()} without numbers" in " ".join(notes)
        instants = (found.stamps[:, None] + found.since)[~np.isnan(found.xyz[:, :, 0])]
        scan = np.repeat(np.arange(SCANS), np.diff(stream.start))
        error = stream.stamps_ns[scan] - instants + 1e9 * stream.offset_s
        assert np.abs(error).max() < 2 * RINGS * 2_304
    else:
        check(stream, found, 2 * RINGS * 2_304)


def test_a_point_left_of_where_the_sweep_begins_is_not_late_by_a_turn(write, read):
    """Lasers look up to 2 degrees to the side."""
    found = scans()
    turn = np.deg2rad(np.linspace(-2.0, 2.0, RINGS))[found.ring]
    x, y = found.xyz[..., 0].copy(), found.xyz[..., 1].copy()
    found.xyz[..., 0], found.xyz[..., 1] = np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
    stream, _ = read(packed(write.maker(), found, PLAIN, lambda t, s: {}), point_time="azimuth")
    check(stream, found, 4.1 / 360 * PERIOD + 2 * RINGS * 2_304)


def test_snapshots(write, read):
    found = scans()
    still = Scans(found.stamps, np.zeros_like(found.since), found.xyz, found.ring)
    stream, notes = read(packed(write.maker(), still, PLAIN, lambda t, s: {}), point_time="snapshot")
    check(stream, still, 1)
    assert "all points of a cloud are taken at its stamp" in notes[0]


def test_points_that_cannot_be_used_are_counted(write, read):
    found = scans()
    found.xyz[0, 0], found.xyz[0, 1, 2], found.xyz[1, 3:6] = np.nan, np.inf, 0.0
    found.xyz[2, 7] = [0.3, 0.2, 0.1]
    found.xyz[3, :4] *= 200.0 / np.linalg.norm(found.xyz[3, :4], axis=1, keepdims=True)
    found.xyz[4] = 0.0
    found.xyz[5, 9] = [0.6, 0.0, 0.0]
    messages = packed(write.maker(), found, VELODYNE, lambda t, s: {"time": (t - s) * 1e-9})
    stream, notes = read(messages, min_range_m=0.5, max_range_m=150.0)
    n = len(found.since)
    assert (
        f"of {SCANS * n} points 2 without numbers, {3 + n} at zero, 1 nearer than 0.5 m, 4 farther than 150 m"
        in (notes[0])
    )
    assert "1 of 12 scans have no usable point and were left out" in notes[1] and len(notes) == 2
    kept = np.delete(found.xyz.reshape(-1, 3), _flat(n, [(0, 0), (0, 1), (1, 3), (1, 4), (1, 5), (2, 7)]), axis=0)
    kept = kept[(kept != 0).any(axis=1) & (np.linalg.norm(kept, axis=1) < 150.0)]
    np.testing.assert_array_equal(stream.xyz, kept)
    assert np.diff(stream.start).tolist() == [n - 2, n - 3, n - 1, n - 4] + [n] * 7
    np.testing.assert_allclose(stream.offset_s[: n - 2], found.since[2:] * 1e-9, atol=1e-8)


def _flat(n: int, places: list[tuple[int, int]]) -> list[int]:
    return [scan * n + point for scan, point in places]


def stamped(times: Any, shuffle: bool = False) -> Any:
    def build(make: Any) -> list[tuple[int, Any]]:
        messages = packed(make, scans(), times[0], times[1])
        return [*messages[6:], *messages[:6]] if shuffle else messages

    return build


REFUSED = {
    "no times": (stamped((PLAIN, lambda t, s: {})), {}, "no times (their fields are x, y, z, intensity); record a clo"),
    "no unit": (
        stamped((HESAI, lambda t, s: {"timestamp": t * 3e-8})),
        {},
        "increases by 3 from scan to scan, which is 0.1 s",
    ),
    "times of float32": (
        stamped((layout(16, timestamp=("f4", 12)), lambda t, s: {"timestamp": t * 1e-9})),
        {},
        "all points of a scan have the same `timestamp`",
    ),
    "zeros": (stamped((VELODYNE, lambda t, s: {})), {}, "all points of a scan have the same `time`; correct"),
    "set back": (
        stamped((VELODYNE, lambda t, s: {"time": (t - s) * 1e-9}), shuffle=True),
        {},
        f"the scan at {ORIGIN} ns comes after the one at {ORIGIN + 11 * PERIOD} ns",
    ),
    "all too far": (
        stamped((VELODYNE, lambda t, s: {"time": (t - s) * 1e-9})),
        {"min_range_m": 50.0},
        "0 of 12 scans have usable points",
    ),
}


@each("case", REFUSED)
def test_what_would_be_wrong_is_refused(write, read, case):
    build, fields, words = REFUSED[case]
    with pytest.raises(RecordingError) as error:
        read(build(write.maker()), **fields)
    assert words in str(error.value) and "/lidar0/points (lidar0)" in str(error.value)


OTHER_UNITS = {
    "milliseconds": (VELODYNE, lambda t, s: {"time": (t - s) * 1e-6}, "`time`, read as s,", "ms", 20),
    "microseconds": (OUSTER, lambda t, s: {"t": (t - s) // 1000}, "`t`, read as ns,", "us", 1010),
    "milliseconds as whole numbers": (
        OUSTER,
        lambda t, s: {"t": (t - s) // 10**6},
        "`t`, read as ns,",
        "ms",
        1_000_010,
    ),
    "nanoseconds as decimals": (VELODYNE, lambda t, s: {"time": (t - s) * 1.0}, "`time`, read as s,", "ns", 20),
}


@each("case", OTHER_UNITS)
@each("given", [False, True])
def test_the_unit_is_the_one_that_fits(write, read, case, given):
    """How long scans take leaves one unit, which a note names; the rig file may say it."""
    dtype, times, words, unit, within_ns = OTHER_UNITS[case]
    found = scans()
    stream, notes = read(packed(write.maker(), found, dtype, times), **({"point_time_unit": unit} if given else {}))
    check(stream, found, within_ns)
    if given:
        assert notes == ()
    else:
        assert words in notes[0] and f"they are read as {unit}, the only unit that fits" in notes[0]


def test_a_unit_that_does_not_fit_is_refused(write, read):
    messages = packed(write.maker(), scans(), VELODYNE, lambda t, s: {"time": (t - s) * 1e-6})
    with pytest.raises(RecordingError, match="`time`, read as s, spread .* set point_time_unit of lidar0 to ms in"):
        read(messages, point_time_unit="s")
    clock = packed(write.maker(), scans(), LIVOX, lambda t, s: {"timestamp": t * 1.0})
    with pytest.raises(RecordingError, match="is 0.1 s in ns, not in us; correct point_time_unit of lidar0"):
        read(clock, point_time_unit="us")


def test_a_flash_may_take_as_little_as_it_likes(write, read):
    """100 us, in a unit that is given."""
    found = scans()
    flash = Scans(found.stamps, found.since // 1000, found.xyz, found.ring)
    messages = packed(write.maker(), flash, OUSTER, lambda t, s: {"t": t - s})
    stream, notes = read(messages, point_time_unit="ns")
    check(stream, flash, 10)
    assert notes == ()


AEVA = layout(24, intensity=("f4", 12), time_offset_ns=("i4", 16), velocity=("f4", 20))
BLICKFELD = layout(24, intensity=("f4", 12), point_id=("u4", 16), point_time_offset=("u4", 20))
OF_OTHERS = {
    "aeva": (AEVA, lambda t, s: {"time_offset_ns": t - s, "velocity": np.arange(len(t)) * 0.1}),
    "blickfeld": (BLICKFELD, lambda t, s: {"point_time_offset": t - s, "point_id": np.arange(len(t))}),
}


@pytest.mark.parametrize("driver", OF_OTHERS)
def test_fields_of_other_vendors(write, read, driver):
    found = scans()
    stream, notes = read(packed(write.maker(), found, *OF_OTHERS[driver]))
    check(stream, found, 10)
    assert notes == ()


def test_the_rig_file_names_the_field(write, read):
    """A field of another name, in us; a field that is known but says nothing, beside it."""
    dtype = layout(28, t=("u4", 12), laser_usec=("u4", 16), laser=("u2", 20))
    messages = packed(write.maker(), scans(), dtype, lambda t, s: {"laser_usec": (t - s) // 1000})
    with pytest.raises(RecordingError) as error:
        read(messages)
    assert "laser_usec looks like one: set point_time_field: laser_usec of lidar0 in the rig file" in str(error.value)
    assert "snapshot" not in str(error.value)
    stream, notes = read(messages, point_time_field="laser_usec", point_time_unit="us")
    check(stream, scans(), 1010)
    assert notes == ()
    with pytest.raises(
        RecordingError, match=r"no point has a `ts` \(their fields are x, .*correct point_time_field of"
    ):
        read(messages, point_time_field="ts")
    with pytest.raises(
        RecordingError, match="all points of a scan have the same `t` .*; correct point_time_field of lid"
    ):
        read(messages, point_time_field="t")


@each(
    ("dtype", "times", "lines"),
    [
        (layout(20, laser_usec=("u4", 12)), lambda t, s: {"laser_usec": (t - s) // 1000}, ["laser_usec", "us"]),
        (VELODYNE, lambda t, s: {"time": (t - s) * 1e-6}, [None, "ms"]),
        (OUSTER, lambda t, s: {"t": t - s}, [None, None]),
    ],
)
def test_inspect_drafts_what_the_rig_file_must_say(tmp_path, write, dtype, times, lines):
    make, rng = write.maker(), np.random.default_rng(0)
    readings = rng.normal(size=(120, 6)) + [0, 0, 0, 0, 0, 9.8]
    imu = [(ORIGIN + k * 10**7, row) for k, row in enumerate(readings)]
    messages = [("/imu0", "sensor_msgs/msg/Imu", t, make.imu(t, row[:3], row[3:])) for t, row in imu]
    messages += [("/lidar0/points", POINTS, t + 5, m) for t, m in packed(make, scans(), dtype, times)]
    path = write.ros2(tmp_path / "run", sorted(messages, key=lambda m: m[2]))
    draft = draft_rig(inspect_recording(path))
    (tmp_path / "rig.yaml").write_text(draft)
    (lidar,) = load_rig(tmp_path / "rig.yaml").lidars
    assert [lidar.point_time_field, lidar.point_time_unit] == lines
    check(recorded_scans(BagRecording(path), lidar), scans(), 1010)
    assert ("point_time" in draft) == (lines != [None, None])


def test_inspect_says_what_calibrate_would(tmp_path, write):
    """No times at all."""
    make = write.maker()
    messages = [("/lidar0/points", POINTS, t + 5, m) for t, m in packed(make, scans(), PLAIN, lambda t, s: {})]
    found = inspect_recording(write.ros2(tmp_path / "run", messages))
    (sentence,) = [f.sentence for f in found.findings if "the points have no times" in f.sentence]
    assert "/lidar0/points (lidar0)" in sentence and found.verdict == "no"


def test_a_field_of_an_unknown_name_may_be_the_time(write, read):
    dtype = layout(20, intensity=("f4", 12), firing=("u4", 16))
    with pytest.raises(
        RecordingError, match="set point_time_field of lidar0 if one of firing is their time; else recor"
    ):
        read(packed(write.maker(), scans(), dtype, lambda t, s: {"firing": t - s}))


BAD_TIMES = {
    "ran below zero": (OUSTER, lambda t, s: {"t": t - s}, "t", 2**32 - 40_000),
    "far off": (VELODYNE, lambda t, s: {"time": (t - s) * 1e-9}, "time", 3e5),
    "not a number": (VELODYNE, lambda t, s: {"time": (t - s) * 1e-9}, "time", np.nan),
    "infinite, in us": (VELODYNE, lambda t, s: {"time": (t - s) * 1e-3}, "time", -np.inf),
    "of another day": (HESAI, lambda t, s: {"timestamp": t // 10**9 + t % 10**9 * 1e-9}, "timestamp", 86400.0),
    "an hour late": (LIVOX, lambda t, s: {"timestamp": t * 1.0}, "timestamp", float(ORIGIN + 3600 * 10**9)),
}


@each("case", BAD_TIMES)
@each("every", [1, 3, 100])
def test_single_bad_times_are_left_out(write, read, case, every):
    """In one scan of three, or in all: one point in a hundred."""
    dtype, times, field, bad = BAD_TIMES[case]
    found, rows = scans(), np.arange(3, 360, every)[:4]

    def with_bad(t, s):
        columns = times(t, s)
        if every == 100 or (s // PERIOD) % 3 == 0:
            columns[field] = columns[field].astype(np.float64)
            columns[field][rows] = bad
        return columns

    stream, notes = read(packed(write.maker(), found, dtype, with_bad))
    lost = [k for k in range(SCANS) if every == 100 or ((ORIGIN + k * PERIOD) // PERIOD) % 3 == 0]
    counts = [len(found.since) - len(rows) * (k in lost) for k in range(SCANS)]
    assert np.diff(stream.start).tolist() == counts
    kept = np.array([k not in lost or i not in rows for k in range(SCANS) for i in range(len(found.since))])
    instants = (found.stamps[:, None] + found.since).ravel()[kept]
    scan = np.repeat(np.arange(SCANS), counts)
    assert np.abs(stream.stamps_ns[scan] - instants + 1e9 * stream.offset_s).max() < 150
    left_out = f"of {kept.size} points {(~kept).sum()} without a time within their scan were left out"
    assert any(left_out in note for note in notes)


def test_bytes_that_are_no_numbers(write, read):
    """NaN that signal, where hardware left rubbish: no warning of numpy's. Coordinates beyond float32."""

    def with_rubbish(t, s):
        time = ((t - s) * 1e-9).astype(np.float32)
        time.view(np.uint32)[[5, 9]] = 0x7F800001, 0xFF812345
        return {"time": time}

    wide = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("time", "<f4")])
    for dtype in (VELODYNE, wide):
        found = scans()
        found.xyz[2, 0] = 3e38
        stream, notes = read(packed(write.maker(), found, dtype, with_rubbish))
        assert len(stream.xyz) == found.xyz.shape[0] * found.xyz.shape[1] - 2 * SCANS - 1
        assert f"1 without numbers, {2 * SCANS} without a time within their scan were left out" in notes[0]


@each("odd", [0, 1, 7, 11])
def test_a_cloud_of_other_fields_is_left_out(write, read, odd):
    make, found = write.maker(), scans()
    messages = packed(make, found, VELODYNE, lambda t, s: {"time": (t - s) * 1e-9})
    messages[odd] = packed(make, found, PLAIN, lambda t, s: {})[odd]
    stream, notes = read(messages)
    assert stream.stamps_ns.tolist() == np.delete(found.stamps, odd).tolist()
    assert f"1 clouds lack fields of the others and were left out, the first at {found.stamps[odd]} ns" in notes[0]


@each("point_time", ["auto", "azimuth", "snapshot"])
def test_clouds_that_are_all_stamped_alike(write, read, point_time):
    make, found = write.maker(), scans()
    still = Scans(np.full(SCANS, ORIGIN), found.since, found.xyz, found.ring)
    messages = packed(make, still, VELODYNE, lambda t, s: {"time": (t - s) * 1e-9})
    with pytest.raises(
        RecordingError, match="the stamps of the first clouds do not increase .*; have the driver stamp each"
    ):
        read(messages, point_time=point_time)


def test_empty_clouds_at_first(write, read):
    """A LiDAR that warms up; its driver sends clouds without fields."""
    make, found = write.maker(), scans()
    bare = np.dtype({"names": ["x"], "formats": ["f4"], "offsets": [0], "itemsize": 4})
    empty = [(t, cloud(make, t, bare, {"x": np.zeros(0)})) for t in range(ORIGIN - 20 * PERIOD, ORIGIN, PERIOD)]
    stream, notes = read(empty + packed(make, found, VELODYNE, lambda t, s: {"time": (t - s) * 1e-9}))
    check(stream, found, 10)
    assert "20 of 32 scans have no usable point and were left out" in notes[0]


def test_what_does_not_turn_has_no_azimuth(write, read):
    found = scans()
    azimuth = 0.6 * np.sin(40.0 * found.since / PERIOD)
    found.xyz[...] = 5.0 * np.stack([np.cos(azimuth), np.sin(azimuth), 0.0 * azimuth], axis=1)
    with pytest.raises(RecordingError, match="the points are not in order of azimuth"):
        read(packed(write.maker(), found, PLAIN, lambda t, s: {}), point_time="azimuth")


def test_empty_clouds(write, read):
    make = write.maker()
    messages = [(t, cloud(make, t, VELODYNE, {"x": np.zeros(0)})) for t in scans().stamps.tolist()]
    with pytest.raises(RecordingError, match="0 of 12 clouds have points"):
        read(messages)


@each(
    "wrong",
    [
        {"offset": 2**31 - 1},
        {"offset": 2**32 - 1},
        {"offset": VELODYNE.itemsize - 3},
        {"count": 2**31},
        {"count": 2**32 - 1},
        {"datatype": 9},
        {"datatype": 8, "offset": 15},
        {"name": "x"},
    ],
)
def test_fields_that_lie_beyond_a_point(write, read, wrong):
    """numpy reads outside of the data at an offset near 2^31."""
    make, found = write.maker(), scans()
    messages = packed(make, found, VELODYNE, lambda t, s: {"time": (t - s) * 1e-9})
    last = messages[3][1].fields[-1]
    messages[3][1].fields[-1] = dataclasses.replace(last, **wrong)
    stream, notes = read(messages)
    assert stream.stamps_ns.tolist() == np.delete(found.stamps, 3).tolist()
    assert "1 of 12 messages are damaged and were left out" in notes[0]
    with pytest.raises(RecordingError, match=r"is damaged \(.+\), and so are all others; copy or record the bag again"):
        read([(t, dataclasses.replace(m, fields=messages[3][1].fields)) for t, m in messages])


@each(
    "wrong",
    [
        {"width": 2**32 - 1},
        {"height": 2**32 - 1},
        {"width": 2**31, "row_step": 0, "point_step": 0},
        {"point_step": 2**32 - 1, "row_step": 2**32 - 1},
        {"row_step": 0},
        {"point_step": 0},
        {"data": np.zeros(0, np.uint8)},
    ],
)
def test_sizes_that_do_not_fit_the_data(write, read, wrong):
    make, found = write.maker(), scans()
    messages = packed(make, found, VELODYNE, lambda t, s: {"time": (t - s) * 1e-9})
    messages[5] = (messages[5][0], dataclasses.replace(messages[5][1], **wrong))
    stream, notes = read(messages)
    assert stream.stamps_ns.tolist() == np.delete(found.stamps, 5).tolist()
    assert "1 of 12 messages are damaged and were left out" in notes[0]
    none = {"width": 0, "row_step": 0, "point_step": 2**32 - 1, "data": np.zeros(0, np.uint8)}
    messages[5] = (messages[5][0], dataclasses.replace(messages[5][1], **(wrong | none)))
    assert "1 of 12 scans have no usable point and were left out" in read(messages)[1][0]


def test_no_coordinates(write, read):
    make, dtype = write.maker(), np.dtype([("x", "<f4"), ("y", "<f4"), ("time", "<f4")])
    with pytest.raises(RecordingError, match="have no x, y, z, but x, y, time; choose another topic"):
        read(
            [
                (t, cloud(make, t, dtype, {"x": np.ones(3), "time": np.arange(3) * 0.03}))
                for t in scans().stamps.tolist()
            ]
        )


def test_the_topic_is_chosen_as_that_of_cameras(tmp_path, write):
    make = write.maker()
    messages = packed(make, scans(), VELODYNE, lambda t, s: {"time": (t - s) * 1e-9})
    both = [(topic, POINTS, t + 5, m) for t, m in messages for topic in ("/front/points", "/rear/points")]
    bag = BagRecording(write.ros2(tmp_path / "run", both))
    assert bag.where(Lidar("rear", "")).endswith("run /rear/points")
    with pytest.raises(RecordingError, match="top may be any of /front/points, /rear/points; set `topic` of top"):
        recorded_scans(bag, Lidar("top", ""))
    with pytest.raises(RecordingError, match="has no topic /top; it holds /front/points \\(sensor_msgs"):
        recorded_scans(bag, Lidar("top", "", topic="/top"))
