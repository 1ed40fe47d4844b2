"""Topics become sensors with names that tell them apart."""

from __future__ import annotations

import itertools
import re

import pytest

from icalib.data.messages import message_types
from icalib.data.recordings import TopicInfo
from icalib.sensors.camera.inspect.facts import CameraSource
from icalib.tools.inspection import find_sources


def topics(*names: str) -> list[TopicInfo]:
    """By their names: ...info are CameraInfo, ...imu... IMUs, tables by their endings, all else images."""

    def kind(name: str) -> str:
        if name.endswith("corners.csv"):
            return "corners"
        if name.endswith("info"):
            return "camera info"
        return "imu" if re.search("imu|mavros", name) else "image"

    types = {known.kind: name for name, known in message_types().items()}
    return [TopicInfo(n, types.get(kind(n), "table"), kind(n), 10, 0, 1) for n in names]


@pytest.mark.parametrize(
    ("given", "cameras", "imus"),
    [
        (["/cam0/image_raw", "/cam1/image_raw", "/imu0"], ["cam0", "cam1"], ["imu0"]),
        (["/stereo/left/image_raw", "/stereo/right/image_raw", "/imu/data"], ["left", "right"], ["imu"]),
        (["/left/camera/image_raw", "/right/camera/image_raw", "/imu"], ["left_camera", "right_camera"], ["imu"]),
        (["/image_raw", "/imu/data_raw"], ["cam0"], ["imu"]),
        (["/cam0/image_raw", "/imu", "/mavros/imu/data"], ["cam0"], ["imu", "mavros_imu"]),
        (["cam0", "cam1/corners.csv", "imu0/data.csv"], ["cam0", "cam1"], ["imu0"]),
        (["/7/image_raw", "/a b/image_raw", "/imu"], ["cam_7", "a_b"], ["imu"]),
    ],
)
def test_names(given, cameras, imus):
    found = find_sources(topics(*given))
    assert list(found.of("camera")) == cameras
    assert list(found.of("imu")) == imus
    assert all(re.fullmatch("[A-Za-z][A-Za-z0-9_-]*", n) for n in (*cameras, *imus))


def test_the_same_images_twice_are_one_camera():
    given = ["/c/image_rect", "/c/image_raw/compressed", "/c/image_raw", "/c/camera_info", "/d/image_raw"]
    found = find_sources(topics(*given))
    camera = found.of("camera")["c"]
    assert camera.images and camera.info
    assert (camera.images.name, camera.info.name) == ("/c/image_raw", "/c/camera_info")
    assert found.of("camera")["d"].info is None


def test_lidars_and_wheels():
    given = {
        "/imu0": "imu",
        "/top/points": "points",
        "/velodyne_points": "points",
        "lidar0/scans.npz": "points",
        "/joint_states": "joints",
        "wheel1/ticks.csv": "wheels",
    }
    found = find_sources([TopicInfo(name, "", kind, 10, 0, 1) for name, kind in given.items()])
    assert list(found.of("imu")) == ["imu0"] and list(found.of("lidar")) == ["top", "velodyne_points", "lidar0"]
    assert {name: source.topic.name for name, source in found.of("wheels").items()} == {
        "wheel0": "/joint_states",
        "wheel1": "wheel1/ticks.csv",
    }


def test_poses_and_odometry():
    given = {"/imu0": "imu", "/vrpn/robot/pose": "pose", "/odom": "odometry", "odom0/poses.tum": "pose"}
    found = find_sources([TopicInfo(name, "", kind, 10, 0, 1) for name, kind in given.items()])
    assert {name: source.topic.name for name, source in found.of("pose").items()} == {
        "robot": "/vrpn/robot/pose",
        "pose0": "/odom",
        "odom0": "odom0/poses.tum",
    }


def test_depth_images_are_no_camera():
    found = find_sources(topics("/d455/depth/image_rect_raw", "/d455/color/image_raw"))
    assert list(found.of("camera")) == ["color"]


def test_images_and_corners_of_one_camera():
    (camera,) = find_sources(topics("cam0", "cam0/corners.csv")).sensors.values()
    assert isinstance(camera, CameraSource)
    assert camera.images and camera.corners and camera.topic is camera.corners


def test_names_that_no_part_tells_apart():
    found = find_sources(topics("/a-/image_raw", "/a_/image_raw"))
    assert len(found.sensors) == 2


PLAIN = {
    "/image_raw": "image",
    "/data": "imu",
    "/odom": "odometry",
    "/pose": "pose",
    "/fix": "navsat",
    "/point": "point",
    "/points": "points",
    "/joint_states": "joints",
}


@pytest.mark.parametrize("count", [1, 2, len(PLAIN)])
def test_topics_that_name_no_sensor(count):
    for names in itertools.combinations(PLAIN, count):
        found = find_sources([TopicInfo(name, "", PLAIN[name], 10, 0, 1) for name in names])
        assert {source.topic.name for source in found.sensors.values()} == set(names)
