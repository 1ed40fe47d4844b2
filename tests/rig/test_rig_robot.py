"""LiDARs and wheels in rig files."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from tests.cases import each
from tests.typed import not_none

from icalib.errors import RigError
from icalib.rig import Ground, Lidar, Parameter, PoseSensor, Rig, Wheels
from icalib.rig.file import load_rig, rig_to_dict

ROBOT = """\
sensors:
  imu0: {type: imu}
  lidar0:
    type: lidar
    range_noise: 0.02
    translation: {guess: [0.1, 0, 0.3]}
    time_offset: {fixed: 0.01}
    min_range: 1
    max_range: 60
    point_time: azimuth
    topic: /lidar/points
  lidar1: {type: lidar, path: top/scans.npz}
  wheel0:
    type: wheels
    drive: differential
    rotation: {prior: {rpy_deg: [0, 0, 90]}, sigma_deg: 2}
    radii: {prior: [0.1, 0.11], sigma: 0.01}
    baseline: {guess: 0.4}
    wheel_noise: 0.01
    lateral_slip: 0.002
    vertical_slip: 0.003
    factor: relative-poses
    measures: ticks
    counts_per_turn: 4096.5
    counter_size: 65536
    topic: /joints
    joints: [l, r]
  wheel1: {type: wheels, sampling: instantaneous}
  wheel2: {type: wheels, measures: poses}
  mocap0:
    type: pose
    topic: /vrpn/robot
    rotation_noise: 0.002
    position_noise: 0.001
    time_offset: {prior: 0.1, sigma: 0.01}
  odom0: {type: pose, kind: relative, path: other/trajectory.tum}
"""


def load(tmp_path: Path, text: str) -> Rig:
    path = tmp_path / "rig.yaml"
    path.write_text(text, encoding="utf-8")
    return load_rig(path)


def complaint(tmp_path: Path, text: str) -> str:
    with pytest.raises(RigError) as error:
        load(tmp_path, text)
    sentence = str(error.value)
    assert sentence.startswith(str(tmp_path)) and sentence.endswith(".") and "\n" not in sentence
    return sentence.removeprefix(f"{tmp_path}/")


def test_the_field_and_the_unit_of_point_times(tmp_path):
    timed = ROBOT.replace("point_time: azimuth", "point_time_field: laser_usec\n    point_time_unit: us")
    rig = load(tmp_path, timed)
    assert (rig.lidars[0].point_time_field, rig.lidars[0].point_time_unit) == ("laser_usec", "us")
    again = load(tmp_path, yaml.safe_dump(rig_to_dict(rig), sort_keys=False))
    assert again.lidars[0].point_time_field == "laser_usec" and again.lidars[0].point_time_unit == "us"
    both = complaint(tmp_path, timed.replace("point_time_unit: us", "point_time: snapshot"))
    assert "lidar0.point_time_field: point_time: snapshot uses no point times; remove point_time_field" in both
    unit = complaint(tmp_path, timed.replace("point_time_unit: us", "point_time_unit: min"))
    assert "sensors.lidar0.point_time_unit: there is no such choice as 'min'; available are s, ms, us, ns" in unit


def test_lidars_and_wheels_are_read(tmp_path):
    rig = load(tmp_path, ROBOT)
    a, b = rig.lidars
    assert (a.name, a.path, a.range_noise_m, a.min_range_m, a.max_range_m) == (
        "lidar0",
        "lidar0/scans.npz",
        0.02,
        1.0,
        60.0,
    )
    assert (a.point_time, a.topic, a.time_offset.mode) == ("azimuth", "/lidar/points", "fixed")
    assert a.rotation == Parameter() and np.array_equal(not_none(a.translation.value), [0.1, 0, 0.3])
    assert b == Lidar("lidar1", "top/scans.npz") and (rig.cameras, rig.reference) == ((), "imu0")
    ticks, rates, poses = rig.wheels
    assert (ticks.measures, ticks.counts_per_turn, ticks.counter_size) == ("ticks", 4096.5, 65536)
    assert (ticks.path, ticks.topic, ticks.joints) == ("wheel0/ticks.csv", "/joints", ("l", "r"))
    assert (ticks.wheel_noise, ticks.lateral_slip, ticks.vertical_slip) == (0.01, 0.002, 0.003)
    assert ticks.factor == "relative-poses" and np.array_equal(not_none(ticks.radii.value), [0.1, 0.11])
    assert ticks.rotation.mode == "prior" and np.allclose(not_none(ticks.rotation.value) @ [1, 0, 0], [0, 1, 0])
    assert ticks.baseline.mode == "free" and np.array_equal(not_none(ticks.baseline.value), [0.4])
    assert rates == Wheels("wheel1", "wheel1/rates.csv", sampling="instantaneous")
    assert poses == Wheels("wheel2", "wheel2/poses.csv", measures="poses", factor="relative-poses")


SIGNED = """\
sensors:
  mocap0: {type: pose}
  a: {type: wheels, measures: angles, angle_range: 6.283185, signs: [1, -1]}
  b: {type: wheels, rate_unit: rpm, drive: skid-steer, signs: [1, -1, 1, -1]}
"""


def test_signs_units_and_ranges(tmp_path):
    a, b = load(tmp_path, SIGNED).wheels
    assert (a.angle_range, a.signs, a.rate_unit) == (6.283185, (1, -1), "rad/s")
    assert (b.angle_range, b.signs, b.rate_unit) == (None, (1, -1, 1, -1), "rpm")
    again = load(tmp_path, yaml.safe_dump(rig_to_dict(load(tmp_path, SIGNED)), sort_keys=False))
    assert again.wheels == (a, b)
    for old, new, words in (
        ("6.283185", "0", "a.angle_range: must be above 0"),
        ("measures: angles, ", "", "a.angle_range: belongs to wheels that measure angles, not rates"),
        ("rpm", "rpm, measures: angles", "b.rate_unit: belongs to wheels that measure rates, not angles"),
        ("rpm", "turns", "b.rate_unit: .* rad/s, deg/s, rpm"),
        ("[1, -1]}", "[1, 2]}", "a.signs: must be 1 or -1 for each of two joints"),
        ("[1, -1, 1, -1]", "[1, -1]", "b.signs: must be 1 or -1 for each of four joints"),
    ):
        assert re.search(words, complaint(tmp_path, SIGNED.replace(old, new))), words


def test_pose_sensors_are_read(tmp_path):
    mocap, odom = load(tmp_path, ROBOT).poses
    assert (mocap.name, mocap.path, mocap.kind, mocap.topic) == (
        "mocap0",
        "mocap0/poses.csv",
        "absolute",
        "/vrpn/robot",
    )
    assert (mocap.rotation_noise, mocap.position_noise) == (0.002, 0.001)
    assert (mocap.time_offset.mode, mocap.rotation) == ("prior", Parameter())
    assert odom == PoseSensor("odom0", "other/trajectory.tum", "relative")
    (tilted,) = load(tmp_path, "sensors:\n  imu0: {type: imu}\n  m: {type: pose, level: false}\n").poses
    assert mocap.level and not tilted.level
    turned = "sensors:\n  imu0: {type: imu}\n  m: {type: pose, position_axes: [x, -z, y]}\n"
    rig = load(tmp_path, turned)
    assert rig.poses[0].position_axes == ("x", "-z", "y")
    assert load(tmp_path, yaml.safe_dump(rig_to_dict(rig))).poses == rig.poses
    assert "m.position_axes: must name the columns" in complaint(tmp_path, turned.replace("-z", "x"))


def test_frames_of_a_pose_sensor(tmp_path):
    lines = "sensors:\n  imu0: {type: imu}\n  arm: {type: pose, topic: /tf, frames: [base, /tool0]}\n"
    rig = load(tmp_path, lines)
    assert (rig.poses[0].topic, rig.poses[0].frames) == ("/tf", ("base", "/tool0"))
    assert load(tmp_path, yaml.safe_dump(rig_to_dict(rig))).poses == rig.poses
    for wrong in ("[base]", "[base, /base]", "[a, b, c]"):
        said = complaint(tmp_path, lines.replace("[base, /tool0]", wrong))
        assert "arm.frames: must name two frames, the parent and the child" in said


def test_an_imu_and_a_pose_sensor_are_enough(tmp_path):
    rig = load(tmp_path, "sensors:\n  imu0: {type: imu}\n  mocap0: {type: pose}\n")
    assert (rig.cameras, rig.lidars, [p.name for p in rig.poses]) == ((), (), ["mocap0"])


def test_without_an_imu_a_pose_sensor_shows_the_motion(tmp_path):
    mocap, wheels = "sensors:\n  mocap0: {type: pose}\n", "  wheel0: {type: wheels}\n"
    assert load(tmp_path, mocap + wheels).reference == "mocap0"
    assert load(tmp_path, mocap + "  slam0: {type: pose, kind: relative}\n").imu is None
    assert "sensors.mocap0: is the only sensor; add the sensors to calibrate" in complaint(tmp_path, mocap)
    relative = mocap.replace("pose}", "pose, kind: relative}")
    assert "sensors.mocap0: without an IMU, a LiDAR, or a camera" in complaint(tmp_path, relative + wheels)


def test_clocks_that_restart(tmp_path):
    """Of any sensor, as far as there is another clock to go by."""
    lines = "sensors:\n  imu0: {type: imu}\n  lidar0: {type: lidar, clock_restarts: true}\n"
    lines += "  wheel0: {type: wheels, clock_restarts: true, time_offset: {guess: 0.1}}\n"
    lines += "  mocap0: {type: pose, clock_restarts: false}\n"
    rig = load(tmp_path, lines)
    assert [s.clock_restarts for s in (*rig.lidars, *rig.wheels, *rig.poses)] == [True, True, False]
    again = load(tmp_path, yaml.safe_dump(rig_to_dict(rig), sort_keys=False))
    assert [s.clock_restarts for s in (*again.lidars, *again.wheels, *again.poses)] == [True, True, False]
    fixed = complaint(tmp_path, lines.replace("{guess: 0.1}", "{fixed: 0.1}"))
    assert "wheel0.clock_restarts: each recording has its own time offset, but time_offset is fixed" in fixed
    first = "sensors:\n  mocap0: {type: pose, clock_restarts: true}\n  wheel0: {type: wheels}\n"
    assert "mocap0.clock_restarts: without an IMU the clock of mocap0" in complaint(tmp_path, first)
    camera = "cam0: {type: camera, model: pinhole-radtan, resolution: [752, 480], clock_restarts: true}"
    target = "target: {type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}\n"
    said = complaint(tmp_path, f"sensors:\n  {camera}\n{target}")
    assert "cam0.clock_restarts: cameras alone have no time offsets" in said


def test_plain_lidars_and_wheels_load_back(tmp_path):
    plain = rig_to_dict(load(tmp_path, ROBOT))
    again = load(tmp_path, yaml.safe_dump(plain, sort_keys=False))
    assert rig_to_dict(again) == plain
    first = load(tmp_path, ROBOT)
    for a, b in zip(
        (*again.lidars, *again.wheels, *again.poses), (*first.lidars, *first.wheels, *first.poses), strict=True
    ):
        for one in dataclasses.fields(a):
            p, q = getattr(a, one.name), getattr(b, one.name)
            assert repr(p) == repr(q), one.name


@each(
    ("old", "new", "words"),
    [
        ("range_noise: 0.02", "range_noise: 0", "rig.yaml:5: sensors.lidar0.range_noise: must be above 0"),
        ("min_range: 1", "near: 1", "lidar0.near: this field is now called min_range; rename it."),
        ("max_range: 60", "far: 60", "lidar0.far: this field is now called max_range; rename it."),
        ("drive: differential", "sideways_slip: 0.1", "wheel0.sideways_slip: this field is now called lateral_slip"),
        ("drive: differential", "meaning: mean", "called sampling; rename it, and write interval-mean for mean"),
        ("min_range: 1", "min_range: 70", "lidar0.min_range: the range from 70 to 60 m is empty; min_range must be"),
        (
            "azimuth",
            "guess",
            "sensors.lidar0.point_time: there is no such choice as 'guess'; available are auto, start",
        ),
        ("    min_range: 1", "    min_rnage: 1", "lidar0.min_rnage: there is no such field, did you mean 'min_range'"),
        ("drive: differential", "drive: tracks", "wheel0.drive: there is no such choice as 'tracks'"),
        ("drive: differential", "drive: mecanum", "wheel0.drive: icalib has no model of mecanum and omni wheels; give"),
        ("drive: differential", "drive: ackermann", "radii: belongs to wheels with a left and a right side"),
        (
            "drive: differential",
            "drive: skid-steer",
            "joints: must be the names of four joints, [front left",
        ),
        ("drive: differential", "steering_noise: 0.1", "steering_noise: belongs to wheels with drive: ackermann"),
        ("[0.1, 0.11]", "[0.1, -0.11]", "sensors.wheel0.radii: is in metres and must be above 0"),
        ("[0.1, 0.11]", "[0.1]", "sensors.wheel0.radii.prior: must be a list of 2 numbers"),
        ("{guess: 0.4}", "{guess: 0}", "sensors.wheel0.baseline: is in metres and must be above 0"),
        ("wheel_noise: 0.01", "wheel_noise: -1", "sensors.wheel0.wheel_noise: must be above 0"),
        (
            "    counts_per_turn: 4096.5\n",
            "",
            "rig.yaml:14: sensors.wheel0: counts_per_turn is missing; add the number of ticks",
        ),
        ("measures: ticks", "measures: angles", "wheel0.counts_per_turn: belongs to wheels that measure ticks, not an"),
        (
            "measures: ticks",
            "sampling: interval-mean\n    measures: ticks",
            "wheel0.sampling: belongs to wheels that measure rat",
        ),
        ("65536", "1.5", "sensors.wheel0.counter_size: must be a whole number of at least 2"),
        ("[l, r]", "[l]", "sensors.wheel0.joints: must be the names of two joints, [left, right]"),
        ("[l, r]", "[l, l]", "sensors.wheel0.joints: must be the names of two joints, [left, right]"),
        (
            "measures: poses",
            "measures: poses, factor: increments",
            "sensors.wheel2.factor: relative poses have no increments",
        ),
        (
            "kind: relative",
            "kind: drifting",
            "odom0.kind: there is no such choice as 'drifting'; available are absolute",
        ),
        ("position_noise: 0.001", "position_noise: 0", "sensors.mocap0.position_noise: must be above 0"),
        (
            "position_noise: 0.001",
            "position_nose: 1",
            "mocap0.position_nose: there is no such field, did you mean 'pos",
        ),
    ],
)
def test_what_is_wrong_with_lidars_and_wheels_is_named(tmp_path, old, new, words):
    assert ROBOT.count(old) == 1
    assert words in complaint(tmp_path, ROBOT.replace(old, new))


KINDS = """\
sensors:
  imu0: {type: imu}
  lidar0: {type: lidar}
  twist0:
    type: wheels
    measures: twist
    sampling: instantaneous
    scales: {prior: [1, 1], sigma: 0.1}
    speed_noise: 0.01
    yaw_noise: 0.02
    ground: {plane: floor, tilt_noise: 0.01}
  car0:
    type: wheels
    drive: ackermann
    measures: ticks
    counts_per_turn: 100
    radius: {guess: 0.3}
    wheelbase: {fixed: 2.5}
    steering_offset: {prior: -0.01, sigma: 0.02}
    steering_noise: 0.002
    joints: [wheel, steer]
    ground: {plane: floor, height: 0.3, height_sigma: 0.01, bump_noise: 0.005}
  skid0: {type: wheels, drive: skid-steer, joints: [a, b, c, d]}
"""


def test_kinds_of_wheels_are_read_and_load_back(tmp_path):
    twist, car, skid = load(tmp_path, KINDS).wheels
    assert [w.kind for w in (twist, car, skid)] == ["twist", "steered", "pair"]
    assert (twist.path, twist.sampling, twist.speed_noise, twist.yaw_noise) == (
        "twist0/twist.csv",
        "instantaneous",
        0.01,
        0.02,
    )
    assert twist.scales.mode == "prior" and twist.ground == Ground("floor", 0.01) and not twist.knows_height
    assert (car.steering_noise, car.joints, car.wheelbase.mode) == (0.002, ("wheel", "steer"), "fixed")
    assert car.steering_offset.value == [-0.01] and car.radius.value == [0.3]
    assert car.ground == Ground("floor", None, 0.3, 0.01, 0.005) and car.ground_height.value == [0.3]
    assert (skid.drive, skid.joints, skid.ground) == ("skid-steer", ("a", "b", "c", "d"), None)
    plain = rig_to_dict(load(tmp_path, KINDS))
    again = load(tmp_path, yaml.safe_dump(plain, sort_keys=False))
    assert rig_to_dict(again) == plain
    for a, b in zip(again.wheels, (twist, car, skid), strict=True):
        assert all(repr(getattr(a, f.name)) == repr(getattr(b, f.name)) for f in dataclasses.fields(a))


@each(
    ("old", "new", "words"),
    [
        (
            "sampling: instantaneous",
            "joints: [a, b]",
            "twist0.joints: belongs to wheels that measure rates or angles or ticks",
        ),
        (
            "sampling: instantaneous",
            "drive: skid-steer",
            "twist0.drive: goes with wheels that measure rates or angles or tic",
        ),
        (
            "sampling: instantaneous",
            "factor: relative-poses",
            "factor: relative-poses (the paper's factor) needs a left and a right",
        ),
        (
            "sampling: instantaneous",
            "wheel_noise: 0.1",
            "wheel_noise: belongs to wheels with a left and a right side or driv",
        ),
        ("scales: {prior: [1, 1]", "scales: {prior: [1, -1]", "twist0.scales: are factors and must be above 0"),
        ("{guess: 0.3}", "{guess: -0.3}", "car0.radius: is in metres and must be above 0"),
        (
            "[wheel, steer]",
            "[wheel, left, right]",
            "joints: must be the names of two joints, [driven wheel, steering],",
        ),
        ("[a, b, c, d]", "[a, b]", "skid0.joints: must be the names of four joints, [front left, rear left, front rig"),
        (", tilt_noise: 0.01}", "}", "twist0.ground: has no effect; add tilt_noise (rad), or height and"),
        ("height_sigma: 0.01, ", "", "car0.ground: has no effect"),
        (", tilt_noise: 0.01}", ", tilt_noise: 0.01, height: 1}", "ground.height: needs height_sigma"),
        ("plane: floor, tilt", "plane: ceiling, tilt", "ground.plane: there is no such choice as 'ceiling'; available"),
        ("tilt_noise: 0.01", "tilt_noise: 0", "ground.tilt_noise: must be above 0"),
        ("  lidar0: {type: lidar}\n", "  mocap0: {type: pose}\n", "ground.plane: a LiDAR determines the floor, and"),
        (
            "plane: floor, height",
            "plane: level, height",
            "ground.height_sigma: the height is relative to the target, an",
        ),
    ],
)
def test_what_is_wrong_with_kinds_of_wheels_is_named(tmp_path, old, new, words):
    assert KINDS.count(old) == 1
    assert words in complaint(tmp_path, KINDS.replace(old, new))


def test_examples_of_the_page_are_right(tmp_path):
    page = (Path(__file__).parents[2] / "docs/rig-file.md").read_text(encoding="utf-8")
    no_imu, *blocks = [block.split("```")[0] for block in page.split("```yaml\nsensors:\n")[2:]]
    assert load(tmp_path, "sensors:\n" + no_imu).reference == "mocap"
    rig = load(tmp_path, "sensors:\n  imu0: {type: imu}\n" + "".join(blocks))
    assert ([s.name for s in rig.lidars], [w.name for w in rig.wheels]) == (["lidar0"], ["wheel0"])
    assert [s.name for s in rig.poses] == ["mocap0"]
    rows = [line for line in page.splitlines() if line.startswith("| `")]
    for field in (f for kind in (Lidar, Wheels, PoseSensor) for f in dataclasses.fields(kind)):
        if isinstance(field.default, (str, float)):
            name = field.name.removesuffix("_m")
            found = [row.split("|")[2] for row in rows if f"`{name}`" in row.split("|")[1]]
            shown = field.default if isinstance(field.default, str) else f"{field.default:g}"
            assert any(shown in default for default in found), name


def test_points_on_planes_need_a_lidar_and_tracks(tmp_path):
    followed = "  cam0: {type: camera, model: pinhole-radtan, resolution: [640, 480], tracks: cam0.csv}\n"
    wanted = "settings: {points_on_planes_m: 0.01}\n"
    imu, lidar = "sensors:\n  imu0: {type: imu}\n", "  lidar0: {type: lidar}\n"
    assert load(tmp_path, imu + lidar + followed + wanted).settings.points_on_planes_m == 0.01
    for text in (imu + lidar + wanted, imu + followed + wanted):
        words = complaint(tmp_path, text)
        assert "settings.points_on_planes_m: needs a LiDAR that sees planes, and a camera with feature tracks" in words
    assert "must be 0 or above" in complaint(tmp_path, imu + lidar + followed + wanted.replace("0.01", "-1"))
