"""Messages of the sensors, and the bags that hold them, by rosbags (extra `bags`)."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np

from icalib.base.extras import install
from icalib.errors import CalibrationError

BagForm = Literal["ros1", "mcap", "sqlite3"]
IMU_TOPIC = "/imu0"
IMAGE, IMU, POINTS, JOINTS = (f"sensor_msgs/msg/{kind}" for kind in ("Image", "Imu", "PointCloud2", "JointState"))
TWIST = "geometry_msgs/msg/TwistStamped"
POSE = "geometry_msgs/msg/PoseStamped"
_FLOAT32 = 7  # of PointField


class BagWriter:
    """A bag that is being written. topics: the type of each. `imu`, `image`, ... make messages."""

    def __init__(self, form: BagForm, path: Path, topics: dict[str, str]) -> None:
        typesys = package("rosbags.typesys", "bags")
        self._ros1 = form == "ros1"
        stores = typesys.Stores
        self._store: Any = typesys.get_typestore(stores.ROS1_NOETIC if self._ros1 else stores.ROS2_HUMBLE)
        if self._ros1:
            self._writer = package("rosbags.rosbag1", "bags").Writer(path)
        else:
            rosbag2 = package("rosbags.rosbag2", "bags")
            plugin = rosbag2.StoragePlugin[form.upper()]
            self._writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
        self._topics = topics
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        self._writer.__enter__()
        for topic, kind in self._topics.items():
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._writer.__exit__(kind, error, trace)

    def write(self, topic: str, message: Any, received_ns: int) -> None:
        """received_ns: when the recorder received it, on the IMU's clock."""
        serialise = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        self._writer.write(self._connections[topic], received_ns, serialise(message, self._topics[topic]))

    def image(self, stamp_ns: int, frame: str, pixels: np.ndarray) -> Any:
        """pixels (H, W) uint8, as mono8."""
        height, width = pixels.shape
        return self._make(IMAGE, self._header(stamp_ns, frame), height, width, "mono8", 0, width, pixels.ravel())

    def imu(self, stamp_ns: int, values: list[float]) -> Any:
        """values: gyro, then accel; the orientation is not known."""
        unknown, turn = np.zeros(9), self._make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        w, f = (self._make("geometry_msgs/msg/Vector3", *v) for v in (values[:3], values[3:]))
        return self._make(IMU, self._header(stamp_ns, "imu0"), turn, unknown, w, unknown, f, unknown)

    def points(self, stamp_ns: int, frame: str, xyz: np.ndarray, offset_s: np.ndarray) -> Any:
        """xyz (N, 3) [m] and `time` (N,) [s] from the stamp, float32 each."""
        names = ("x", "y", "z", "time")
        fields = [self._make("sensor_msgs/msg/PointField", name, 4 * i, _FLOAT32, 1) for i, name in enumerate(names)]
        rows = np.ascontiguousarray(np.column_stack([xyz, offset_s]), dtype="<f4")
        data, size = rows.view(np.uint8).reshape(-1), 4 * len(names)
        header = self._header(stamp_ns, frame)
        return self._make(POINTS, header, 1, len(rows), fields, False, size, size * len(rows), data, True)

    def joints(self, stamp_ns: int, frame: str, names: list[str], position: np.ndarray, velocity: np.ndarray) -> Any:
        """position [rad] and velocity [rad/s] of each name, or empty."""
        return self._make(JOINTS, self._header(stamp_ns, frame), names, position, velocity, np.empty(0))

    def twist(self, stamp_ns: int, frame: str, speed: float, yaw_rate: float) -> Any:
        """Forward speed [m/s] and yaw rate [rad/s]."""
        ahead = self._make("geometry_msgs/msg/Vector3", speed, 0.0, 0.0)
        twist = self._make(
            "geometry_msgs/msg/Twist", ahead, self._make("geometry_msgs/msg/Vector3", 0.0, 0.0, yaw_rate)
        )
        return self._make(TWIST, self._header(stamp_ns, frame), twist)

    def pose(self, stamp_ns: int, frame: str, position: np.ndarray, xyzw: np.ndarray) -> Any:
        """position (3,) [m] and quaternion (4,) of a sensor in `frame`."""
        point = self._make("geometry_msgs/msg/Point", *position.tolist())
        turn = self._make("geometry_msgs/msg/Quaternion", *xyzw.tolist())
        pose = self._make("geometry_msgs/msg/Pose", point, turn)
        return self._make(POSE, self._header(stamp_ns, frame), pose)

    def _header(self, stamp_ns: int, frame: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000))
        return self._make("std_msgs/msg/Header", *([0] if self._ros1 else []), stamp, frame)

    def _make(self, kind: str, *values: Any) -> Any:
        return self._store.types[kind](*values)


def package(name: str, extra: str) -> Any:
    """A module that only writing needs. Raises CalibrationError where it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise CalibrationError(
            f"writing recordings needs {name}, which is not installed; run {install(extra)}."
        ) from None
