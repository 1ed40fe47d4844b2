"""Writers of simulated recordings: messages in bags, and tables.

Writes messages of sensors to bags, by rosbags (extra `bags`). Writes CSV tables.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np

from icalib.base.extras import install
from icalib.errors import CalibrationError

BagForm = Literal["ros1", "mcap", "sqlite3"]
IMU_TOPIC = "/imu0"
IMAGE, IMU = "sensor_msgs/msg/Image", "sensor_msgs/msg/Imu"


class BagWriter:
    """A bag that is being written. topics: message type by topic; `imu`, `image` and `make` create messages."""

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

    def __enter__(self) -> Self:
        self._writer.__enter__()
        for topic, kind in self._topics.items():
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        return self

    def __exit__(self, *error: Any) -> None:
        self._writer.__exit__(*error)

    def write(self, topic: str, message: Any, received_ns: int) -> None:
        """Writes a message; received_ns: instant of reception on the IMU's clock [ns]."""
        serialise = self._store.serialize_ros1 if self._ros1 else self._store.serialize_cdr
        self._writer.write(self._connections[topic], received_ns, serialise(message, self._topics[topic]))

    def image(self, stamp_ns: int, frame: str, pixels: np.ndarray) -> Any:
        """Image message in mono8; pixels (H, W) uint8."""
        height, width = pixels.shape
        return self.make(IMAGE, self.header(stamp_ns, frame), height, width, "mono8", 0, width, pixels.ravel())

    def imu(self, stamp_ns: int, values: list[float], name: str = "imu0") -> Any:
        """Imu message; values (6): gyro [rad/s], accel [m/s^2]. Orientation and covariances are left unknown."""
        unknown, turn = np.zeros(9), self.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        w, f = (self.make("geometry_msgs/msg/Vector3", *v) for v in (values[:3], values[3:]))
        return self.make(IMU, self.header(stamp_ns, name), turn, unknown, w, unknown, f, unknown)

    def header(self, stamp_ns: int, frame: str) -> Any:
        """Header of a message, with stamp and frame id."""
        stamp = self.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000))
        return self.make("std_msgs/msg/Header", *([0] if self._ros1 else []), stamp, frame)

    def make(self, kind: str, *values: Any) -> Any:
        """A message of type `kind`; values: its fields, in the order of the definition."""
        return self._store.types[kind](*values)


def package(name: str, extra: str) -> Any:
    """Imports an optional module needed for writing. Raises CalibrationError if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        raise CalibrationError(
            f"writing recordings needs {name}, which is not installed; run {install(extra)}."
        ) from None


def write_table(path: Path, header: str, *columns: np.ndarray) -> None:
    """Writes a CSV file with all digits of its numbers. columns: arrays (N,) or (N, k)."""
    lists = [c.tolist() for column in columns for c in (column.T if column.ndim == 2 else [column])]
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8") as file:
        file.write(f"#{header}\n")
        file.writelines(",".join(map(repr, row)) + "\n" for row in zip(*lists, strict=True))
