"""Speed and yaw rate, four wheels, and steered front wheels, in tables and bags: what comes out, what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.data.measurements import WheelStream
from icalib.data.recordings import BagRecording, FolderRecording
from icalib.errors import RecordingError
from icalib.rig import Wheels
from icalib.sensors.wheels.read import WheelReadings, checked_wheels
from icalib.sensors.wheels.read import readings as wheel_readings

N, STEP, ORIGIN = 400, 20_000_000, 1_700_000_000_000_000_000
STAMPS = ORIGIN + STEP * np.arange(N)
SECONDS = (STAMPS - STAMPS[0]) * 1e-9
TWIST = np.stack([1.0 + 0.5 * np.sin(SECONDS), 0.7 + 0.1 * np.cos(0.7 * SECONDS)], axis=1)
STEERING = np.stack([10.0 + 5.0 * np.sin(SECONDS), 0.2 + 0.15 * np.cos(0.7 * SECONDS)], axis=1)
FOUR = np.stack([SECONDS * k + np.sin(k * SECONDS) for k in (1.0, 1.5, 2.0, 3.0)], axis=1)


def from_table(tmp_path, values: np.ndarray, **fields: Any) -> tuple[WheelStream, tuple[str, ...]]:
    wheels = Wheels("wheel0", "wheel0/data.csv", **fields)
    (tmp_path / "wheel0").mkdir(exist_ok=True)
    rows = (f"{t},{','.join(map(repr, row))}\n" for t, row in zip(STAMPS.tolist(), values.tolist(), strict=True))
    (tmp_path / "wheel0" / "data.csv").write_text("#t\n" + "".join(rows))
    folder = FolderRecording(tmp_path)
    stream, notes = checked_wheels(wheel_readings(folder, wheels), wheels, folder.where(wheels))
    assert isinstance(stream, WheelStream)
    return stream, notes


@pytest.mark.parametrize("sampling", ["interval-mean", "instantaneous"])
def test_speed_and_yaw_rate(tmp_path, sampling):
    stream, notes = from_table(tmp_path, TWIST, measures="twist", sampling=sampling)
    assert (stream.kind, stream.sampling, notes) == ("twist", sampling, ())
    np.testing.assert_allclose(stream.rate, TWIST, rtol=1e-15)


@pytest.mark.parametrize("measures", ["rates", "angles"])
def test_four_wheels_are_two_sides(tmp_path, measures):
    stream, _ = from_table(tmp_path, FOUR, measures=measures, drive="skid-steer")
    each = FOUR if measures == "rates" else np.diff(FOUR, axis=0) / np.diff(SECONDS)[:, None]
    sides = np.stack([0.5 * (each[:, 0] + each[:, 1]), 0.5 * (each[:, 2] + each[:, 3])], axis=1)
    assert stream.kind == "pair"
    np.testing.assert_allclose(stream.rate[-len(sides) :], sides, atol=1e-12)


def test_a_driven_wheel_and_a_steering_angle(tmp_path):
    stream, notes = from_table(tmp_path, STEERING, drive="ackermann")
    assert (stream.kind, notes) == ("steered", ())
    np.testing.assert_allclose(stream.rate, STEERING, rtol=1e-15)
    angles = np.stack([np.cumsum(STEERING[:, 0]) * 0.02, STEERING[:, 1]], axis=1)
    stream, _ = from_table(tmp_path, angles, drive="ackermann", measures="angles")
    np.testing.assert_allclose(stream.rate[1:], STEERING[1:], atol=1e-9)


REFUSED = {
    "km/h": (TWIST * [100.0, 1.0], {"measures": "twist"}, "multiply km/h by 1 / 3.6"),
    "deg/s": (TWIST * [1.0, 57.3], {"measures": "twist"}, "multiply deg/s by pi / 180"),
    "degrees": (np.rad2deg(STEERING) * [0.01, 1.0], {"drive": "ackermann"}, "steered by 2"),
    "wheel": (STEERING * [30.0, 1.0], {"drive": "ackermann"}, "the wheels turn at 449.9 rad/s"),
    "columns": (FOUR, {}, "4 columns|has 5 columns|columns"),
}


@each("case", REFUSED)
def test_what_would_be_wrong_is_refused(tmp_path, case):
    values, fields, words = REFUSED[case]
    with pytest.raises(RecordingError, match=words) as error:
        from_table(tmp_path, values, **fields)
    assert str(error.value).startswith(str(tmp_path))


@each(
    ("values", "column", "fields", "words"),
    [
        (TWIST, 0, {"measures": "twist"}, "the speed stays at 1.24 m/s for 5.98 s .* while the vehicle turns; check"),
        (TWIST, 1, {"measures": "twist"}, "the yaw rate stays at 0.45.* rad/s .* unless it went straight"),
        (STEERING, 0, {"drive": "ackermann"}, "the driven wheel reports 12.* rad/s .* while the wheels are steered"),
        (STEERING, 1, {"drive": "ackermann"}, "the steering stays at 0.3.* rad .* while the vehicle drives"),
    ],
)
def test_what_is_stuck_is_noted(tmp_path, values, column, fields, words):
    stuck = values.copy()
    stuck[50:350, column] = [1.24, 0.45][column] if "measures" in fields else stuck[25, column]
    _, notes = from_table(tmp_path, stuck, **fields)
    assert len(notes) == 1
    with pytest.raises(AssertionError, match=words):
        raise AssertionError(notes[0])


@pytest.fixture
def bag_of(tmp_path, write):
    """The type of the messages and what makes each of its number -> a bag."""

    def build(kind: str, content: Any, topic: str = "/wheel0/data") -> BagRecording:
        make = write.maker()
        messages = [(topic, kind, t + 5, content(make, k, t)) for k, t in enumerate(STAMPS.tolist())]
        return BagRecording(write.ros2(tmp_path / "run", messages))

    return build


def twist_of(make, k):
    v, w = TWIST[k].tolist()
    linear = make.make("geometry_msgs/msg/Vector3", v, 0.02, 0.03)
    return make.make("geometry_msgs/msg/Twist", linear, make.make("geometry_msgs/msg/Vector3", 0.1, 0.2, w))


def stamped(make, k, t):
    return make.make("geometry_msgs/msg/TwistStamped", make.header(t), twist_of(make, k))


def odometry(make, k, t):
    """Its pose was never filled in, which is no matter here."""
    none = np.zeros(36)
    pose = make.make(
        "geometry_msgs/msg/Pose",
        make.make("geometry_msgs/msg/Point", 0.0, 0.0, 0.0),
        make.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 0.0),
    )
    placed = make.make("geometry_msgs/msg/PoseWithCovariance", pose, none)
    moving = make.make("geometry_msgs/msg/TwistWithCovariance", twist_of(make, k), none)
    return make.make("nav_msgs/msg/Odometry", make.header(t), "base_link", placed, moving)


@pytest.mark.parametrize(
    ("kind", "content"),
    [("geometry_msgs/msg/TwistStamped", stamped), ("nav_msgs/msg/Odometry", odometry)],
    ids=["TwistStamped", "Odometry"],
)
def test_twists_of_bags(bag_of, kind, content):
    bag, wheels = bag_of(kind, content), Wheels("wheel0", "", measures="twist")
    stream, notes = checked_wheels(wheel_readings(bag, wheels), wheels, bag.where(wheels))
    assert isinstance(stream, WheelStream) and (stream.kind, notes) == ("twist", ())
    np.testing.assert_array_equal(stream.rate, TWIST)
    with pytest.raises(RecordingError, match="has no joints for wheel0"):
        wheel_readings(bag, Wheels("wheel0", ""))


def sideways(make, k, t, shifted):
    """Of mecanum wheels, or (shifted) of a differential drive, 0.4 m ahead of its axle and turned by 0.3 rad."""
    v, w, lateral = *TWIST[k].tolist(), 0.4 * np.sin(0.9 * k)
    along, across = (v, w * 0.4) if shifted else (v, lateral)
    c, s = (np.cos(0.3), np.sin(0.3)) if shifted else (1.0, 0.0)
    linear = make.make("geometry_msgs/msg/Vector3", c * along - s * across, s * along + c * across, 0.0)
    twist = make.make("geometry_msgs/msg/Twist", linear, make.make("geometry_msgs/msg/Vector3", 0.0, 0.0, w))
    return make.make("geometry_msgs/msg/TwistStamped", make.header(t), twist)


@pytest.mark.parametrize("shifted", [False, True])
def test_twists_of_mecanum_wheels(bag_of, shifted):
    kind, wheels = "geometry_msgs/msg/TwistStamped", Wheels("wheel0", "", measures="twist")
    bag = bag_of(kind, lambda make, k, t: sideways(make, k, t, shifted))
    if shifted:
        assert isinstance(wheel_readings(bag, wheels), WheelReadings)
        return
    with pytest.raises(
        RecordingError, match="linear.y is .*% of its speed, and icalib has no model of mecanum .*: rel"
    ):
        wheel_readings(bag, wheels)


def test_twists_in_the_axes_of_the_world(bag_of):
    """Of an odometry that circles to one side, then to the other."""
    rate = 0.4 * np.sign(np.sin(0.8 * (STAMPS - STAMPS[0]) * 1e-9))
    heading = 1.0 + np.concatenate([[0.0], np.cumsum(rate[:-1] * np.diff(STAMPS) * 1e-9)])

    def content(turned):
        def make_one(make, k, t):
            linear = make.make(
                "geometry_msgs/msg/Vector3", *(0.7 * np.array([np.cos(turned[k]), np.sin(turned[k]), 0]))
            )
            twist = make.make("geometry_msgs/msg/Twist", linear, make.make("geometry_msgs/msg/Vector3", 0, 0, rate[k]))
            return make.make("geometry_msgs/msg/TwistStamped", make.header(t), twist)

        return make_one

    wheels = Wheels("wheel0", "", measures="twist")
    bag = bag_of("geometry_msgs/msg/TwistStamped", content(heading))
    with pytest.raises(RecordingError, match="is in the world frame, not in the vehicle's. .*type: pose, kind: rel"):
        wheel_readings(bag, wheels)


def joints(names, position, velocity):
    def make_one(make, k, t):
        make_it = make.make
        return make_it(
            "sensor_msgs/msg/JointState",
            make.header(t),
            names,
            np.array(position(k)),
            np.array(velocity(k)),
            np.zeros(0),
        )

    return make_one


def test_joints_of_four_wheels(bag_of):
    names = ["rear_right", "front_left", "rear_left", "front_right"]
    content = joints(names, lambda k: [], lambda k: FOUR[k, [3, 0, 1, 2]])
    bag, wheels = bag_of("sensor_msgs/msg/JointState", content), Wheels("wheel0", "", drive="skid-steer")
    np.testing.assert_array_equal(instance(wheel_readings(bag, wheels), WheelReadings).value, FOUR)
    with pytest.raises(
        RecordingError, match="the joints .* do not tell which are the wheel, the steering.*joints: .WHEEL, STE"
    ):
        wheel_readings(bag, Wheels("wheel0", "", drive="ackermann"))


def test_joints_of_front_wheels_that_steer(bag_of):
    """The inner wheel is steered more: cot(left) + cot(right) = 2 cot(middle), the axle 0.6 m ahead, 0.4 m wide."""
    names = ["rl", "rr", "sl", "sr"]
    turn = np.tan(STEERING[:, 1]) / 0.6
    left, right = (np.arctan(0.6 * turn / (1.0 - 0.2 * side * turn)) for side in (1.0, -1.0))
    content = joints(
        names,
        lambda k: [np.nan, np.nan, left[k], right[k]],
        lambda k: [STEERING[k, 0] - 1.0, STEERING[k, 0] + 1.0, np.nan, np.nan],
    )
    bag = bag_of("sensor_msgs/msg/JointState", content)
    wheels = Wheels("wheel0", "", drive="ackermann", joints=("rl", "rr", "sl", "sr"))
    stream, _ = checked_wheels(wheel_readings(bag, wheels), wheels, bag.where(wheels))
    assert isinstance(stream, WheelStream) and stream.kind == "steered"
    np.testing.assert_allclose(stream.rate, STEERING, atol=1e-12)
    with pytest.raises(RecordingError, match="rl has no position; record the steering angle"):
        wheel_readings(bag, Wheels("wheel0", "", drive="ackermann", joints=("rr", "rl")))
