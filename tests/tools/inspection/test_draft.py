"""The draft of a rig file: it loads, it says where each number is from, and it replaces nothing."""

from __future__ import annotations

import json
import os
import re
import stat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.typed import not_none

from icalib.base.files import write_new
from icalib.cli import main
from icalib.errors import CalibrationError, RigError
from icalib.geometry.targets import AprilGrid
from icalib.rig.file import load_rig, load_target
from icalib.sensors.imu.spec import class_imperfections
from icalib.tools.inspection import draft_rig, inspect_recording

SIZE = (32, 24)
K = (40.5, 41.5, 15.25, 11.75)
KALIBR = """\
cam0:
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 0.0002, 1.8e-05]
  distortion_model: equidistant
  intrinsics: [30.0, 31.0, 16.0, 12.0]
  resolution: [32, 24]
  rostopic: /cam0/image_raw
"""
NOISE = """\
accelerometer_noise_density: 1.86e-03
accelerometer_random_walk: 4.33e-04
gyroscope_noise_density: 1.87e-04
gyroscope_random_walk: 2.66e-05
rostopic: /imu0
"""
GRID = "{target_type: aprilgrid, tagCols: 6, tagRows: 7, tagSize: 0.088, tagSpacing: 0.3}"


@pytest.fixture
def draft(bags, brief, tmp_path, capsys):
    """A function: messages beside those of /imu0 -> the draft made for them, and its path."""

    def build(messages, imu_topics=("/imu0",), quiet=True) -> tuple[str, Path]:
        for topic in imu_topics:
            messages = messages + bags.imu(topic, brief)
        bag = bags.write(tmp_path / "run", messages)
        path = tmp_path / "rig.yaml"
        assert main(["inspect", str(bag), "--rig", str(path), *(["-q"] if quiet else [])]) == 0, capsys.readouterr()
        return path.read_text(), path

    return build


def fill(path: Path) -> None:
    """What a user does to the template."""
    text = path.read_text()
    for name, value in (("rows", "7"), ("cols", "6"), ("tag_size", "0.088"), ("tag_spacing", "0.3")):
        text = text.replace(f"  {name}: ", f"  {name}: {value} ", 1)
    path.write_text(text)


def tagged_images(bags, topic: str, frame: str):
    """Images of 240 x 120 px with two tags."""
    cv2 = pytest.importorskip("cv2")
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    pixels = np.full((120, 240), 200, np.uint8)
    for i in (0, 1):
        pixels[20:100, 20 + 120 * i : 100 + 120 * i] = cv2.aruco.generateImageMarker(family, i, 80)
    return [bags.image(topic, bags.origin_ns + k * 50_000_000, pixels + k, frame=frame) for k in range(20)]


def test_cameras_that_see_no_target_track_points_of_the_scene(draft, bags):
    text, path = draft(bags.noise("/cam0/image_raw", SIZE) + bags.noise("/cam1/image_raw", (40, 30)))
    rig = load_rig(path)
    assert not rig.has_target and all(c.tracks_images for c in rig.cameras)
    assert "target:" not in text


def test_without_an_imu_a_target_is_asked_for(bags, tmp_path):
    bag, path = bags.write(tmp_path / "run", bags.noise("/cam0/image_raw", SIZE)), tmp_path / "rig.yaml"
    assert main(["inspect", str(bag), "--rig", str(path), "-q"]) == 0
    assert "tracks: images" not in path.read_text().split("target:")[0] and "target:" in path.read_text()


def test_a_draft_loads_once_the_target_is_filled_in(draft, bags):
    messages = tagged_images(bags, "/cam0/image_raw", "left: eye") + bags.noise("/cam1/image_raw", (40, 30))
    text, path = draft(messages)
    with pytest.raises(RigError, match=r"rig\.yaml:\d+: target\.tag_size: must be a number, but is empty"):
        load_rig(path)
    fill(path)
    rig = load_rig(path)
    assert rig.target == AprilGrid(7, 6, 0.088, 0.3)
    assert [(c.name, c.topic, c.model, c.resolution) for c in rig.cameras] == [
        ("cam0", "/cam0/image_raw", "pinhole-radtan", (240, 120)),
        ("cam1", "/cam1/image_raw", "pinhole-radtan", (40, 30)),
    ]
    assert all(c.intrinsics.value is None for c in rig.cameras)
    assert (not_none(rig.imu).name, not_none(rig.imu).topic, not_none(rig.imu).noise.source) == (
        "imu0",
        "/imu0",
        "default for a consumer IMU",
    )
    assert 'frame "left: eye"' in text and 'frame "imu_link"' in text
    assert "ruler" in text and "The noise of a class" in text
    assert "The most valuable line of this draft" in text and "\n    intrinsics: consumer\n" in text
    sigma = not_none(not_none(rig.imu).intrinsics.sigma)
    np.testing.assert_array_equal(sigma, class_imperfections("consumer").sigma)


def clouds_and_joints(bags):
    cloud, joints = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/JointState"
    fields, messages = [bags.make("sensor_msgs/msg/PointField", "x", 0, 7, 1)], []
    for t in range(1_700_000_000_000_000_000, 1_700_000_001_000_000_000, 100_000_000):
        points = bags.make(cloud, bags.header(t, "top"), 1, 2, fields, False, 4, 8, np.zeros(8, np.uint8), True)
        states = bags.make(joints, bags.header(t, ""), ["l", "r"], np.zeros(2), np.zeros(2), np.zeros(2))
        messages += [("/top/points", cloud, t, points), ("/joint_states", joints, t, states)]
    return messages


def test_a_draft_of_a_lidar_and_an_imu_needs_no_target(draft, bags):
    text, path = draft(clouds_and_joints(bags))
    rig = load_rig(path)
    assert [x.name for x in rig.lidars] == ["top"] and not_none(rig.imu).name == "imu0" and not rig.cameras
    assert "target" not in text


def test_lidars_are_drafted_and_wheels_suggested(draft, bags):
    text, path = draft(bags.noise("/cam0/image_raw", SIZE) + clouds_and_joints(bags))
    fill(path)
    rig = load_rig(path)
    assert [(s.name, s.topic) for s in rig.lidars] == [("top", "/top/points")] and rig.wheels == ()
    commented = text.split("  # Are these wheels?")[1].splitlines()[1:4]
    path.write_text(path.read_text().replace("\n".join(commented), "\n".join("  " + c[4:] for c in commented)))
    assert [(w.name, w.topic) for w in load_rig(path).wheels] == [("wheel0", "/joint_states")]


def test_a_twist_is_suggested_as_one(draft, bags):
    kind, messages = "geometry_msgs/msg/TwistStamped", bags.noise("/cam0/image_raw", SIZE)
    for t in range(1_700_000_000_000_000_000, 1_700_000_001_000_000_000, 100_000_000):
        none = bags.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
        twist = bags.make("geometry_msgs/msg/Twist", none, none)
        messages += [("/odom/twist", kind, t, bags.make(kind, bags.header(t, ""), twist))]
    text, path = draft(messages)
    fill(path)
    commented = text.split("  # Are these wheels?")[1].splitlines()[1:5]
    path.write_text(path.read_text().replace("\n".join(commented), "\n".join("  " + c[4:] for c in commented)))
    (wheels,) = load_rig(path).wheels
    assert (wheels.kind, wheels.topic) == ("twist", "/odom/twist")


def test_poses_are_suggested(draft, bags):
    kind = "geometry_msgs/msg/PoseStamped"
    point, turn = (
        bags.make("geometry_msgs/msg/Point", 0.0, 0.0, 0.0),
        bags.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0),
    )
    pose = bags.make("geometry_msgs/msg/Pose", point, turn)
    messages = bags.noise("/cam0/image_raw", SIZE)
    for t in range(1_700_000_000_000_000_000, 1_700_000_001_000_000_000, 100_000_000):
        messages.append(("/vrpn/robot/pose", kind, t, bags.make(kind, bags.header(t, "map"), pose)))
    text, path = draft(messages)
    fill(path)
    assert load_rig(path).poses == ()
    commented = text.split("docs/rig-file.md#pose-sensor).\n")[1].splitlines()[:4]
    path.write_text(path.read_text().replace("\n".join(commented), "\n".join("  " + c[4:] for c in commented)))
    assert [(p.name, p.topic, p.kind) for p in load_rig(path).poses] == [("robot", "/vrpn/robot/pose", "absolute")]


def odometry(bags, level: bool, quaternion: Any, kind: str = "nav_msgs/msg/Odometry") -> list:
    """A body that drives at 1 m/s, and nods if it is not level. quaternion: from time [s] to x, y, z, w."""
    messages = []
    for k in range(50):
        stamp, t = bags.origin_ns + k * 50_000_000, 0.05 * k
        point = bags.make("geometry_msgs/msg/Point", t, 0.0, 0.0 if level else 0.1 * np.sin(t))
        pose = bags.make("geometry_msgs/msg/Pose", point, bags.make("geometry_msgs/msg/Quaternion", *quaternion(t)))
        if kind.endswith("PoseStamped"):
            messages.append(("/odom", kind, stamp, bags.make(kind, bags.header(stamp, "odom"), pose)))
            continue
        speed, rate = (bags.make("geometry_msgs/msg/Vector3", *v) for v in ((1.0, 0.0, 0.0), (0.0, 0.0, 0.1)))
        twist = bags.make("geometry_msgs/msg/Twist", speed, rate)
        twist = bags.make("geometry_msgs/msg/TwistWithCovariance", twist, np.zeros(36))
        pose = bags.make("geometry_msgs/msg/PoseWithCovariance", pose, np.zeros(36))
        messages.append(("/odom", kind, stamp, bags.make(kind, bags.header(stamp, "odom"), "base", pose, twist)))
    return messages


def yaw(t: float) -> tuple[float, ...]:
    return 0.0, 0.0, np.sin(0.05 * t), np.cos(0.05 * t)


def nod(t: float) -> tuple[float, ...]:
    return np.sin(0.05 * t), 0.0, 0.0, np.cos(0.05 * t)


def nowhere(t: float) -> tuple[float, ...]:
    return (float("nan"),) * 4


POSE = "geometry_msgs/msg/PoseStamped"


@pytest.mark.parametrize(
    ("level", "quaternion", "kind", "drafted"),
    [
        (True, yaw, "nav_msgs/msg/Odometry", "type: wheels topic: /odom measures: twist"),
        (False, nod, "nav_msgs/msg/Odometry", "type: pose topic: /odom kind: relative"),
        (True, yaw, POSE, "type: pose topic: /odom kind: relative"),
        (False, nowhere, "nav_msgs/msg/Odometry", "type: position topic: /odom"),
        (False, nowhere, POSE, "type: position topic: /odom"),
        (False, lambda t: (0.0, 0.0, 0.0, 1.0), POSE, "type: position topic: /odom"),
    ],
)
def test_odometry_is_drafted_as_what_it_holds(bags, brief, tmp_path, level, quaternion, kind, drafted):
    """Level odometry is that of wheels; poses without a rotation are positions."""
    messages = bags.imu("/imu0", brief) + bags.noise("/cam0/image_raw") + odometry(bags, level, quaternion, kind)
    found = inspect_recording(bags.write(tmp_path / "run", messages))
    lines = [line.strip(" #").partition("  #")[0] for line in draft_rig(found).split("pose0:\n")[1].splitlines()]
    text = " ".join(lines)
    assert text.startswith(drafted)


def test_without_an_imu_odometry_follows_other_poses(bags, tmp_path):
    """The first pose sensor gives the trajectory."""
    tracked = [(f"/mocap{m[0]}", *m[1:]) for m in odometry(bags, False, nod, POSE)]
    messages = odometry(bags, False, nod) + [("/tracker/pose", *m[1:]) for m in tracked]
    text = draft_rig(inspect_recording(bags.write(tmp_path / "run", messages)))
    assert text.index("tracker:") < text.index("pose0:")
    kinds = re.findall(r"kind: (\w+)", text)
    assert kinds == ["absolute", "relative"]


@pytest.mark.parametrize(
    ("model", "D", "expected", "guess"),
    [
        ("rational_polynomial", [0.5, -2.5, 4e-4, -2e-4, 1.5, 0.4, -2.4, 1.4], "pinhole-rational", 8),
        (
            "rational_polynomial",
            [0.5, -2.5, 4e-4, -2e-4, 1.5, 0.4, -2.4, 1.4, 0.0, 0.0, 0.0, 0.0],
            "pinhole-rational",
            8,
        ),
        ("rational_polynomial", [-0.1, 0.01, 1e-3, 2e-3, 1e-4, 0.0, 0.0, 0.0], "pinhole-radtan5", 5),
        ("rational_polynomial", [0.0] * 8, "pinhole-radtan5", 5),
        ("rational_polynomial", [0.1] * 12, "pinhole-rational", 0),
        ("plumb_bob", [-0.1, 0.01, 1e-3, 2e-3, 1e-4], "pinhole-radtan5", 5),
        ("plumb_bob", [-0.1, 0.01, 1e-3, 2e-3], "pinhole-radtan", 4),
        ("equidistant", [0.1, 0.01, 1e-3, 2e-3], "pinhole-equidistant", 4),
        ("fisheye", [0.1, 0.01, 1e-3, 2e-3], "pinhole-equidistant", 4),
        ("thin_prism", [0.1] * 8, "pinhole-radtan", 0),
        ("", [], "pinhole-radtan", 0),
    ],
)
def test_values_of_camera_info(draft, bags, model, D, expected, guess):
    info = bags.camera_info("/cam0/camera_info", SIZE, model, D, K)
    text, path = draft([*bags.noise("/cam0/image_raw", SIZE), info])
    fill(path)
    (camera,) = load_rig(path).cameras
    assert camera.model == expected
    assert camera.intrinsics.mode == "free"
    np.testing.assert_array_equal(camera.intrinsics.value, K)
    assert (camera.distortion.value is not None) == (guess > 0)
    if guess:
        np.testing.assert_array_equal(camera.distortion.value, D[:guess])
    assert text.count("from /cam0/camera_info") == 2 + (guess > 0)


@pytest.mark.parametrize(
    ("topic", "size", "values", "words"),
    [
        ("/cam0/image_raw", SIZE, (0.0, 0.0, 0.0, 0.0), "/cam0/camera_info holds no intrinsics"),
        ("/cam0/image_raw", (64, 48), K, "values of /cam0/camera_info are for 64 x 48 px and are not used"),
        ("/cam0/image_rect", SIZE, K, "are for the unrectified images and are not used"),
    ],
)
def test_camera_info_that_is_not_used(draft, bags, topic, size, values, words):
    info = bags.camera_info("/cam0/camera_info", size, "plumb_bob", [0.0] * 5, values)
    text, path = draft([*bags.noise(topic, SIZE), info])
    fill(path)
    assert words in text
    assert load_rig(path).cameras[0].intrinsics.value is None


def test_a_draft_with_kalibrs_files_loads_as_it_is(draft, bags, tmp_path):
    for name, text in (("camchain-imucam", KALIBR), ("imu", NOISE), ("grid", GRID)):
        (tmp_path / f"{name}.yaml").write_text(text)
    info = bags.camera_info("/cam0/camera_info", SIZE, "plumb_bob", [0.0] * 5, K)
    text, path = draft([*bags.noise("/cam0/image_raw", SIZE), info])
    rig = load_rig(path)
    assert rig.target == AprilGrid(7, 6, 0.088, 0.3)
    assert rig.cameras[0].model == "pinhole-equidistant"
    np.testing.assert_array_equal(rig.cameras[0].intrinsics.value, [30.0, 31.0, 16.0, 12.0])
    np.testing.assert_array_equal(rig.cameras[0].distortion.value, [-0.28, 0.07, 0.0002, 1.8e-05])
    assert (not_none(rig.imu).noise.gyro, not_none(rig.imu).noise.source) == (1.87e-4, "imu.yaml (Kalibr)")
    assert "from camchain-imucam.yaml (Kalibr, cam0)" in text and "The target is from grid.yaml" in text


def test_kalibrs_camera_of_another_resolution(draft, bags, tmp_path):
    (tmp_path / "camchain.yaml").write_text(KALIBR.replace("[32, 24]", "[64, 48]"))
    text, path = draft(bags.noise("/cam0/image_raw", SIZE))
    fill(path)
    assert load_rig(path).cameras[0].intrinsics.value is None
    assert "camchain.yaml is for 64 x 48 px and is not used" in text


def test_kalibrs_noise_of_another_imu(draft, bags, tmp_path):
    (tmp_path / "imu.yaml").write_text(NOISE.replace("/imu0", "/imu1"))
    text, path = draft(bags.noise("/cam0/image_raw", SIZE), ("/imu0", "/imu1"))
    fill(path)
    rig = load_rig(path)
    assert (not_none(rig.imu).name, not_none(rig.imu).noise.gyro) == ("imu1", 1.87e-4)
    assert "Also recorded: imu0 (/imu0), readings in the frame of imu1." in text


def test_depth_images_and_odd_topics(draft, bags):
    names = ("/depth/image", "/rig: #1/image_raw", "/rig: #1/image_rect")
    text, path = draft([m for n in names for m in bags.noise(n, SIZE)])
    fill(path)
    (camera,) = load_rig(path).cameras
    assert (camera.name, camera.topic) == ("rig_1", names[1])
    assert "# Not used: /depth/image (depth images)" in text
    assert f"# Not used: {names[2]} (the images of rig_1 once more)" in text


def test_a_camera_that_cannot_be_read_is_left_out(draft, bags):
    pixels = np.ones((4, 4), np.uint8)
    odd = [bags.image("/odd/image", bags.origin_ns + k, pixels, "32FC9") for k in range(3)]
    text, path = draft(odd + bags.noise("/cam0/image_raw", SIZE))
    fill(path)
    assert [c.name for c in load_rig(path).cameras] == ["cam0"]
    assert "# Not used: odd (" in text and "32FC9" in text


def test_a_folder_of_tables_needs_its_resolution(tmp_path, capsys):
    example = Path(__file__).parents[3] / "examples" / "euroc" / "recording"
    path = tmp_path / "rig.yaml"
    assert main(["inspect", str(example), "--rig", str(path), "-q"]) == 0
    fill(path)
    with pytest.raises(RigError, match=r"cam0\.resolution"):
        load_rig(path)
    path.write_text(path.read_text().replace("resolution:", "resolution: [752, 480]"))
    rig = load_rig(path)
    assert [c.path for c in rig.cameras] == ["cam0/corners.csv", "cam1/corners.csv"]
    assert not_none(rig.imu).path == "imu0/data.csv"


@pytest.mark.parametrize("made", ["file", "link"])
def test_nothing_is_overwritten(made, bags, brief, tmp_path, capsys):
    bag = bags.write(tmp_path / "run", bags.noise("/cam0/image_raw", SIZE) + bags.imu("/imu0", brief))
    path = tmp_path / "rig.yaml"
    path.write_text("mine") if made == "file" else path.symlink_to(tmp_path / "nowhere")
    assert main(["inspect", str(bag), "--rig", str(path)]) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1 and "rig.yaml exists and was not changed; give another name" in captured.err
    assert not (tmp_path / "nowhere").exists() and (made == "link" or path.read_text() == "mine")


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    (tmp_path / "rig.yaml").write_text("mine")
    with pytest.raises(CalibrationError, match=r"rig\.yaml exists"):
        write_new(tmp_path / "rig.yaml", "draft")
    assert [p.read_text() for p in tmp_path.iterdir()] == ["mine"]


@pytest.mark.parametrize("there", [False, True])
def test_a_file_system_without_links(there, tmp_path, monkeypatch):
    def no_link(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", no_link)
    path = tmp_path / "rig.yaml"
    if there:
        path.write_text("mine")
        with pytest.raises(CalibrationError, match=r"rig\.yaml exists"):
            write_new(path, "draft")
    else:
        write_new(path, "draft")
    assert [p.read_text() for p in tmp_path.iterdir()] == ["mine" if there else "draft"]


def test_the_file_is_whole_and_readable_by_others(tmp_path):
    before = os.umask(0o022)
    try:
        write_new(tmp_path / "rig.yaml", "draft")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "rig.yaml").stat().st_mode) == 0o644
    assert [p.name for p in tmp_path.iterdir()] == ["rig.yaml"]


def test_a_folder_that_is_not_there(tmp_path):
    with pytest.raises(CalibrationError, match=r"rig\.yaml cannot be written .*choose another place"):
        write_new(tmp_path / "away" / "rig.yaml", "draft")


def test_no_draft_without_camera(bags, brief, tmp_path, capsys):
    bag = bags.write(tmp_path / "run", bags.imu("/imu0", brief))
    assert main(["inspect", str(bag), "--rig", str(tmp_path / "rig.yaml"), "-q"]) == 1
    assert (
        "holds no camera that can be read, no LiDAR, pose sensor or position sensor beside an IMU, and no LiDAR or "
        "pose sensor" in capsys.readouterr().err
    )
    assert not (tmp_path / "rig.yaml").exists()


def test_a_draft_of_cameras_alone_loads(bags, tmp_path):
    bag = bags.write(tmp_path / "run", bags.noise("/cam0/image_raw", SIZE))
    assert main(["inspect", str(bag), "--rig", str(tmp_path / "rig.yaml"), "-q"]) == 0
    text = (tmp_path / "rig.yaml").read_text()
    for field, value in (("rows:", 6), ("cols:", 6), ("tag_size:", 0.088), ("tag_spacing:", 0.3)):
        text = text.replace(f"\n  {field}", f"\n  {field} {value}", 1)
    (tmp_path / "rig.yaml").write_text(text)
    rig = load_rig(tmp_path / "rig.yaml")
    assert rig.imu is None and rig.reference == rig.cameras[0].name


SCENE = """\
targets:
  grid: {type: aprilgrid, rows: 3, cols: 3, tag_size: 0.1, tag_spacing: 0.3}
  wall: {type: markers, family: DICT_APRILTAG_36h11, size: 0.16, ids: [40, 43]}
"""


@pytest.mark.parametrize("text", [SCENE, "{type: markers, family: tag16h5, size: 0.2}"])
def test_free_tags_and_several_targets_are_taken_over(text, bags, brief, tmp_path, capsys):
    """Nothing of them is in the images, and the draft is written all the same."""
    bag = bags.write(tmp_path / "run", bags.noise("/cam0/image_raw", SIZE) + bags.imu("/imu0", brief))
    target, path, figures = (tmp_path / name for name in ("target.yaml", "rig.yaml", "figures.json"))
    target.write_text(text)
    options = ["--target", str(target), "--rig", str(path), "--json", str(figures)]
    assert main(["inspect", str(bag), *options]) == 0, capsys.readouterr()
    expected = load_target(target)
    assert load_rig(path).target == expected
    stated = json.loads(figures.read_text())["target"]
    assert stated.pop("file") == str(target)
    assert stated == (
        expected.plain() if expected.type == "markers" else {"type": "scene", "targets": expected.plain()}
    )
