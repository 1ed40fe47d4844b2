"""Tables as other programs write them: columns by name, other separators, stamps in other units."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.data.recordings import FolderRecording, read_measurements
from icalib.data.stamps import unit_of_stamps, usual_step
from icalib.data.tables import TableKind, holds, named, read_table
from icalib.errors import RecordingError, RigError
from icalib.rig import Camera, ImuSensor, PoseSensor, Rig, TableLayout, Wheels, by_name
from icalib.rig.file import load_rig, rig_from_dict, rig_to_dict
from icalib.sensors.camera.read import tracks as recorded_tracks
from icalib.sensors.imu.read import IMU
from icalib.sensors.imu.spec import class_noise
from icalib.sensors.pose.read import readings as pose_readings
from icalib.sensors.wheels.read import WheelReadings
from icalib.sensors.wheels.read import readings as wheel_readings

ORIGIN, STEP, N = 1_700_000_000_123_456_789, 5_000_000, 60
STAMPS = ORIGIN + STEP * np.arange(N)
VALUES = np.round(np.random.default_rng(3).normal(size=(N, 6)) + [0, 0, 0, 0, 0, 9.8], 6)
NAMES = ("wx", "wy", "wz", "ax", "ay", "az")


def rows(separator: str = ",", stamps: list[str] | None = None, values: np.ndarray = VALUES) -> str:
    stamps = stamps or [str(t) for t in STAMPS.tolist()]
    return "".join(separator.join([t, *map(repr, row)]) + "\n" for t, row in zip(stamps, values.tolist(), strict=True))


def read(folder: Path, text: str, layout: TableLayout | None = None, kind: TableKind = IMU):
    path, notes = folder / "data.csv", []
    path.write_text(text)
    table = read_table(path, kind, layout or TableLayout(), notes.append)
    return table, notes


def refused(folder: Path, text: str, layout: TableLayout | None = None) -> str:
    with pytest.raises(RecordingError) as error:
        read(folder, text, layout)
    sentence = str(error.value)
    assert sentence.startswith(str(folder)) and sentence.endswith(".") and "\n" not in sentence
    return sentence


def check(table, stamps=STAMPS) -> None:
    np.testing.assert_array_equal(table.integers[:, 0], stamps)
    np.testing.assert_array_equal(table.decimals, VALUES)


SEPARATORS = {",": ",", ";": ";", "tab": "\t", " ": " ", "blanks": "   ", ", ": ", "}


@each("name", SEPARATORS)
@each("head", ["", "t{0}wx{0}wy{0}wz{0}ax{0}ay{0}az\n", "# a comment\n# t{0}wx{0}wy{0}wz{0}ax{0}ay{0}az\n"])
def test_separators(tmp_path, name, head):
    separator = SEPARATORS[name]
    table, notes = read(tmp_path, head.format(separator) + rows(separator))
    check(table)
    assert notes == []


def test_decimal_commas_beside_semicolons(tmp_path):
    check(read(tmp_path, "t;wx;wy;wz;ax;ay;az\r\n" + rows(";").replace(".", ",").replace("\n", "\r\n"))[0])


ACCEL_FIRST = VALUES[:, [3, 4, 5, 0, 1, 2]]


@each(
    "names",
    [
        "timestamp,ax,ay,az,wx,wy,wz",
        "#timestamp [ns],a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2],w_RS_S_x [rad s^-1],w_RS_S_y,w_RS_S_z",
        "Time,AccX (m/s^2),AccY (m/s^2),AccZ (m/s^2),GyroX (rad/s),GyroY (rad/s),GyroZ (rad/s)",
        '"time_ns","imu0_accel_x","imu0_accel_y","imu0_accel_z","imu0_gyro_x","imu0_gyro_y","imu0_gyro_z"',
        "stamp,xacc,yacc,zacc,xgyro,ygyro,zgyro",
        "timestamp,alpha_x,alpha_y,alpha_z,omega_x,omega_y,omega_z",
        "some clock,ax,ay,az,gx,gy,gz",
    ],
)
def test_columns_by_the_names_of_the_header(tmp_path, names):
    check(read(tmp_path, names + "\n" + rows(values=ACCEL_FIRST))[0])


def test_other_columns_are_left_out(tmp_path):
    """As `rostopic echo -p` writes them."""
    head = "%time,field.header.seq,field.header.stamp,field.header.frame_id," + ",".join(
        [f"field.orientation.{k}" for k in "xyzw"]
        + [f"field.angular_velocity.{k}" for k in "xyz"]
        + [f"field.linear_acceleration.{k}" for k in "xyz"]
    )
    lines = [
        f"{t + 999},{k},{t},imu link,0.0,0.0,0.0,1.0,{','.join(map(repr, row))}"
        for k, (t, row) in enumerate(zip(STAMPS.tolist(), VALUES.tolist(), strict=True))
    ]
    table, notes = read(tmp_path, "\n".join([head, *lines]))
    check(table)
    assert notes == []


def test_columns_of_the_rig_file(tmp_path):
    text = "clock,foo [g],b,c,p,q,r,s\n" + "".join(
        f"{t},{','.join(map(repr, row))},text\n" for t, row in zip(STAMPS.tolist(), ACCEL_FIRST.tolist(), strict=True)
    )
    assert "its columns are clock, foo [g], b, c, p, q, r, s; say which are t [ns], wx" in refused(tmp_path, text)
    check(read(tmp_path, text, TableLayout(("clock", "p", "q", "r", "foo", "b", "c")))[0])
    without = text.partition("\n")[2]
    check(read(tmp_path, without, TableLayout(("1", "5", "6", "7", "2", "3", "4")))[0])
    for columns, words in (
        (("clock", "p"), "`columns` in the rig file needs 7 names, for t [ns], wx"),
        (("clock", "p", "q", "r", "foo", "b", "x"), "has 'x', but the table has clock, foo [g], b"),
        (("clock", "p", "q", "r", "foo", "b", "b"), "has a column twice"),
    ):
        assert words in refused(tmp_path, text, TableLayout(columns))
    assert "has 'clock', but the table has no header" in refused(
        tmp_path, without, TableLayout(("clock", "p", "q", "r", "foo", "b", "c"))
    )


def test_a_header_in_another_order_is_not_read_by_order(tmp_path):
    text = "time,ax,ay,az,gyro one,gyro two,gyro three\n" + rows(values=ACCEL_FIRST)
    assert "its header names time, ax, ay, az" in refused(tmp_path, text)


UNITS = {"s": ("seconds", 9), "ms": ("milliseconds", 6), "us": ("microseconds", 3), "ns": ("nanoseconds", 0)}


def written(stamps: np.ndarray, power: int, digits: int) -> list[str]:
    """Stamps [ns] in a unit of 10^power ns, with so many digits after the point."""
    out = []
    for t in stamps.tolist():
        whole, fraction = divmod(t, 10**power)
        out.append(f"{whole}.{fraction:0{power}d}"[: len(str(whole)) + 1 + digits] if digits else str(whole))
    return out


@each("unit", ["s", "ms", "us"])
@each("origin", [ORIGIN, 41_234_567, 0])
def test_units_of_stamps_are_told_by_their_rate(tmp_path, unit, origin):
    words, power = UNITS[unit]
    stamps = origin + STEP * np.arange(N)
    table, notes = read(tmp_path, rows(stamps=written(stamps, power, power)))
    check(table, stamps)
    assert len(notes) == 1 and f"the stamps are read as {words}, as their rate shows; `time_unit`" in notes[0]
    table, notes = read(tmp_path, rows(stamps=written(stamps, power, power)), TableLayout(time_unit=unit))
    check(table, stamps)
    assert notes == []


def test_stamps_as_numpy_and_pandas_write_them(tmp_path):
    table, _ = read(tmp_path, rows(stamps=[f"{t // 10**18}.{t % 10**18:018d}e+18" for t in STAMPS.tolist()]))
    check(table)
    table, _ = read(tmp_path, rows(stamps=[f"{t // 10**18}.{t % 10**18:018d}e+09" for t in STAMPS.tolist()]))
    check(table)
    table, _ = read(tmp_path, rows(stamps=[f"{t}.0" for t in STAMPS.tolist()]))
    check(table)


def test_digits_beyond_nanoseconds_are_rounded(tmp_path):
    stamps = [f"{k // 200}.{k % 200 * 5:03d}0000004999{'9' * 20}" for k in range(N)]
    np.testing.assert_array_equal(read(tmp_path, rows(stamps=stamps))[0].integers[:, 0], STEP * np.arange(N))


def test_bursts_and_jumps_do_not_change_the_unit():
    bursts = ORIGIN + np.repeat(np.arange(40) * 50_000_000, 10) + np.tile(np.arange(10) * 2000, 40)
    assert 4e6 < usual_step(bursts) < 6e6
    jumped = np.concatenate([STEP * np.arange(300), ORIGIN + STEP * np.arange(3000)])
    assert usual_step(jumped) == STEP
    assert unit_of_stamps(jumped / 1000, 10.0, 20_000.0) == "us"


@each(
    ("step", "count", "rate_hz", "unit"),
    [
        (33, 900, (1e-3, 1000.0), "ms"),  # 30 s at 30 Hz, and not eight hours
        (5, 30, (1e-3, 1000.0), "s"),  # still images every five seconds, and not 0.15 s
        (1, 100, (1e-2, 5000.0), "s"),
        (1_000_000, 100, (1e-2, 5000.0), "us"),
        (0.05, 1000, (1e-3, 1000.0), "s"),
        (20, 200_000, (1e-2, 5000.0), "ms"),  # over an hour at 50 Hz
    ],
)
def test_units_of_clocks_since_boot(step, count, rate_hz, unit):
    assert unit_of_stamps(7.0 + step * np.arange(count), *rate_hz) == unit


def test_single_unreadable_lines_are_left_out(tmp_path):
    lines = rows().splitlines()
    lines[10], lines[20], lines[-1] = lines[10].replace(",", ",nan,", 1), "garbage", lines[-1][:30]
    table, notes = read(tmp_path, "\n".join(lines))
    assert len(table.integers) == N - 3
    assert "data.csv:11: the line has 8 columns instead of 7" in notes[0]
    assert "3 lines of 60 were left out, this is the first" in notes[0]
    lines[30:40] = ["nan"] * 10
    assert "data.csv:11: " in refused(tmp_path, "\n".join(lines))


def write_table(folder: Path, name: str, text: str) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(text)


def test_wheels_corners_tracks_and_poses_by_name(tmp_path):
    write_table(
        tmp_path, "wheel0/rates.csv", "t;right_wheel;left_wheel;load\n" + "".join(f"{t};2;1;9\n" for t in STAMPS)
    )
    folder = FolderRecording(tmp_path)
    read_wheels = wheel_readings(folder, Wheels("wheel0", "wheel0/rates.csv"))
    assert instance(read_wheels, WheelReadings).value.tolist() == [[1.0, 2.0]] * N
    write_table(
        tmp_path, "odom0/twist.csv", "w,v,t\n" + "".join(f"0.5,1.5,{t / 1e9:.9f}\n" for t in 20_000_000 * np.arange(N))
    )
    twist = wheel_readings(folder, Wheels("odom0", "odom0/twist.csv", measures="twist"))
    assert instance(twist, WheelReadings).value.tolist() == [[1.5, 0.5]] * N and twist.stamps_ns[1] == 20_000_000
    write_table(tmp_path, "cam0/tracks.csv", "v,u,id,t\n" + "".join(f"2,1,7,{t}\n" for t in 20 * np.arange(200)))
    camera = Camera("cam0", "cam0/corners.csv", "pinhole-radtan", (64, 48), tracks="cam0/tracks.csv")
    tracks = recorded_tracks(folder, camera)
    assert tracks.uv.tolist() == [[1.0, 2.0]] * 200 and tracks.stamps_ns[1] == 20_000_000
    head = (
        "timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x,b_w_RS_S_x"
    )
    write_table(tmp_path, "mocap0/poses.csv", head + "\n" + "".join(f"{t},1,2,3,1,0,0,0,8,9\n" for t in STAMPS))
    poses = pose_readings(folder, PoseSensor("mocap0", "mocap0/poses.csv"))
    assert poses.position.tolist() == [[1.0, 2.0, 3.0]] * N
    np.testing.assert_array_equal(poses.rotation[0], np.eye(3))
    kinds = {t.name: t.kind for t in folder.topics()}
    assert kinds["mocap0/poses.csv"] == "pose" and kinds["wheel0/rates.csv"] == "wheels"


RIG = """\
sensors:
  imu0: {type: imu, columns: [time, gx, gy, gz, ax, ay, az], time_unit: us}
  cam0: {type: camera, model: eucm, resolution: [64, 48], tracks: t.csv, columns: [t, id, x, y]}
  wheel0: {type: wheels, columns: [t, l, r]}
  mocap0: {type: pose, time_unit: ms}
"""


def test_the_fields_of_the_rig_file(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(RIG)
    rig = load_rig(path)
    assert rig.imu is not None
    assert rig.imu.layout == TableLayout(("time", "gx", "gy", "gz", "ax", "ay", "az"), "us")
    assert rig.cameras[0].layout.columns == ("t", "id", "x", "y") and rig.poses[0].layout == TableLayout((), "ms")
    again = rig_from_dict(rig_to_dict(rig), "again")
    for of in ("cameras", "wheels", "poses"):
        assert [s.layout for s in getattr(again, of)] == [s.layout for s in getattr(rig, of)]
    assert again.imu is not None and again.imu.layout == rig.imu.layout
    for old, new, words in (
        (
            "time_unit: us",
            "time_unit: minutes",
            r":2: sensors\.imu0\.time_unit: there is no .*available are s, ms, us, ns",
        ),
        ("[t, l, r]", "[t, l, l]", r":4: sensors\.wheel0\.columns: must name columns of the table, each once"),
        ("[t, l, r]", "t, l, r", r":4: "),
    ):
        path.write_text(RIG.replace(old, new))
        with pytest.raises(RigError, match=words):
            load_rig(path)


def test_huge_numbers_are_single_bad_readings(tmp_path):
    values = np.tile(VALUES, (10, 1)) * [0.1, 0.1, 0.1, 1, 1, 1]
    values[100, 2], values[200, 4] = 1e300, -1e308
    stamps = [str(ORIGIN + STEP * k) for k in range(len(values))]
    write_table(tmp_path, "imu0/data.csv", rows(stamps=stamps, values=values))
    quaternions = ["0,0,0,1"] * 600
    quaternions[50] = "1e300,0,0,1"
    lines = [f"{t},{0.01 * k},{0.02 * k},0,{q}\n" for k, (t, q) in enumerate(zip(stamps, quaternions, strict=True))]
    write_table(tmp_path, "mocap0/poses.csv", "".join(lines))
    rig = Rig(
        by_name(ImuSensor("imu0", "imu0/data.csv", class_noise("consumer")), PoseSensor("mocap0", "mocap0/poses.csv"))
    )
    found = read_measurements(FolderRecording(tmp_path), rig)
    assert found.imu is not None and len(found.imu.stamps_ns) == 598 and len(found.poses[0].stamps_ns) == 599
    assert np.abs(found.imu.accel).max() < 1e3


SPLIT = {
    "ROS 2": ("header.stamp.sec", "header.stamp.nanosec"),
    "ROS 1": ("field.header.stamp.secs", "field.header.stamp.nsecs"),
    "plain": ("sec", "nanosec"),
    "underscores": ("stamp_sec", "stamp_nsec"),
    "words": ("Seconds", "Nanoseconds"),
    "one word": ("timestamp_secs", "timestamp_nsecs"),
}


def split_rows(name: str, stamps: np.ndarray = STAMPS, before: str = "") -> str:
    """The stamps in two columns, the nanoseconds not first; `before`: a column of each row before these."""
    sec, nsec = SPLIT[name]
    head = ",".join([*(["Time"] if before else []), sec, "frame_id", nsec, *NAMES]) + "\n"
    parts = [divmod(t, 1_000_000_000) for t in stamps.tolist()]
    return head + "".join(
        ",".join([*([before] if before else []), str(s), "imu", str(ns), *map(repr, row)]) + "\n"
        for (s, ns), row in zip(parts, VALUES.tolist(), strict=True)
    )


@each("name", SPLIT)
def test_seconds_and_nanoseconds_in_two_columns(tmp_path, name):
    table, notes = read(tmp_path, split_rows(name))
    check(table)
    assert notes == []
    assert holds(tmp_path / "data.csv", IMU) and named(tmp_path / "data.csv", IMU)


def test_the_stamp_in_two_columns_goes_before_when_it_was_received(tmp_path):
    table, _ = read(tmp_path, split_rows("ROS 1", before="1700000009.5"))
    check(table)


def test_two_columns_of_a_stamp_by_the_rig_file(tmp_path):
    text = split_rows("ROS 2").replace("wx,wy", "first,second")
    layout = TableLayout(columns=("header.stamp.sec", "header.stamp.nanosec", "first", "second", *NAMES[2:]))
    table, _ = read(tmp_path, text, layout)
    check(table)


def test_stamps_before_1970_and_bad_nanoseconds(tmp_path):
    table, _ = read(tmp_path, split_rows("plain", STAMPS - STAMPS[20]))
    check(table, STAMPS - STAMPS[20])
    lines = split_rows("plain").splitlines(keepends=True)
    for k, nsec in ((10, "1000000000"), (20, "-1"), (30, "x")):
        cells = lines[k].split(",")
        lines[k] = ",".join([*cells[:2], nsec, *cells[3:]])
    table, notes = read(tmp_path, "".join(lines))
    np.testing.assert_array_equal(table.integers[:, 0], np.delete(STAMPS, [9, 19, 29]))
    np.testing.assert_array_equal(table.decimals, np.delete(VALUES, [9, 19, 29], axis=0))
    assert "nanoseconds is 'x', which is not a number; the line was left out" in notes[0]
    assert "2 of 59 rows have no stamp" in notes[1] and "and 1000000000 in sec and nanosec" in notes[1]
    wrong = split_rows("plain").replace(",imu,", ",imu,1")
    assert "nanoseconds are from 0 to 999999999; correct the program that writes them" in refused(tmp_path, wrong)


def test_nanoseconds_alone_are_no_stamp_of_two_columns(tmp_path):
    table, _ = read(tmp_path, "nsec," + ",".join(NAMES) + "\n" + rows())
    check(table)


def test_poses_and_wheels_with_stamps_in_two_columns(tmp_path):
    stamps = [f"{s},{ns}" for s, ns in (divmod(t, 10**9) for t in STAMPS.tolist())]
    (tmp_path / "a").mkdir()
    line = "0.1,0.2,0.3,0,0,0,1"
    (tmp_path / "a" / "poses.csv").write_text(
        "sec,nanosec,x,y,z,qx,qy,qz,qw\n" + "".join(f"{s},{line}\n" for s in stamps)
    )
    (tmp_path / "a" / "rates.csv").write_text("secs,nsecs,left,right\n" + "".join(f"{s},1.5,2\n" for s in stamps))
    recording = FolderRecording(tmp_path)
    assert pose_readings(recording, PoseSensor("a", "a/poses.csv")).stamps_ns.tolist() == STAMPS.tolist()
    wheels = wheel_readings(recording, Wheels("a", "a/rates.csv"))
    assert wheels.stamps_ns.tolist() == STAMPS.tolist()
    assert instance(wheels, WheelReadings).value[5].tolist() == [1.5, 2.0]
    assert {t.name: t.first_ns for t in recording.topics()} == {"a/poses.csv": ORIGIN, "a/rates.csv": ORIGIN}
