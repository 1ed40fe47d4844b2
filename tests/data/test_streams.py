"""Poses, twists, odometry, joints, points and camera parameters of a bag, against what was written."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.typed import random_rotations

from icalib.data.messages import read_poses, read_twists
from icalib.data.recordings import BagRecording
from icalib.errors import RecordingError
from icalib.sensors.camera.read import read_camera_info
from icalib.sensors.lidar.read.point_clouds import point_clouds
from icalib.sensors.wheels.read import read_joints

RNG = np.random.default_rng(11)
STAMPS = [1_700_000_000_123_456_789 + k * 10_000_000 for k in range(5)]
POSITION, LINEAR, ANGULAR = (RNG.normal(size=(5, 3)) for _ in range(3))
XYZW = random_rotations(5, seed=1).as_quat()


@pytest.fixture(params=["ros1", "ros2"])
def bag_of(request, tmp_path, write):
    """A function: (type, what makes the message number k) -> a bag of five such messages on /t, and that maker."""

    def build(kind: str, content) -> BagRecording:
        maker = write.maker(request.param)
        messages = [("/t", kind, t + 5, content(maker, k, maker.header(t, "odom"))) for k, t in enumerate(STAMPS)]
        path = tmp_path / ("run.bag" if request.param == "ros1" else "run")
        return BagRecording((write.ros1 if request.param == "ros1" else write.ros2)(path, messages))

    return build


def pose(make, k: int, xyzw: np.ndarray = XYZW):
    turn = make.make("geometry_msgs/msg/Quaternion", *xyzw[k].tolist())
    return make.make("geometry_msgs/msg/Pose", make.vector(POSITION[k], "Point"), turn)


def twist(make, k: int):
    return make.make("geometry_msgs/msg/Twist", make.vector(LINEAR[k]), make.vector(ANGULAR[k]))


def check_poses(found):
    assert (found.frame, found.stamps_ns.tolist()) == ("odom", STAMPS)
    np.testing.assert_array_equal(found.position, POSITION)
    np.testing.assert_allclose(found.rotation, Rotation.from_quat(XYZW).as_matrix(), atol=1e-14)


def test_poses(bag_of):
    kind = "geometry_msgs/msg/PoseStamped"
    check_poses(read_poses(bag_of(kind, lambda make, k, header: make.make(kind, header, pose(make, k))), "/t"))


def test_orientation_that_is_none(bag_of):
    kind = "geometry_msgs/msg/PoseStamped"
    zeros = XYZW * (np.arange(5) != 3)[:, None]
    bag = bag_of(kind, lambda make, k, header: make.make(kind, header, pose(make, k, zeros)))
    assert np.isnan(read_poses(bag, "/t").rotation).all(axis=(1, 2)).tolist() == [False, False, False, True, False]


def test_orientations_that_are_mostly_none(bag_of):
    kind = "geometry_msgs/msg/PoseStamped"
    zeros = XYZW * (np.arange(5) < 1)[:, None]
    bag = bag_of(kind, lambda make, k, header: make.make(kind, header, pose(make, k, zeros)))
    with pytest.raises(RecordingError, match=f"/t: the orientation at {STAMPS[1]} ns is not a unit quaternion"):
        read_poses(bag, "/t")


def test_twists(bag_of):
    kind = "geometry_msgs/msg/TwistStamped"
    found = read_twists(bag_of(kind, lambda make, k, header: make.make(kind, header, twist(make, k))), "/t")
    assert (found.frame, found.stamps_ns.tolist()) == ("odom", STAMPS)
    np.testing.assert_array_equal(found.linear, LINEAR)
    np.testing.assert_array_equal(found.angular, ANGULAR)


def odometry(make, k: int, header, body: str = "base"):
    posed = make.make("geometry_msgs/msg/PoseWithCovariance", pose(make, k), np.zeros(36))
    moved = make.make("geometry_msgs/msg/TwistWithCovariance", twist(make, k), np.zeros(36))
    return make.make("nav_msgs/msg/Odometry", header, body, posed, moved)


def test_odometry(bag_of):
    bag = bag_of("nav_msgs/msg/Odometry", odometry)
    check_poses(read_poses(bag, "/t", "odometry"))
    found = read_twists(bag, "/t", "odometry")
    assert found.frame == "base"
    np.testing.assert_array_equal(found.linear, LINEAR)


def test_frame_that_changes(bag_of):
    bag = bag_of("nav_msgs/msg/Odometry", lambda make, k, header: odometry(make, k, header, f"base{k // 3}"))
    with pytest.raises(RecordingError, match="/t mixes the frames base0, base1"):
        read_poses(bag, "/t", "odometry")


def joints(make, k: int, header, speeds: int = 1):
    names = [["left", "right"], ["right"]][k % 2]
    position, velocity = np.arange(len(names)) + 10.0 * k, np.full(len(names) * speeds, -float(k))
    return make.make("sensor_msgs/msg/JointState", header, names, position, velocity, np.zeros(0))


def test_joints_by_name(bag_of):
    found = read_joints(bag_of("sensor_msgs/msg/JointState", joints), "/t")
    nan = np.nan
    assert found.names == ("left", "right")
    np.testing.assert_array_equal(found.position, [[0, 1], [nan, 10], [20, 21], [nan, 30], [40, 41]])
    np.testing.assert_array_equal(found.velocity, [[0, 0], [nan, -1], [-2, -2], [nan, -3], [-4, -4]])
    assert found.effort.shape == (5, 2) and np.isnan(found.effort).all()


def test_joints_without_values_for_all(bag_of):
    bag = bag_of("sensor_msgs/msg/JointState", lambda make, k, header: joints(make, k, header, speeds=2))
    with pytest.raises(RecordingError, match=f"the message at {STAMPS[0]} ns has 2 joints, but 4 values"):
        read_joints(bag, "/t")


POINT = np.dtype(
    {"names": ["x", "y", "ring", "t"], "formats": ["f4", "f4", "u2", "u4"], "offsets": [0, 4, 8, 12], "itemsize": 20}
)


def cloud(make, k: int, header, order: Literal["<", ">"] = "<", cut: int = 0):
    """Two rows of three points, each row followed by four bytes of padding."""
    points = np.zeros((2, 3), POINT.newbyteorder(order))
    points["x"], points["ring"], points["t"] = RNG.normal(size=(2, 3)), np.arange(6).reshape(2, 3) + k, 7
    rows = np.hstack([points.view(np.uint8).reshape(2, -1), np.full((2, 4), 99, np.uint8)])
    fields = [
        make.make("sensor_msgs/msg/PointField", n, o, d, 1) for n, o, d in (("x", 0, 7), ("ring", 8, 4), ("t", 12, 6))
    ]
    data = rows.ravel()[: rows.size - cut]
    return make.make("sensor_msgs/msg/PointCloud2", header, 2, 3, fields, order == ">", 20, 64, data, True)


@pytest.mark.parametrize("order", ["<", ">"])
def test_points(bag_of, order):
    bag = bag_of("sensor_msgs/msg/PointCloud2", lambda make, k, header: cloud(make, k, header, order))
    found = list(point_clouds(bag, "/t"))
    assert [(c.stamp_ns, c.frame) for c in found] == [(t, "odom") for t in STAMPS]
    for k, c in enumerate(found):
        assert c.points.dtype.names == ("x", "ring", "t") and c.points.shape == (6,)
        assert c.points["ring"].tolist() == [k, k + 1, k + 2, k + 3, k + 4, k + 5]
        assert (c.points["t"] == 7).all() and np.abs(c.points["x"]).max() < 6


def test_a_cloud_that_is_cut_off_is_left_out(bag_of):
    bag = bag_of("sensor_msgs/msg/PointCloud2", lambda make, k, header: cloud(make, k, header, cut=5 * (k == 2)))
    assert [c.stamp_ns for c in point_clouds(bag, "/t")] == [t for k, t in enumerate(STAMPS) if k != 2]
    (note,) = bag.notes()
    assert f"/t: 1 of 5 messages are damaged and were left out, the first received at {STAMPS[2] + 5} ns" in note
    assert "6 points do not fit" in note


def test_points_cut_off(bag_of):
    bag = bag_of("sensor_msgs/msg/PointCloud2", lambda make, k, header: cloud(make, k, header, cut=5))
    words = f"/t: the message received at {STAMPS[0] + 5} ns is damaged .* all others"
    with pytest.raises(RecordingError, match=words):
        list(point_clouds(bag, "/t"))


def test_camera_info(bag_of):
    def info(make, k, header):
        region = make.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        matrices = (np.arange(5) / 10, np.arange(9.0), np.zeros(9), np.zeros(12))
        return make.make("sensor_msgs/msg/CameraInfo", header, 480, 752, "plumb_bob", *matrices, 0, 0, region)

    found = read_camera_info(bag_of("sensor_msgs/msg/CameraInfo", info), "/t")
    assert (found.resolution, found.model) == ((752, 480), "plumb_bob")
    assert found.K.tolist() == [[0, 1, 2], [3, 4, 5], [6, 7, 8]]
    np.testing.assert_allclose(found.distortion, [0, 0.1, 0.2, 0.3, 0.4])


def test_topic_of_another_type(bag_of):
    bag = bag_of("nav_msgs/msg/Odometry", odometry)
    with pytest.raises(RecordingError, match="/t is nav_msgs/msg/Odometry, not pose"):
        read_poses(bag, "/t")
