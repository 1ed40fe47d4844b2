"""Poses in tables, TUM's text and bags: what comes out, and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.data.measurements import PoseStream
from icalib.data.recordings import BagRecording, FolderRecording, open_recording, read_measurements
from icalib.errors import RecordingError
from icalib.rig import PoseSensor
from icalib.rig.file import rig_from_dict, rig_to_dict
from icalib.sensors.pose.read import checked_poses
from icalib.sensors.pose.read import readings as pose_readings
from icalib.sensors.pose.read.transforms import PoseReadings, as_frame_sensor

N, STEP, ORIGIN = 300, 20_000_000, 1_700_000_000_123_456_789
STAMPS = ORIGIN + STEP * np.arange(N)
T = STEP * 1e-9 * np.arange(N)
POSITION = np.stack([np.sin(T), 0.5 * np.cos(0.7 * T), 0.1 * T], axis=1)
TURNS = Rotation.from_rotvec(np.stack([0.3 * np.sin(T), 0.4 * np.cos(2 * T), T], axis=1))
XYZW = TURNS.as_quat()
ABSOLUTE, RELATIVE = PoseSensor("mocap0", "mocap0/poses.csv"), PoseSensor("mocap0", "mocap0/poses.csv", "relative")


def table(folder: Path, stamps=STAMPS, position=POSITION, xyzw=XYZW, header="#t,x,y,z,qx,qy,qz,qw", name="poses.csv"):
    (folder / "mocap0").mkdir(exist_ok=True)
    rows = zip(np.asarray(stamps).tolist(), np.hstack([position, xyzw]).tolist(), strict=True)
    path = folder / "mocap0" / name
    path.write_text(header + "\n" + "".join(f"{t},{','.join(map(repr, row))}\n" for t, row in rows))
    return path


def read(folder: Path, sensor: PoseSensor = ABSOLUTE) -> tuple[PoseStream, tuple[str, ...]]:
    recording = FolderRecording(folder)
    return checked_poses(pose_readings(recording, sensor), sensor, recording.where(sensor))


def refused(folder: Path, sensor: PoseSensor = ABSOLUTE) -> str:
    with pytest.raises(RecordingError) as error:
        read(folder, sensor)
    sentence = str(error.value)
    assert str(folder) in sentence and sentence.endswith(".") and "\n" not in sentence
    return sentence


def test_table(tmp_path):
    path = table(tmp_path)
    stream, notes = read(tmp_path)
    np.testing.assert_array_equal(stream.stamps_ns, STAMPS)
    np.testing.assert_allclose(stream.position, POSITION, rtol=1e-15)
    np.testing.assert_allclose(stream.rotation, TURNS.as_matrix(), atol=1e-14)
    assert notes == ()
    (topic,) = FolderRecording(tmp_path).topics()
    assert (topic.name, topic.kind, topic.count) == ("mocap0/poses.csv", "pose", N)
    assert path.is_file()


def test_table_with_w_first_as_eurocs(tmp_path):
    header = "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
    table(tmp_path, xyzw=XYZW[:, [3, 0, 1, 2]], header=header)
    np.testing.assert_allclose(read(tmp_path)[0].rotation, TURNS.as_matrix(), atol=1e-14)


def test_relative_poses_of_wheels_are_another_table(tmp_path):
    (tmp_path / "wheel0").mkdir()
    row = f"{STAMPS[0]},{STAMPS[1]},0.1,0.2,0.3,1,0,0,1,0,1\n"
    (tmp_path / "wheel0" / "poses.csv").write_text("#from,to,yaw,x,y\n" + row)
    (topic,) = FolderRecording(tmp_path).topics()
    assert topic.kind == "wheels"


def test_tums_text(tmp_path):
    (tmp_path / "mocap0").mkdir()
    seconds = [f"{t // 10**9}.{t % 10**9:09d}" for t in STAMPS.tolist()]
    rows = np.hstack([POSITION, XYZW]).tolist()
    text = "# t x y z qx qy qz qw\n\n" + "".join(
        f"{t} {' '.join(map(repr, r))}\n" for t, r in zip(seconds, rows, strict=True)
    )
    (tmp_path / "mocap0" / "poses.tum").write_text(text)
    sensor = PoseSensor("mocap0", "mocap0/poses.tum")
    stream, _ = read(tmp_path, sensor)
    np.testing.assert_array_equal(stream.stamps_ns, STAMPS)
    np.testing.assert_allclose(stream.rotation, TURNS.as_matrix(), atol=1e-14)
    assert [t.kind for t in FolderRecording(tmp_path).topics()] == ["pose"]
    np.testing.assert_array_equal(FolderRecording(tmp_path).stamps("mocap0/poses.tum"), STAMPS)
    for stamp, ns in (("-1.5", -1_500_000_000), ("1.7e9", 1_700_000_000_000_000_000), ("12", 12_000_000_000)):
        (tmp_path / "mocap0" / "poses.tum").write_text(f"{stamp} 0 0 0 0 0 0 1\n")
        assert pose_readings(FolderRecording(tmp_path), sensor).stamps_ns.tolist() == [ns]


@each("line", ["1.0 2 3 4 0 0 0", "1.0 2 3 4 0 0 0 x", "1.0 2 3 nan 0 0 0 1", "a 2 3 4 0 0 0 1"])
def test_a_bad_line_of_tums_text_is_named(tmp_path, line):
    (tmp_path / "mocap0").mkdir()
    (tmp_path / "mocap0" / "poses.txt").write_text(f"0.5 2 3 4 0 0 0 1\n{line}\n")
    assert "poses.txt:2: " in refused(tmp_path, PoseSensor("mocap0", "mocap0/poses.txt"))


def test_an_empty_text(tmp_path):
    (tmp_path / "mocap0").mkdir()
    (tmp_path / "mocap0" / "poses.txt").write_text("# nothing\n")
    assert "holds no rows" in refused(tmp_path, PoseSensor("mocap0", "mocap0/poses.txt"))


def test_inverted_poses_by_the_rig_file(tmp_path):
    """A table of T_sensor_frame, as of a camera that sees a board which the robot carries."""
    back = TURNS.inv()
    table(tmp_path, position=-back.apply(POSITION), xyzw=back.as_quat())
    sensors = {"mocap0": {"type": "pose", "inverted": True}, "slam0": {"type": "pose", "path": "mocap0/poses.csv"}}
    rig = rig_from_dict({"sensors": sensors}, "rig.yaml")
    inverted, plain = read_measurements(open_recording(tmp_path), rig).poses
    np.testing.assert_allclose(inverted.position, POSITION, atol=1e-14)
    np.testing.assert_allclose(inverted.rotation, TURNS.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(plain.rotation, back.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(plain.position, -back.apply(POSITION), atol=1e-14)
    assert rig_to_dict(rig)["sensors"]["mocap0"]["inverted"] is True


def test_inverted_and_in_other_axes(tmp_path):
    """Axes of the positions are those in the file, before these are inverted."""
    back = TURNS.inv()
    written = -back.apply(POSITION)
    table(tmp_path, position=written[:, [1, 0, 2]] * [-1.0, 1.0, 1.0], xyzw=back.as_quat())
    sensor = PoseSensor("mocap0", "mocap0/poses.csv", inverted=True, position_axes=("y", "-x", "z"))
    found = as_frame_sensor(pose_readings(FolderRecording(tmp_path), sensor), sensor)
    np.testing.assert_allclose(found.position, POSITION, atol=1e-14)
    np.testing.assert_allclose(found.rotation, TURNS.as_matrix(), atol=1e-14)


def test_positions_in_other_axes(tmp_path):
    table(tmp_path, position=POSITION[:, [0, 2, 1]] * [1.0, 1.0, -1.0])
    sensor = PoseSensor("mocap0", "mocap0/poses.csv", position_axes=("x", "-z", "y"))
    written = pose_readings(FolderRecording(tmp_path), sensor)
    np.testing.assert_allclose(as_frame_sensor(written, sensor).position, POSITION, rtol=1e-15)


def test_bad_poses(tmp_path):
    table(tmp_path, xyzw=1.1 * XYZW)
    assert f"the quaternion at {STAMPS[0]} ns has length 1.1, not 1" in refused(tmp_path)
    table(tmp_path, stamps=STAMPS // 1_000_000_000)
    assert "poses share a stamp with a different pose, as if stamps were truncated to whole seconds" in refused(
        tmp_path
    )
    table(tmp_path, position=1000.0 * POSITION)
    assert "position_unit of the rig file (metres without it)" in refused(tmp_path)
    table(tmp_path, position=0.0 * POSITION, xyzw=np.tile([0.0, 0.0, 0.0, 1.0], (N, 1)))
    assert "all poses are the same within 0 m and 0 rad" in refused(tmp_path)
    table(tmp_path, stamps=STAMPS[::-1])
    assert f"the pose at {STAMPS[-2]} ns comes after the one at {STAMPS[-1]} ns" in refused(tmp_path)
    table(tmp_path, STAMPS[:2], POSITION[:2], XYZW[:2])
    assert "only 2 poses" in refused(tmp_path)


def checked(position=POSITION, rotation=None, stamps=STAMPS, sensor=ABSOLUTE):
    rotation = TURNS.as_matrix() if rotation is None else rotation
    return checked_poses(PoseReadings("mocap0", stamps, rotation, position), sensor, "here")


def test_not_finite():
    position = POSITION.copy()
    position[7, 1], position[9] = np.nan, 1e300
    stream, notes = checked(position)
    assert f"2 of {N} poses are not finite or have no unit quaternion and were removed, the first at" in notes[0]
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, [7, 9]))
    position[100:] = np.nan
    with pytest.raises(RecordingError, match=f"poses are not finite or .*, the first at {STAMPS[7]} ns"):
        checked(position)


def test_a_single_quaternion_that_is_none(tmp_path):
    xyzw = XYZW.copy()
    xyzw[20], xyzw[30] = 0.0, 2.0 * xyzw[30]
    table(tmp_path, xyzw=xyzw)
    stream, notes = read(tmp_path)
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, [20, 30]))
    assert f"2 of {N} poses" in notes[0] and f"the first at {STAMPS[20]} ns" in notes[0]


LOST = {
    "zero for 0.4 s": np.arange(100, 120),
    "zero once": np.array([50]),
    "zero at the beginning": np.arange(8),
    "zero at the end": np.arange(N - 8, N),
    "zero here and there": np.array([11, 12, 77, 150, 152, 154, 290]),
}


@each("case", LOST)
@each("sensor", [ABSOLUTE, RELATIVE])
@each("far", [[0.0, 0.0, 0.0], [465_000.0, 5_248_000.0, 413.0]])
def test_lost_poses_are_left_out(case, sensor, far):
    """A tracker that is lost reports the origin, or no position and no rotation at all."""
    lost, rng = LOST[case], np.random.default_rng(0)
    position, rotation = POSITION + [2.0, 1.0, 1.0] + 1e-3 * rng.normal(size=(N, 3)) + far, TURNS.as_matrix()
    position[lost], rotation[lost] = 0.0, np.eye(3)
    stream, notes = checked(position, rotation, sensor=sensor)
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, lost))
    assert (
        f"{len(lost)} of {N} poses are outliers of the trajectory" in notes[-1] or "repeat an earlier one" in notes[0]
    )


def test_lost_poses_that_scatter_behind_a_gap():
    """While it is lost for half a second the tracker leaves poses out, too."""
    rng, lost = np.random.default_rng(1), np.arange(140, 166)
    position = POSITION + 1e-3 * rng.normal(size=(N, 3))
    position[lost] += rng.normal(size=(len(lost), 3))
    there = np.delete(np.arange(N), np.arange(140, 148))
    stream, notes = checked(position[there], TURNS.as_matrix()[there], STAMPS[there])
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, lost))
    assert "the longest gap is 0.54 s" in notes[-1]


def test_bad_poses_between_jumps_that_stay():
    """Of an odometry: it closes loops, and single poses are wrong besides."""
    position = POSITION.copy()
    position[100:] += [0.4, 0.0, 0.0]
    position[200:] += [0.0, 0.4, 0.0]
    position[[50, 150, 250]] += [0.0, 0.0, 0.5]
    stream, notes = checked(position, sensor=RELATIVE)
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, [50, 150, 250]))
    assert f"3 of {N} poses are outliers of the trajectory" in notes[0] and "2 jumps" in notes[-1]
    with pytest.raises(RecordingError, match="and do not return"):
        checked(position)


SMALL = np.array([9, 40, 42, 150, 222, 290])


@each("what", ["3 cm", "3 deg", "50 m"])
def test_single_wrong_poses(what):
    """Far below a jump, with noise of 1 mm and 2 mrad."""
    rng, n = np.random.default_rng(3), len(SMALL)
    position = POSITION + 1e-3 * rng.normal(size=(N, 3))
    rotation = (TURNS * Rotation.from_rotvec(2e-3 * rng.normal(size=(N, 3)))).as_matrix()
    away = rng.normal(size=(n, 3))
    away /= np.linalg.norm(away, axis=1)[:, None]
    if what == "3 deg":
        rotation[SMALL] = rotation[SMALL] @ Rotation.from_rotvec(np.deg2rad(3.0) * away).as_matrix()
    else:
        position[SMALL] += {"3 cm": 0.03, "50 m": 50.0}[what] * away
    stream, notes = checked(position, rotation)
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, SMALL))
    assert f"{n} of {N} poses are outliers of the trajectory" in notes[0] and f"the first at {STAMPS[9]} ns" in notes[0]


@each("noise", [0.0, 1e-3])
@each("every", [1, 5])
def test_starts_and_stops_are_no_wrong_poses(noise, every):
    """An odometry that mostly stands still, and starts and stops within one pose, at 50 and 10 Hz."""
    moving = np.arange(N) % 60 > 45
    s = np.cumsum(0.02 * every * moving)
    position = np.stack([s, 0.2 * s, 0.0 * s], axis=1) + noise * np.random.default_rng(1).normal(size=(N, 3))
    rotation = Rotation.from_rotvec(np.stack([0.0 * s, 0.0 * s, s], axis=1)).as_matrix()
    stream, _ = checked(position, rotation, STAMPS[0] + every * (STAMPS - STAMPS[0]))
    assert len(stream.stamps_ns) == N


@each("copies", [np.arange(100, 120), np.arange(1, N, 4), np.array([33, 150, 151])])
def test_poses_that_are_sent_again(copies):
    """A tracker that freezes, a driver with a faster clock than the tracker, single late copies."""
    source = np.arange(N)
    for k in copies:
        source[k] = source[k - 1]
    stream, notes = checked(POSITION[source], TURNS.as_matrix()[source])
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, copies))
    assert f"{len(copies)} of {N} poses repeat an earlier one exactly during motion" in notes[0]


def test_late_copies():
    """Each hundredth pose is that of three before."""
    late = np.arange(60, N, 100)
    source = np.arange(N)
    source[late] -= 3
    stream, _ = checked(POSITION[source], TURNS.as_matrix()[source])
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, late))


def test_an_odometry_that_stands_still_repeats_itself():
    """It brakes, stands for two seconds without noise, and starts again: nothing is left out."""
    u = np.clip(T, None, 2.0) + np.clip(T - 4.0, 0.0, None)
    s = np.where(T < 2.0, 2.0 * u - 0.5 * u**2, 2.0 + 0.5 * np.clip(u - 2.0, 0.0, None) ** 2)
    position = np.stack([s, 0.0 * s, 0.0 * s], axis=1)
    rotation = Rotation.from_rotvec(np.stack([0.0 * s, 0.0 * s, 0.5 * s], axis=1)).as_matrix()
    assert (np.diff(s) == 0.0).sum() > 90
    stream, notes = checked(position, rotation)
    assert len(stream.stamps_ns) == N and notes == ()


def test_repeated_stamps(tmp_path):
    twice = np.insert(np.arange(N), 10, 9)
    table(tmp_path, STAMPS[twice], POSITION[twice], XYZW[twice])
    stream, notes = read(tmp_path)
    assert len(stream.stamps_ns) == N
    assert f"1 repeated poses were dropped, the first at {STAMPS[9]} ns" in notes[0]
    stamps = STAMPS.copy()
    stamps[10] = stamps[9]
    table(tmp_path, stamps)
    stream, notes = read(tmp_path)
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(STAMPS, [9, 10]))
    assert "2 poses share a stamp with a different pose. Which one is right is unknown" in notes[0]
    stamps[1::15] = stamps[::15]
    table(tmp_path, stamps)
    assert f"42 of {N} poses share a stamp with a different pose, the first {STAMPS[0]} ns" in refused(tmp_path)


def test_one_stamp_of_two_among_few_poses_at_rest(tmp_path):
    stops = np.arange(0, N, 30)
    stamps = ORIGIN + 2_000_000_000 * np.arange(len(stops))
    stamps[4] = stamps[3]
    table(tmp_path, stamps, POSITION[stops], XYZW[stops])
    stream, notes = read(tmp_path)
    np.testing.assert_array_equal(stream.stamps_ns, np.delete(stamps, [3, 4]))
    assert "2 poses share a stamp with a different pose" in notes[0]
    table(tmp_path, stamps[2:6], POSITION[stops[2:6]], XYZW[stops[2:6]])
    assert "2 of 4 poses share a stamp with a different pose" in refused(tmp_path)


def test_a_frame_that_jumps(tmp_path):
    """A loop that is closed: of absolute poses refused, of relative ones noted."""
    position = POSITION.copy()
    position[150:] += [0.3, 0.0, 0.1]
    table(tmp_path, position=position)
    sentence = refused(tmp_path)
    assert f"1 jumps of its poses, the first at {STAMPS[150]} ns, by up to 0.32 m" in sentence
    assert "kind: relative" in sentence
    _, notes = read(tmp_path, RELATIVE)
    assert len(notes) == 1 and "1 jumps" in notes[0]


def test_a_turn_that_jumps_is_one_too(tmp_path):
    xyzw = XYZW.copy()
    xyzw[150:] = (Rotation.from_rotvec([0.0, 0.2, 0.0]) * TURNS[150:]).as_quat()
    table(tmp_path, xyzw=xyzw)
    assert "1 jumps of its poses" in read(tmp_path)[1][0]


def test_poses_that_come_back_are_noted(tmp_path):
    position = POSITION.copy()
    position[150:152] += [0.3, 0.0, 0.1]
    table(tmp_path, position=position)
    _, notes = read(tmp_path)
    assert "2 jumps" in notes[0]


def test_brisk_motion_is_no_jump(tmp_path):
    """5 m/s^2 and 6 rad/s at 50 Hz, with noise."""
    noise = 2e-3 * np.random.default_rng(0).normal(size=(N, 3))
    fast = 0.5 * np.stack([np.sin(3 * T), np.cos(3 * T), np.sin(2 * T)], axis=1) + noise
    turns = Rotation.from_rotvec(np.stack([2.0 * np.sin(3 * T), np.cos(2 * T), np.sin(T)], axis=1))
    table(tmp_path, position=fast, xyzw=turns.as_quat())
    assert read(tmp_path)[1] == ()


@each("kind", ["PoseStamped", "PoseWithCovarianceStamped", "TransformStamped", "Odometry"])
def test_bags(tmp_path, write, kind):
    make = write.maker("ros2")

    def message(k: int):
        header, turn = make.header(int(STAMPS[k]), "map"), make.make("geometry_msgs/msg/Quaternion", *XYZW[k].tolist())
        if kind == "TransformStamped":
            transform = make.make("geometry_msgs/msg/Transform", make.vector(POSITION[k]), turn)
            return make.make("geometry_msgs/msg/TransformStamped", header, "body", transform)
        pose = make.make("geometry_msgs/msg/Pose", make.vector(POSITION[k], "Point"), turn)
        if kind == "PoseStamped":
            return make.make("geometry_msgs/msg/PoseStamped", header, pose)
        wide = make.make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36))
        if kind == "PoseWithCovarianceStamped":
            return make.make("geometry_msgs/msg/PoseWithCovarianceStamped", header, wide)
        twist = make.make("geometry_msgs/msg/Twist", make.vector([0.0] * 3), make.vector([0.0] * 3))
        speed = make.make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
        return make.make("nav_msgs/msg/Odometry", header, "body", wide, speed)

    name = f"{'nav' if kind == 'Odometry' else 'geometry'}_msgs/msg/{kind}"
    path = write.ros2(tmp_path / "run", [("/vrpn/robot", name, int(t) + 5, message(k)) for k, t in enumerate(STAMPS)])
    recording, sensor = BagRecording(path), PoseSensor("mocap0", "mocap0/poses.csv")
    stream, _ = checked_poses(pose_readings(recording, sensor), sensor, recording.where(sensor))
    np.testing.assert_array_equal(stream.stamps_ns, STAMPS)
    np.testing.assert_array_equal(stream.position, POSITION)
    np.testing.assert_allclose(stream.rotation, TURNS.as_matrix(), atol=1e-14)
    assert recording.where(sensor) == f"{path} /vrpn/robot"


def test_a_table_beside_a_bag(tmp_path, write):
    """Another program's odometry, made from the bag: the table goes before topics."""
    make = write.maker("ros2")
    imu = [("/imu", "sensor_msgs/msg/Imu", int(t), make.imu(int(t), np.zeros(3), np.zeros(3))) for t in STAMPS[:3]]
    recording, path = BagRecording(write.ros2(tmp_path / "run", imu)), table(tmp_path)
    np.testing.assert_allclose(pose_readings(recording, ABSOLUTE).position, POSITION, rtol=1e-15)
    assert recording.where(ABSOLUTE) == str(path) and path in recording.files()
    path.unlink()
    with pytest.raises(RecordingError, match="has no pose for mocap0"):
        pose_readings(recording, ABSOLUTE)
