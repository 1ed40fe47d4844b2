"""Scenario files: those that are shipped, every field, and sentences for bad ones."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each
from tests.typed import not_none

from icalib.errors import RigError
from icalib.geometry.targets import AprilGrid
from icalib.sensors.lidar.simulate import SimLidar
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import Drive, Features, ImageFaults, Texture, load_scenario, simulate

PAPER = Path(__file__).parents[3] / "examples" / "paper"
POSE = "[[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]"
FULL = f"""\
duration: 3
seed: 7
start_ns: 5000000000
motion: {{kind: planar, sideslip_deg: 0.5, seed: 4}}
sensors:
  imu0:
    type: imu
    rate: 200
    noise: {{gyro: 1e-4, gyro_walk: 2e-5, accel: 3e-3, accel_walk: 4e-4}}
    gyro_bias: [0.01, 0.02, 0.03]
    accel_bias: [0.1, 0.2, 0.3]
  left:
    type: camera
    rate: 20
    phase: 0.01
    time_offset: 0.002
    model: eucm
    resolution: [640, 480]
    intrinsics: [300, 301, 320, 240]
    distortion: [0.6, 1.1]
    noise_px: 0.5
    dropouts: [[0.4, 0.5], [2, 2.1]]
    shutter: {{rolling: columns, readout: 0.012}}
    T_imu_sensor: {POSE}
  top:
    type: lidar
    rate: 10
    rings: 4
    azimuth_steps: 100
    elevation_deg: [-20, 10]
    range: [1, 30]
    noise: 0.02
    time_offset: -0.01
    T_imu_sensor: {POSE}
  axle:
    type: wheels
    rate: 50
    radii: [0.1, 0.11]
    baseline: 0.5
    noise: 0.01
    slip: 0.002
    allowed_slip: 0.003
    reports: rates
    sampling: instantaneous
    poses_every: 5
    T_imu_sensor: {POSE}
  mocap:
    type: pose
    kind: relative
    rate: 30
    T_world_frame: {POSE}
    rotation_noise: 0.003
    position_noise: 0.004
    T_imu_sensor: {POSE}
room:
  size: [8, 7, 3]
  blocks:
    - {{center: [3, 2], size: [1, 1.5, 0.5], yaw_deg: 30, ramp: true}}
    - {{center: [-3, 2], size: [0.5, 0.5, 1]}}
  texture: {{seed: 2, share: 0.3, contrast: 0.8}}
images: {{people: 2, gain_steps: [[1, 0.5], [2, 1.5]], frozen: [[1.2, 1.4]], robot_part: 0.1, dirt: 3}}
features: {{count: 300, persistent: 20, longest_track: 2, per_image: 30, range: 9, seed: 3}}
target:
  type: aprilgrid
  rows: 3
  cols: 4
  tag_size: 0.1
  tag_spacing: 0.3
  squares: false
  T_world_board: {POSE}
"""


def loaded(tmp_path, text):
    (tmp_path / "scenario.yaml").write_text(text)
    return load_scenario(tmp_path / "scenario.yaml")


def test_every_field_arrives(tmp_path):
    s = loaded(tmp_path, FULL)
    assert (s.duration_s, s.seed, s.imu_clock_origin_ns, s.imu_rate_hz) == (3.0, 7, 5_000_000_000, 200.0)
    assert s.motion == Drive("planar", sideslip_deg=0.5, seed=4)
    n = s.imu_noise
    assert (n.gyro, n.gyro_walk, n.accel, n.accel_walk) == (1e-4, 2e-5, 3e-3, 4e-4)
    assert s.gyro_bias == (0.01, 0.02, 0.03) and s.accel_bias == (0.1, 0.2, 0.3)
    T = np.array([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]])
    (camera,), (lidar,), (wheels,) = s.cameras, s.of(SimLidar), s.of(SimWheels)
    for sensor, rate, offset, phase, pose in (
        (camera, 20.0, 0.002, 0.01, camera.T_imu_sensor),
        (lidar, 10.0, -0.01, 0.0, lidar.T_imu_sensor),
        (wheels, 50.0, 0.0, 0.0, wheels.T_imu_sensor),
    ):
        assert (sensor.rate_hz, sensor.time_offset_s, sensor.phase_s) == (rate, offset, phase)
        assert sensor.clock_origin_ns == 5_000_000_000
        np.testing.assert_allclose(pose, T, atol=1e-12)
    assert (camera.name, camera.model, camera.resolution, camera.corner_noise_px) == ("left", "eucm", (640, 480), 0.5)
    assert camera.intrinsics == (300.0, 301.0, 320.0, 240.0) and camera.distortion == (0.6, 1.1)
    assert (lidar.rings, lidar.azimuth_steps, lidar.elevation_deg) == (4, 100, (-20.0, 10.0))
    assert (lidar.range_m, lidar.range_noise_m) == ((1.0, 30.0), 0.02)
    assert (wheels.radii, wheels.baseline, wheels.noise) == ((0.1, 0.11), 0.5, 0.01)
    assert (wheels.slip, wheels.allowed_slip) == (0.002, 0.003)
    assert (wheels.reports, wheels.sampling, wheels.poses_every) == ("rates", "instantaneous", 5)
    (mocap,) = s.of(SimPoses)
    assert (mocap.name, mocap.kind, mocap.rate_hz) == ("mocap", "relative", 30.0)
    assert (mocap.rotation_noise, mocap.position_noise) == (0.003, 0.004)
    np.testing.assert_allclose([mocap.T_imu_sensor, mocap.T_world_frame], [T, T], atol=1e-12)
    ramp, box = not_none(s.room).blocks
    assert not_none(s.room).size == (8.0, 7.0, 3.0) and not_none(s.room).hills is None
    assert (ramp.center, ramp.size, ramp.ramp) == ((3.0, 2.0), (1.0, 1.5, 0.5), True)
    assert ramp.yaw_rad == pytest.approx(np.pi / 6) and (box.yaw_rad, box.ramp) == (0.0, False)
    assert not_none(s.room).texture == Texture(2, 0.3, 0.8) and camera.dropouts == ((0.4, 0.5), (2.0, 2.1))
    assert (camera.rolling, camera.readout_s) == ("columns", 0.012)
    assert s.image_faults == ImageFaults(2, ((1.0, 0.5), (2.0, 1.5)), ((1.2, 1.4),), 0.1, 3)
    assert s.features == Features(300, 20, 2.0, 30, 9.0, 3)
    assert s.board and s.target == AprilGrid(3, 4, 0.1, 0.3, squares=False)
    np.testing.assert_allclose(s.T_world_board, T, atol=1e-12)


@each("path", sorted(PAPER.glob("*.yaml")))
def test_shipped_scenarios_load_and_run(path):
    scenario = load_scenario(path)
    lidars = tuple(replace(s, azimuth_steps=36) for s in scenario.of(SimLidar))
    measured = simulate(replace(scenario.with_sensors(*lidars), duration_s=1.5), scenario.seed).measurements
    assert [len(group) for group in (measured.tracks, measured.lidars, measured.wheels)] == [3, 1, 1]
    assert measured.cameras == () and all(len(s.uv) > 100 for s in measured.tracks)
    assert len(not_none(measured.imu).stamps_ns) == 451 and len(measured.lidars[0].stamps_ns) == 11


def test_table_2_is_that_of_the_paper():
    s = load_scenario(PAPER / "table2-3d.yaml")
    assert s.imu_rate_hz == 300 and not_none(s.features).per_image == 100
    assert [c.rate_hz for c in s.cameras] == [20, 10, 10]
    assert [c.time_offset_s for c in s.cameras] == [0.010, -0.010, 0.0]
    assert [c.corner_noise_px for c in s.cameras] == [1.0, 1.0, 1.0]
    (lidar,), (wheels,) = s.of(SimLidar), s.of(SimWheels)
    assert (lidar.rate_hz, lidar.rings, lidar.time_offset_s, lidar.range_noise_m) == (8, 16, -0.010, 0.03)
    assert (wheels.rate_hz, wheels.time_offset_s, wheels.noise) == (70, 0.0, 0.03)


BAD = {
    "duration: 3": [
        ("duration: -3", ":1: duration: must be above 0"),
        ("duratoin: 3", "duratoin: there is no such field, did you mean 'duration'"),
        ("seed_: 3", "there is no such field"),
    ],
    "kind: planar": [
        ("kind: plannar", ":4: motion.kind: there is no motion 'plannar', did you mean 'planar'"),
        ("kind: free", "axle cannot roll"),
        ("kind: recorded", ":4: motion: a recorded motion needs a path"),
        ("kind: ramps", "needs hills; give the room a slope"),
        ("axis_imu: [0, 0, 0], kind: single-axis", "motion.axis_imu: must not be zero"),
    ],
    "sideslip_deg: 0.5": [("sideslip_deg: -1", "motion.sideslip_deg: must be at least 0, but is -1")],
    "  imu0:": [("  imu1:", "sensors.imu1: T_imu_sensor is missing")],
    "type: imu": [
        ("type: immu", "sensors.imu0.type: there is no sensor type 'immu', did you mean 'imu'"),
        ("kind: imu", "sensors.imu0: type is missing; add type: imu or type: camera"),
    ],
    "rate: 200": [("rate: 0", "sensors.imu0.rate: must be above 0")],
    "distortion: [0.6, 1.1]": [("distortion: [0.6]", "left.distortion: must be a list of 2 numbers, but has 1")],
    "resolution: [640, 480]": [("resolution: [640]", "must be \\[width, height\\] in pixels, but has 1")],
    "noise_px: 0.5": [("noise_px: -0.5", "noise_px: must be at least 0")],
    "elevation_deg: [-20, 10]": [("elevation_deg: [20, 10]", "must be \\[lowest, highest\\], but is \\[20, 10\\]")],
    "radii: [0.1, 0.11]": [
        ("radii: [0.1]", "must be \\[left, right\\] in metres"),
        ("radii: [0.1, 0]", "radii\\[1\\]: must be above 0"),
    ],
    "start_ns: 5000000000": [
        ("start_ns: 9223372036854775807", "start_ns: the last stamp would exceed 2\\^63 ns"),
        ("start_ns: 9999999999999999999", "start_ns: must be a whole number below 2\\^63"),
    ],
    " slip: 0.002": [(" slip: -0.002", "axle.slip: must be at least 0")],
    "allowed_slip: 0.003": [("allowed_slip: 0", "axle.allowed_slip: must be above 0")],
    "sampling: instantaneous": [
        ("sampling: average", "axle.sampling: there is no sampling 'average'; available are interval-mean"),
        ("meaning: instant", "axle.meaning: this field is now called sampling"),
    ],
    "size: [8, 7, 3]": [
        ("size: [8, 7]", "room.size: must be a list of 3 numbers"),
        ("size: [2, 2, 3]", "room: block 0 does not fit into the room"),
        ("size: [8, 7, 3]\n  slope_deg: 10", "the motion planar needs a flat floor"),
        ("size: [8, 7, 3]\n  slope_deg: 60", "room.slope_deg: must be at most 45 degrees, but is 60"),
    ],
    "share: 0.3": [("share: 1.3", "room.texture.share: must be at most 1, but is 1.3")],
    "[1, 0.5]": [("[1, 0]", "images.gain_steps: each entry is \\[instant, gain\\], with a gain above 0")],
    "persistent: 20": [("persistent: 400", "features: 400 persistent points are more than all 300")],
    "  type: aprilgrid": [
        ("  type: aprilgird", "target.type: there is no target type 'aprilgird', did you mean 'aprilgrid'"),
        ("  rows_: 3", "target: type is missing"),
    ],
    "  rows: 3": [("", "target: rows is missing"), ("  rows: 0.5", "target.rows: must be a whole number")],
    "[[0, -1, 0, 0.1]": [
        ("[[0, -2, 0, 0.1]", "T_imu_sensor: is not a pose: its first three columns must be a rotation"),
        ("[[0, 1, 0, 0.1]", "is not a pose"),
        ("[[0, -1, 0]", "T_imu_sensor\\[0\\]: must be a list of 4 numbers, but has 3"),
        ("[[0, -1, 0, 0.1], [0, 0, 0, 0]", "must be 4 rows of 4 numbers, but has 5"),
    ],
}


@each(("good", "bad", "words"), [(good, bad, words) for good, cases in BAD.items() for bad, words in cases])
def test_a_bad_file_ends_in_a_sentence(tmp_path, good, bad, words):
    assert good in FULL
    with pytest.raises(RigError, match=words) as caught:
        loaded(tmp_path, FULL.replace(good, bad, 1))
    text = str(caught.value)
    assert text.startswith(str(tmp_path / "scenario.yaml:")) and "\n" not in text
    assert text.count("scenario.yaml") == 1


def test_no_file_and_no_imu(tmp_path):
    with pytest.raises(RigError, match="does not exist; check the path of the scenario file"):
        load_scenario(tmp_path / "absent.yaml")
    with pytest.raises(RigError, match="is empty; give a scenario file"):
        loaded(tmp_path, "")
    begin, end = FULL.index("  imu0:"), FULL.index("  left:")
    with pytest.raises(RigError, match="sensors: there is no imu0 of type: imu"):
        loaded(tmp_path, FULL[:begin] + FULL[end:])


def test_stamps_of_today_have_19_digits(tmp_path):
    s = loaded(tmp_path, FULL.replace("start_ns: 5000000000", "start_ns: 1700000000000000000"))
    assert s.imu_clock_origin_ns == 1_700_000_000_000_000_000


@each(
    ("old", "new", "words"),
    [
        ("duration: 3", "duration: 1000000", "imu0 would measure 200,000,000 readings, and 5,000,000 are the most"),
        ("    rate: 200\n", "    rate: 100000000\n", "imu0 would measure"),
        (
            "    rate: 20\n",
            "    rate: 1000000\n",
            "left would measure 234,000,000 corners and points, and 100,000,000 are",
        ),
        ("    rate: 20\n", "    rate: 1000000000\n", "left would measure 3e+09 images, and 5,000,000 are the most"),
        ("    rate: 10\n", "    rate: 2000000\n", "top would measure 6,000,000 scans, and 5,000,000 are the most"),
        (
            "    rate: 200\n",
            "    rate: 1666666.7\n",
            "imu0 would measure 5,000,001 readings, and 5,000,000 are the most",
        ),
    ],
)
def test_what_would_not_fit_in_memory(tmp_path, old, new, words):
    path = tmp_path / "scenario.yaml"
    assert FULL.count(old) == 1
    path.write_text(FULL.replace(old, new))
    with pytest.raises(RigError, match=r"scenario.yaml:1: duration: ") as error:
        load_scenario(path)
    assert words in str(error.value) and "lower its rate, or the duration" in str(error.value)


@pytest.mark.parametrize(
    ("rates", "words"),
    [
        (
            {200: 900_000, 50: 800_000},
            "5,100,180 readings, images and scans together, imu0 2,700,000 of them, and 5,000,000",
        ),
        ({20: 100_000, 10: 70_000}, "107,400,000 corners and points together, top 84,000,000 of them, and 100,000,000"),
    ],
)
def test_what_only_all_sensors_together_would_not_fit_in_memory(tmp_path, rates, words):
    text = FULL
    for old, new in rates.items():
        assert text.count(f"    rate: {old}\n") == 1
        text = text.replace(f"    rate: {old}\n", f"    rate: {new}\n")
    with pytest.raises(RigError, match=f"the sensors would measure {words} are the most"):
        loaded(tmp_path, text)


def test_a_lidar_of_too_many_points(tmp_path):
    text = (PAPER / "table2-3d.yaml").read_text().replace("rings: 16", "rings: 16000")
    (tmp_path / "scenario.yaml").write_text(text)
    with pytest.raises(RigError, match="would measure 1.4e.10 points, and 100,000,000 are the most"):
        load_scenario(tmp_path / "scenario.yaml")


EFFECTS = """effects:
  imu: {accel_scale: [0.01, 0.02, 0.03], gyro_misalignment: [0.04, 0.05, 0.06], accel_rotation: [0.07, 0.08, 0.09]}
  pose_scale: {mocap: 0.99}
  target_size: 1.01
  range_offset: {top: 0.02}
  ring_offsets: {top: [0.01, 0.02, -0.01, 0.0]}
  ring_elevations: {top: [0.1, 0.2, 0.3, 0.4]}
  ring_azimuths: {top: [0.5, 0.6, 0.7, 0.8]}
"""
LATE = "effects: {imu: {accel_delay: 0.002, cutoff: 40}}\n"


def test_effects_are_read(tmp_path):
    scenario = loaded(tmp_path, EFFECTS + FULL)
    x = np.zeros(24)
    x[[0, 2, 5, 7, 9, 10, 12, 13, 14]] = 0.01 * np.arange(1, 10)
    np.testing.assert_allclose(scenario.imu_intrinsics, x)
    assert [p.scale for p in scenario.of(SimPoses)] == [0.99] and scenario.target_size == 1.01
    lidar = scenario.of(SimLidar)[0]
    assert (lidar.range_offset_m, lidar.elevation_errors_deg) == (0.02, (0.1, 0.2, 0.3, 0.4))
    assert (lidar.ring_offsets_m, lidar.azimuth_errors_deg) == ((0.01, 0.02, -0.01, 0.0), (0.5, 0.6, 0.7, 0.8))
    late = loaded(tmp_path, LATE + FULL)
    assert (late.imu_accel_delay_s, late.imu_cutoff_hz) == (0.002, 40.0)


@each(
    ("old", "new", "words"),
    [
        ("0.03]", "3]", "effects.imu.accel_scale: must be between -0.2 and 0.2: 0.01 is 1 %"),
        ("mocap: ", "mocap1: ", "effects.pose_scale.mocap1: there is no such field, did you mean 'mocap'"),
        ("1.01", "0.01", "effects.target_size: is true over stated length"),
        ("0.02}", "2}", "effects.range_offset.top: must be between -0.5 and 0.5, but is 2."),
        (", 0.4]", "]", "top has 4 rings, but 3 elevation errors; give one for each ring."),
        (", 0.8]", "]", "top has 4 rings, but 3 azimuth errors; give one for each ring."),
        (", 0.0]", "]", "top has 4 rings, but 3 ring offsets; give one for each ring."),
        ("-0.01, 0.0]", "-1, 0.0]", "effects.ring_offsets.top[2]: must be between -0.5 and 0.5, but is -1."),
        ("accel_scale: [0.01, 0.02, 0.03]", "cutoff: 1.0e-9", "effects.imu.cutoff: must be at least 1, but is 1e-09."),
    ],
)
def test_bad_effects_end_in_a_sentence(tmp_path, old, new, words):
    with pytest.raises(RigError, match=re.escape(words)):
        loaded(tmp_path, EFFECTS.replace(old, new) + FULL)
