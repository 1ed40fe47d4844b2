"""Poses of one frame in another through the tree of transforms, against the product of what was written."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from icalib.data.folder import FolderRecording
from icalib.data.recordings import BagRecording
from icalib.errors import RecordingError
from icalib.pipeline import calibrate
from icalib.rig import PoseSensor
from icalib.rig.file import rig_from_dict
from icalib.sensors.pose.read import readings as pose_readings

START, STEP, COUNT = 1_700_000_000_123_456_789, 20_000_000, 40
SECONDS = np.arange(COUNT) * STEP * 1e-9
MOUNT = Rotation.from_euler("xyz", [0.3, -0.2, 1.1]), np.array([0.1, 0.2, 0.3])  # world -> base, static
TOOL = Rotation.from_euler("xyz", [1.3, 0.4, -0.6]), np.array([-0.05, 0.02, 0.15])  # flange -> tool, static
SHOULDER = Rotation.from_rotvec(np.outer(0.8 * np.sin(3.0 * SECONDS), [0, 0, 1])), np.tile([0.0, 0.1, 0.4], (COUNT, 1))
WRIST = (
    Rotation.from_rotvec(np.outer(1.1 * np.cos(2.0 * SECONDS), [0, 1, 0])),
    np.stack([0.2 * SECONDS, SECONDS**2, 0 * SECONDS], 1),
)


@dataclass(frozen=True)
class Bag:
    """Writes transforms (stamp [ns], parent, child, rotation, position) as messages of ROS 1 or ROS 2."""

    write: object
    kind: str
    folder: object
    message_type: str = "tf2_msgs/msg/TFMessage"

    def __call__(self, moving, static=(), others=()) -> BagRecording:
        make = self.write.maker(self.kind)  # pyright: ignore
        messages = list(others)
        for topic, transforms in (("/tf_static", static), ("/tf", moving)):
            for stamp, *pair_and_pose in transforms:
                message = make.make(self.message_type, [transform(make, stamp, *pair_and_pose)])
                messages.append((topic, self.message_type, (stamp or START) + 5, message))
        path = self.folder / ("run.bag" if self.kind == "ros1" else "run")  # pyright: ignore
        writer = self.write.ros1 if self.kind == "ros1" else self.write.ros2  # pyright: ignore
        return BagRecording(writer(path, sorted(messages, key=lambda m: m[2])))


def transform(make, stamp, parent, child, rotation, position):
    turn = make.make("geometry_msgs/msg/Quaternion", *np.asarray(rotation.as_quat()).tolist())
    pose = make.make("geometry_msgs/msg/Transform", make.vector(position), turn)
    return make.make("geometry_msgs/msg/TransformStamped", make.header(stamp, parent), child, pose)


@pytest.fixture(params=["ros1", "ros1 tf", "ros2"])
def bag_of(request, tmp_path, write) -> Bag:
    kind, *old = request.param.split()
    return Bag(write, kind, tmp_path, "tf/msg/tfMessage" if old else "tf2_msgs/msg/TFMessage")


@pytest.fixture
def one_bag(tmp_path, write) -> Bag:
    return Bag(write, "ros2", tmp_path)


def sent(parent, child, poses, stamps=None, every=1):
    stamps = [START + k * STEP for k in range(COUNT)] if stamps is None else stamps
    return [(stamps[k], parent, child, poses[0][k], poses[1][k]) for k in range(0, COUNT, every)]


STATIC = [(0, "world", "/base", *MOUNT), (0, "flange", "tool", *TOOL)]
MOVING = [*sent("base", "/shoulder", SHOULDER), *sent("shoulder", "flange", WRIST)]


def matrix(rotation, position):
    T = np.tile(np.eye(4), (len(np.atleast_2d(position)), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = rotation.as_matrix(), position
    return T


WORLD_TOOL = matrix(*MOUNT) @ matrix(*SHOULDER) @ matrix(*WRIST) @ matrix(*TOOL)


def sensor(*frames, topic=None) -> PoseSensor:
    return PoseSensor("arm", "arm/poses.csv", topic=topic, frames=frames or None)


def check(found, stamps, T):
    assert found.stamps_ns.tolist() == stamps
    np.testing.assert_allclose(found.rotation, T[:, :3, :3], atol=1e-12)
    np.testing.assert_allclose(found.position, T[:, :3, 3], atol=1e-12)


@pytest.mark.parametrize("topic", [None, "/tf", "tf", "/tf_static"])
def test_chain(bag_of, topic):
    bag = bag_of(MOVING, STATIC)
    stamps = [START + k * STEP for k in range(COUNT)]
    check(pose_readings(bag, sensor("world", "/tool", topic=topic)), stamps, WORLD_TOOL)
    check(pose_readings(bag, sensor("tool", "world", topic=topic)), stamps, np.linalg.inv(WORLD_TOOL))
    assert bag.notes() == ()


def test_between_branches(one_bag):
    """From one branch of the tree to another: up, then down."""
    static = [*STATIC, (0, "base", "camera", *TOOL)]
    found = pose_readings(one_bag(MOVING, static), sensor("camera", "flange"))
    check(
        found,
        [START + k * STEP for k in range(COUNT)],
        matrix(TOOL[0].inv(), -TOOL[0].inv().apply(TOOL[1])) @ matrix(*SHOULDER) @ matrix(*WRIST),
    )


def test_a_slower_edge_is_interpolated(one_bag):
    """At the stamps of the faster one, within the time of the slower one."""
    bag = one_bag([*sent("base", "shoulder", SHOULDER, every=3), *sent("shoulder", "flange", WRIST)], STATIC)
    last = (COUNT - 1) // 3 * 3
    inside = slice(0, last + 1)
    turned = Slerp(SECONDS[::3], SHOULDER[0][::3])(SECONDS[inside])
    expected = matrix(turned, SHOULDER[1][inside]) @ matrix(*WRIST)[inside]
    check(pose_readings(bag, sensor("base", "flange")), [START + k * STEP for k in range(last + 1)], expected)


def test_over_gaps_nothing_is_interpolated(one_bag):
    """Over three periods it is, over more it is not."""
    rare = [row for k, row in enumerate(sent("base", "shoulder", SHOULDER)) if k not in (5, 6, 20, 21, 22, 23)]
    bag = one_bag([*rare, *sent("shoulder", "flange", WRIST)], STATIC)
    found = pose_readings(bag, sensor("base", "flange"))
    assert found.stamps_ns.tolist() == [START + k * STEP for k in range(COUNT) if k not in (20, 21, 22, 23)]
    (note,) = bag.notes()
    assert f"4 of {COUNT} poses base -> flange were removed, the first at {START + 20 * STEP} ns" in note


def test_transforms_that_are_sent_again_count_once(one_bag):
    """And late ones are sorted; what never changes is static wherever it is sent."""
    tool = ([TOOL[0]] * COUNT, [TOOL[1]] * COUNT)
    moving = [*MOVING, *MOVING[::2], *sent("flange", "tool", tool, every=7)]
    check(
        pose_readings(one_bag(moving, STATIC[:1]), sensor("world", "tool")),
        [START + k * STEP for k in range(COUNT)],
        WORLD_TOOL,
    )


def test_a_quaternion_that_is_none(one_bag):
    stamps = [START + k * STEP for k in range(COUNT)]
    moving = sent("base", "flange", WRIST)
    moving[7] = (*moving[7][:4], np.array([np.nan, 0.0, 0.0]))
    bag = one_bag(moving)
    assert pose_readings(bag, sensor("base", "flange")).stamps_ns.tolist() == stamps[:7] + stamps[8:]
    assert "1 of 40 transforms base -> flange are not finite" in bag.notes()[0]


def test_wrong_frames(bag_of):
    bag = bag_of([*MOVING, *sent("map", "cart", WRIST)], STATIC)
    with pytest.raises(
        RecordingError, match="no frame hand; there are base, cart, flange, map, shoulder, tool, world;"
    ):
        pose_readings(bag, sensor("base", "hand"))
    with pytest.raises(RecordingError, match="no transforms connect base and cart; base is connected with flange, "):
        pose_readings(bag, sensor("base", "cart"))
    with pytest.raises(RecordingError, match="nothing moves between the frames flange -> tool"):
        pose_readings(bag, sensor("flange", "tool"))
    with pytest.raises(RecordingError, match=r"/tf holds transforms of many frames; set `frames: \[parent, child\]`"):
        pose_readings(bag, sensor(topic="/tf"))
    with pytest.raises(RecordingError, match=r"/tf holds transforms of many frames; set `frames: \[parent, child\]`"):
        pose_readings(bag, sensor())


def test_clock_set_back(one_bag):
    stamps = [START + k * STEP - (k > 20) * 5_000_000_000 for k in range(COUNT)]
    make = one_bag.write.maker("ros2")  # pyright: ignore
    messages = [
        (
            "/tf",
            "tf2_msgs/msg/TFMessage",
            START + k * STEP,
            make.make(
                "tf2_msgs/msg/TFMessage", [transform(make, stamps[k], "base", "flange", WRIST[0][k], WRIST[1][k])]
            ),
        )
        for k in range(COUNT)
    ]
    with pytest.raises(RecordingError, match="the stamps of base -> flange go back by 5.0 s"):
        pose_readings(one_bag((), (), messages), sensor("base", "flange"))


def test_frames_of_other_topics(one_bag, tmp_path):
    make = one_bag.write.maker("ros2")  # pyright: ignore
    turn, kind = make.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0), "geometry_msgs/msg/PoseStamped"
    pose = make.make(
        kind, make.header(START), make.make("geometry_msgs/msg/Pose", make.vector([0, 0, 0], "Point"), turn)
    )
    bag = one_bag((), (), [("/arm", kind, START, pose)])
    with pytest.raises(
        RecordingError, match="/arm holds geometry_msgs/msg/PoseStamped, but `frames` of arm needs transforms"
    ):
        pose_readings(bag, sensor("base", "flange", topic="/arm"))
    with pytest.raises(RecordingError, match="has no topic /tf; it holds /arm"):
        pose_readings(bag, sensor("base", "flange"))
    (tmp_path / "folder/arm").mkdir(parents=True)
    (tmp_path / "folder/arm/poses.csv").write_text("#t [ns],x,y,z,qx,qy,qz,qw\n1,0,0,0,0,0,0,1\n")
    with pytest.raises(RecordingError, match="is a folder, but `frames` of arm needs the transforms"):
        pose_readings(FolderRecording(tmp_path / "folder"), sensor("base", "flange"))


MOUNTED = matrix(Rotation.from_euler("xyz", [0.4, -0.3, 0.9]), np.array([0.05, -0.02, 0.1]))[0]  # tool -> tracked body
LAB = matrix(Rotation.from_euler("xyz", [0.02, -0.03, 2.0]), np.array([1.0, -2.0, 0.3]))[0]  # frame of the tracker


def stops(seed: int, count: int) -> tuple[Rotation, np.ndarray]:
    rng = np.random.default_rng(seed)
    return Rotation.from_rotvec(0.6 * rng.standard_normal((count, 3))), 0.3 * rng.standard_normal((count, 3))


def at_stops(parent, child, poses, stamps):
    """Each stamp between k and k + 0.5 s has the pose of stop k."""
    at = [(t - START) // 10**9 for t in stamps]
    return [(t, parent, child, poses[0][k], poses[1][k]) for t, k in zip(stamps, at, strict=True)]


@pytest.mark.parametrize("streamed", [False, True])
@pytest.mark.parametrize("inverted", [False, True])
def test_poses_at_rest_through_transforms(one_bag, streamed, inverted):
    """A robot's arm stops for half a second at each of some places, and a tracker sees its hand: hand-eye."""
    count, make = 12, one_bag.write.maker("ros2")
    each = range(0, 500_000_000, 20_000_000) if streamed else [250_000_000]
    stamps = [START + k * 10**9 + own for k in range(count) for own in each]
    shoulder, wrist = stops(1, count), stops(2, count)
    moving = at_stops("base", "shoulder", shoulder, stamps) + at_stops("shoulder", "flange", wrist, stamps)
    seen, others = LAB @ matrix(*MOUNT) @ matrix(*shoulder) @ matrix(*wrist) @ matrix(*TOOL) @ MOUNTED, []
    for k, T in enumerate(seen):
        t, q = START + k * 10**9 + 250_000_000, Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        pose = make.make(
            "geometry_msgs/msg/Pose", make.vector(T[:3, 3], "Point"), make.make("geometry_msgs/msg/Quaternion", *q)
        )
        message = make.make("geometry_msgs/msg/PoseStamped", make.header(t, "lab"), pose)
        others.append(("/tracker", "geometry_msgs/msg/PoseStamped", t + 5, message))
    bag = one_bag(sorted(moving, key=lambda m: m[0]), STATIC, others)
    frames = ["/tool", "world"] if inverted else ["world", "tool"]
    noise = {"rotation_noise": 1e-3, "position_noise": 1e-3}
    arm = {"type": "pose", "frames": frames, "inverted": inverted} | noise
    rig = rig_from_dict({"sensors": {"tracker": {"type": "pose", "topic": "/tracker"} | noise, "arm": arm}}, "rig.yaml")
    result = calibrate(rig, bag)
    assert result.converged, result.status
    np.testing.assert_allclose(result.T_imu_sensor("arm"), np.linalg.inv(MOUNTED), atol=1e-6)
    assert any(f"{count} poses of arm were taken at rest" in words for words in result.notes), result.notes
