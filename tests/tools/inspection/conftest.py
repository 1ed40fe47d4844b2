"""Small bags of ROS 2, sensor by sensor, with an IMU that is waved about and images of noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from tests.typed import not_none

from icalib.data.measurements import ImuStream
from icalib.tools.simulation import handheld, simulate

ORIGIN = 1_700_000_000_000_000_000
S = 1_000_000_000
DELAY = 7_000_000  # from the stamp to when a message is received
Message = tuple[str, str, int, Any]  # topic, type, when it was received [ns], content
STORE = get_typestore(Stores.ROS2_HUMBLE)


def make(kind: str, *values: Any) -> Any:
    return STORE.types[kind](*values)


def header(stamp_ns: int, frame: str) -> Any:
    return make("std_msgs/msg/Header", make("builtin_interfaces/msg/Time", *divmod(stamp_ns, S)), frame)


def image(topic: str, stamp_ns: int, pixels: np.ndarray, encoding: str = "mono8", frame: str = "lens") -> Message:
    height, width = pixels.shape
    content = (height, width, encoding, 0, width, np.ascontiguousarray(pixels).ravel())
    message = make("sensor_msgs/msg/Image", header(stamp_ns, frame), *content)
    return topic, "sensor_msgs/msg/Image", stamp_ns + DELAY, message


def compressed(topic: str, stamp_ns: int, data: bytes) -> Message:
    values = header(stamp_ns, "lens"), "jpeg", np.frombuffer(data, np.uint8)
    return topic, "sensor_msgs/msg/CompressedImage", stamp_ns + DELAY, make("sensor_msgs/msg/CompressedImage", *values)


def camera_info(topic: str, size: tuple[int, int], model: str, D: Sequence[float], K: Sequence[float]) -> Message:
    """K: fx, fy, cx, cy."""
    matrix = np.array([K[0], 0.0, K[2], 0.0, K[1], K[3], 0.0, 0.0, 1.0])
    region = make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    values = size[1], size[0], model, np.array(D, float), matrix, np.eye(3).ravel(), np.zeros(12), 0, 0, region
    kind = "sensor_msgs/msg/CameraInfo"
    return topic, kind, ORIGIN + DELAY, make(kind, header(ORIGIN, "lens"), *values)


def imu_messages(topic: str, imu: ImuStream) -> list[Message]:
    kind, unknown = "sensor_msgs/msg/Imu", np.zeros(9)
    turn = make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    found: list[Message] = []
    for t, w, f in zip(imu.stamps_ns.tolist(), imu.gyro.tolist(), imu.accel.tolist(), strict=True):
        rates, force = (make("geometry_msgs/msg/Vector3", *v) for v in (w, f))
        message = make(kind, header(t, "imu_link"), turn, unknown, rates, unknown, force, unknown)
        found.append((topic, kind, t + DELAY, message))
    return found


def pose(topic: str, stamp_ns: int) -> Message:
    origin = make("geometry_msgs/msg/Point", 0.0, 0.0, 0.0), make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
    message = make("geometry_msgs/msg/PoseStamped", header(stamp_ns, "map"), make("geometry_msgs/msg/Pose", *origin))
    return topic, "geometry_msgs/msg/PoseStamped", stamp_ns + DELAY, message


def text(topic: str, received_ns: int) -> Message:
    return topic, "std_msgs/msg/String", received_ns, make("std_msgs/msg/String", "hello")


def noise_images(topic: str, size: tuple[int, int] = (32, 24), count: int = 50, frame: str = "lens") -> list[Message]:
    rng = np.random.default_rng(len(topic))
    return [
        image(topic, ORIGIN + k * S // 20, rng.integers(0, 256, size[::-1], dtype=np.uint8), frame=frame)
        for k in range(count)
    ]


def write_bag(path: Path, messages: list[Message]) -> Path:
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {(topic, kind) for topic, kind, _, _ in messages}
        connections = {t: writer.add_connection(t, kind, typestore=STORE) for t, kind in sorted(topics)}
        for topic, kind, received_ns, message in sorted(messages, key=lambda m: m[2]):
            writer.write(connections[topic], received_ns, bytes(STORE.serialize_cdr(message, kind)))
    return path


@dataclass(frozen=True)
class Bags:
    """The functions above, for tests are not a package."""

    origin_ns: int = ORIGIN
    image: Callable[..., Message] = image
    compressed: Callable[..., Message] = compressed
    camera_info: Callable[..., Message] = camera_info
    imu: Callable[[str, ImuStream], list[Message]] = imu_messages
    noise: Callable[..., list[Message]] = noise_images
    pose: Callable[[str, int], Message] = pose
    text: Callable[[str, int], Message] = text
    make: Callable[..., Any] = make
    header: Callable[[int, str], Any] = header
    write: Callable[[Path, list[Message]], Path] = write_bag


@pytest.fixture(scope="session")
def bags() -> Bags:
    return Bags()


@pytest.fixture(scope="session")
def waved() -> ImuStream:
    """25 s of an IMU turned about all axes, 200 Hz."""
    imu = simulate(handheld(25.0), 1).measurements.imu
    return replace(not_none(imu), stamps_ns=not_none(imu).stamps_ns - not_none(imu).stamps_ns[0] + ORIGIN)


@pytest.fixture(scope="session")
def brief(waved: ImuStream) -> ImuStream:
    """The first 3 s."""
    return ImuStream("imu0", waved.stamps_ns[:600], waved.gyro[:600], waved.accel[:600])


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("ICALIB_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("COLUMNS", "200")
