"""Fixes in files and messages: RTKLIB's solutions, tables, NavSatFix; and what is wrong with them in one sentence."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.typed import instance, not_none

from icalib.data.recording import Reading
from icalib.data.recordings import open_recording
from icalib.errors import RecordingError
from icalib.rig import Rig, by_name
from icalib.sensors.position.read import checked_positions, read
from icalib.sensors.position.read.fixes import (
    AS_RECORDED,
    FIX_TYPES,
    NO_COVARIANCE,
    PositionReadings,
    about_first,
    from_fixes,
    from_geodetic,
    good_fixes,
    left_out,
    read_pos,
    read_position_table,
)
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.position.stream import PositionStream
from icalib.sensors.sensor import TableLayout

HEADER = (
    "% program   : RTKPOST\n"
    "%  {}  latitude(deg) longitude(deg) height(m)   Q  ns  sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio\n"
)
ROWS = (
    "2025/08/28 17:30:39.749 40.0966916 -105.1471665 1601.4350 1 25 0.01 0.02 0.03 0.004 -0.005 0.006 0.0 999\n"
    "2025/08/28 17:30:40.000 40.0966917 -105.1471665 1601.4360 2 25 0.01 0.02 0.03 0.004 -0.005 0.006 0.0 999\n"
    "2025/08/28 17:30:40.250 40.0966918 -105.1471665 1601.4370 5 25 0.01 0.02 0.03 0.004 -0.005 0.006 0.0 999\n"
)
EPOCH_S = 1756402239  # 2025-08-28 17:30:39 as if it were UTC


def pos_file(tmp_path, text, name="gnss.pos"):
    path = tmp_path / name
    path.write_text(text)
    return path


@pytest.mark.parametrize("scale", ["GPST", "UTC"])
def test_a_solution_of_rtklib(tmp_path, scale):
    read, coordinates = read_pos("gnss0", pos_file(tmp_path, HEADER.format(scale) + ROWS))
    assert coordinates == "geodetic"
    assert read.stamps_ns.tolist() == [EPOCH_S * 10**9 + ns for ns in (749_000_000, 1_000_000_000, 1_250_000_000)]
    np.testing.assert_array_equal(read.position[0], [40.0966916, -105.1471665, 1601.435])
    assert read.status.tolist() == [3, 2, 0]
    # East, north, up; off the diagonal signed squares of what the file has.
    expected = [[4e-4, 1.6e-5, -2.5e-5], [1.6e-5, 1e-4, 3.6e-5], [-2.5e-5, 3.6e-5, 9e-4]]
    np.testing.assert_allclose(read.covariance[1], expected, rtol=1e-12)


def test_week_and_seconds_and_angles_in_three_columns(tmp_path):
    header = "%  GPST          latitude(d'\") longitude(d'\") height(m)   Q  ns\n"
    rows = [f"2381 408639.749 40 05 48.0{k} -105 08 49.8 1601.4 1 25\n" for k in range(3)]
    read, _ = read_pos("gnss0", pos_file(tmp_path, header + "".join(rows)))
    assert read.stamps_ns[0] == EPOCH_S * 10**9 + 749_000_000
    np.testing.assert_allclose(read.position[0], [40 + 5 / 60 + 48 / 3600, -(105 + 8 / 60 + 49.8 / 3600), 1601.4])
    assert not len(read.covariance)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (ROWS, "no line that starts with % and names the columns"),
        (HEADER.format("GPST"), "holds no solutions"),
        (HEADER.format("GPST") + ROWS.replace("40.0966917", "here"), "gnss.pos:4: the line is not a solution"),
    ],
)
def test_no_solution(tmp_path, text, sentence):
    with pytest.raises(RecordingError, match=sentence):
        read_pos("gnss0", pos_file(tmp_path, text))


def readings(position, status=(), step_ns=200_000_000):
    n = len(position)
    return PositionReadings(
        "gnss0", np.arange(n) * step_ns, np.asarray(position, float), NO_COVARIANCE, np.array(status, np.int64)
    )


def walk(n=100, seed=0, noise=0.01):
    """A walk in a curve at 1.5 m/s, 5 Hz."""
    t = 0.2 * np.arange(n)
    p = np.stack([20 * np.sin(t / 13), 20 * np.cos(t / 13), 0.3 * np.sin(t)], axis=1)
    return p + noise * np.random.default_rng(seed).normal(size=(n, 3))


def test_metres_are_about_the_first_good_fix():
    degrees = np.array([[0.0, 0.0, 0.0], [40.0, 8.0, 500.0], [40.00001, 8.0, 501.0], [40.0, 8.00001, 502.0]])
    status = np.array([-1, 0, 3, 3])
    read = readings(degrees, status)
    good = good_fixes(status, "float", 4)
    metres, notes = from_geodetic("gnss.csv", read, good)
    assert metres.stamps_ns.tolist() == [400_000_000, 600_000_000]
    np.testing.assert_array_equal(metres.position[0], 0.0)
    # 1e-5 degrees: 1.1104 m of a meridian at 40 degrees, 0.8543 m of the parallel.
    np.testing.assert_allclose(metres.position[1], [0.8543, -1.1104, 1.0], atol=1e-3)
    assert "latitude 40.00001000" in notes[0]
    assert left_out("gnss.csv", status, good, "float") == (
        "gnss.csv: 2 of 4 positions were left out, 1 without a fix and 1 worse than float (least_status).",
    )


@pytest.mark.parametrize(
    ("degrees", "sentence"),
    [
        ([[-105.1, 40.0, 1600.0]] * 4, "as if latitude and longitude are swapped"),
        ([[4005.8, 10508.8, 1600.0]] * 4, "as if it is not in degrees"),
        ([[40.0, 8.0, np.nan]] * 4, "heights are missing"),
        ([[40.0, 8.0 + k, 0.0] for k in range(4)], "all heights are 0"),
        ([[40.0, 8.0 + k, 10.0] for k in range(4)], "km from the first one"),
        ([[0.0, 0.0, 10.0]] * 4, "no position has latitude"),
    ],
)
def test_what_is_wrong_with_latitude_and_longitude(degrees, sentence):
    degrees = np.array(degrees)
    with pytest.raises(RecordingError, match=sentence):
        from_geodetic("gnss.csv", readings(degrees), np.ones(4, bool))


def test_two_antennas_with_one_east_north_and_up():
    """Two routes to metres about the first fix of one antenna: directly, and about the first fix of the other."""
    degrees = np.array([[40.0, 8.0, 500.0], [40.01, 8.02, 530.0], [39.99, 8.0, 505.0], [40.02, 7.97, 480.0]])
    all_good = np.ones(4, bool)
    expected, _ = from_geodetic("a", readings(degrees), all_good)
    first, _ = from_geodetic("a", readings(degrees[:2]), all_good[:2])
    other, _ = from_geodetic("b", readings(degrees[2:]), all_good[2:])
    other = replace(other, covariance=np.tile(np.diag([1.0, 4.0, 9.0]), (2, 1, 1)))
    moved = other.inside("b", first.frame, "a")
    np.testing.assert_allclose(moved.position, expected.position[2:], atol=1e-6)
    turned = first.frame.axes @ other.frame.axes.T
    np.testing.assert_allclose(moved.covariance[0], turned @ np.diag([1.0, 4.0, 9.0]) @ turned.T, atol=1e-12)
    with pytest.raises(RecordingError, match="latitudes and longitudes cannot be in the frame of mocap0"):
        other.inside("b", AS_RECORDED, "mocap0")


def test_two_antennas_far_from_one_origin(tmp_path):
    """Metric tables that are counted from where each begins are counted from one place where they share a frame."""
    far = np.array([400_000.4, 5_000_000.0, 300.0])
    for k in range(2):
        folder = tmp_path / f"gnss{k}"
        folder.mkdir()
        p = walk() + far + [200.0 * k, 0.0, 0.0]
        rows = [",".join((str(200_000_000 * i), *(f"{x:.6f}" for x in row))) for i, row in enumerate(p)]
        (folder / "positions.csv").write_text("t [ns],x [m],y [m],z [m]\n" + "\n".join(rows) + "\n")
    rig = Rig(by_name(PositionSensor("gnss0", "gnss0/positions.csv"), PositionSensor("gnss1", "gnss1/positions.csv")))
    rig = rig.with_("gnss1", frame="gnss0")
    reading = Reading(rig, lambda stream, what: stream)
    found = read(open_recording(tmp_path), rig.of(PositionSensor), reading)
    first, other = (instance(stream, PositionStream) for stream, _ in found)
    np.testing.assert_allclose(other.position - first.position, np.tile([200.0, 0.0, 0.0], (100, 1)), atol=1e-5)
    assert "converted to the frame of gnss0" in found[1][1][-1]


def test_metric_positions_far_from_their_origin():
    near, notes = about_first("t.csv", readings(walk() + [400_000.4, 5_000_000.0, 300.0]))
    assert np.abs(near.position).max() < 60.0
    assert "relative to" in notes[0]
    assert about_first("t.csv", readings(walk()))[1] == ()


def test_good_fixes_stay_as_they_are():
    stream, notes = checked_positions(readings(walk()), "t.csv")
    assert notes == ()
    np.testing.assert_array_equal(stream.position, walk())


def test_single_fixes_that_jump_are_left_out():
    p = walk()
    p[[30, 70]] += [[3.0, 0.0, 0.0], [0.0, -2.0, 4.0]]
    stream, notes = checked_positions(readings(p), "t.csv")
    assert len(stream.stamps_ns) == 98
    assert "2 of 100 fixes are outliers" in notes[0]


def test_steps_of_the_solution_are_named():
    p = walk()
    p[40:60] += [0.9, -0.5, 1.2]
    stream, notes = checked_positions(readings(p), "t.csv")
    assert len(stream.stamps_ns) == 100
    assert "its fixes jump 2 times, by up to 1.6 m" in notes[0]


@pytest.mark.parametrize("end", [60, 100])
def test_a_frozen_receiver(end):
    """In the middle of the recording, and to its end."""
    p = walk(noise=0.0)
    p[40:end] = p[39]
    stream, notes = checked_positions(readings(p), "t.csv")
    assert len(stream.stamps_ns) == 100 - (end - 40)
    assert f"{end - 40} fixes repeat the one before exactly" in notes[0]


def test_an_antenna_that_stands_still_is_not_frozen():
    """It comes to rest at 1 m/s^2, and leaves as gently; positions are rounded to centimetres."""
    t = 0.2 * np.arange(100)
    speed = np.clip(np.minimum(8.0 - t, t - 12.0) * -1.0, 0.0, 1.5)
    p = np.zeros((100, 3))
    p[:, 0] = np.round(np.cumsum(speed) * 0.2, 2)
    stream, notes = checked_positions(readings(p), "t.csv")
    assert len(stream.stamps_ns) == 100, notes


@pytest.mark.parametrize(
    ("position", "sentence"),
    [
        (np.zeros((50, 3)), "all fixes are the same within 0 m"),
        (walk() * 1e3, "it moves at 1.5.* m/s, which is implausible"),
        (walk(2), "only 2 fixes are usable"),
        (np.where(np.arange(100)[:, None] % 3, np.nan, walk()), "positions are not finite"),
    ],
)
def test_what_is_no_motion_of_an_antenna(position, sentence):
    with pytest.raises(RecordingError, match=sentence):
        checked_positions(readings(position), "t.csv")


def fixes(kind, messages):
    _, fix_of = FIX_TYPES[kind]
    return from_fixes("gnss0", [(5 + k, not_none(fix_of(message))) for k, message in enumerate(messages)])


def navsat(status, kind=2, height=10.0):
    return SimpleNamespace(
        latitude=40.0,
        longitude=8.0,
        altitude=height,
        status=SimpleNamespace(status=status),
        position_covariance=np.diag([1e-4, 2e-4, 4e-4]).ravel(),
        position_covariance_type=kind,
    )


def test_navsat_fixes_with_covariances():
    read = fixes("sensor_msgs/msg/NavSatFix", [navsat(2), navsat(-1, 0, np.nan), navsat(0)])
    assert read.status.tolist() == [3, -1, 0]
    np.testing.assert_array_equal(read.position[0], [40.0, 8.0, 10.0])
    np.testing.assert_allclose(read.covariance[0], np.diag([1e-4, 2e-4, 4e-4]))


def test_covariances_that_are_unknown_are_none():
    assert fixes("sensor_msgs/msg/NavSatFix", [navsat(2), navsat(0, 0)]).covariance.shape == (0, 3, 3)


def test_points_and_poses():
    point = SimpleNamespace(x=1.0, y=2.0, z=3.0)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.diag([1e-4, 2e-4, 3e-4])
    pose = SimpleNamespace(position=point)
    stated = SimpleNamespace(pose=pose, covariance=covariance.ravel())
    transform = SimpleNamespace(translation=point, rotation=None)
    for kind, message, count in (
        ("geometry_msgs/msg/PointStamped", SimpleNamespace(point=point), 0),
        ("geometry_msgs/msg/PoseStamped", SimpleNamespace(pose=pose), 0),
        ("geometry_msgs/msg/TransformStamped", SimpleNamespace(transform=transform), 0),
        ("nav_msgs/msg/Odometry", SimpleNamespace(pose=stated), 2),
    ):
        read = fixes(kind, [message, message])
        np.testing.assert_array_equal(read.position, [[1.0, 2.0, 3.0]] * 2)
        assert len(read.covariance) == count


@pytest.mark.parametrize(
    ("header", "geodetic", "stated"),
    [
        ("t,x,y,z", False, 0),
        ("timestamp,east,north,up,sigma_e,sigma_n,sigma_u", False, 3),
        ("stamp,latitude,longitude,altitude", True, 0),
        ("time,lat,lon,height,sde,sdn,sdu", True, 3),
    ],
)
def test_tables(tmp_path, header, geodetic, stated):
    width = header.count(",") + 1
    rows = [[k * 200_000_000, 40.0 + k, 8.0, 5.0, 0.01, 0.02, 0.03][:width] for k in range(3)]
    path = pos_file(tmp_path, header + "\n" + "".join(",".join(map(str, row)) + "\n" for row in rows), "p.csv")
    read, coordinates = read_position_table(PositionSensor("gnss0", "p.csv"), path)
    assert coordinates == ("geodetic" if geodetic else "local")
    np.testing.assert_array_equal(read.position[:, 0], [40.0, 41.0, 42.0])
    assert len(read.covariance) == stated
    if stated:
        np.testing.assert_allclose(read.covariance[0], np.diag([1e-4, 4e-4, 9e-4]))


def test_columns_of_the_rig_file(tmp_path):
    """Named as in the header, whatever the names are."""
    path = pos_file(tmp_path, "a,b,c,d,lat_x\n" + "".join(f"{k}e-1,8,40,{k},5\n" for k in range(4)), "p.csv")
    sensor = PositionSensor("gnss0", "p.csv", layout=TableLayout(("a", "c", "b", "lat_x"), "s"))
    read, coordinates = read_position_table(sensor, path)
    assert coordinates == "local"
    assert read_position_table(replace(sensor, coordinates="geodetic"), path)[1] == "geodetic"
    np.testing.assert_array_equal(read.position[2], [40.0, 8.0, 5.0])
