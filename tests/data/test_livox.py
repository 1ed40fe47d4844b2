"""Livox's own message, as rosbags packs it from its definition."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from tests.cases import each

from icalib.data.recordings import BagRecording
from icalib.errors import RecordingError
from icalib.rig import Lidar
from icalib.sensors.lidar.read import scans

CLOUD = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\nCustomPoint[] points\n"
)
POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
ORIGIN, SCANS, N = 1_700_000_000_123_456_789, 9, 7
RNG = np.random.default_rng(4)
XYZ, SINCE = RNG.uniform(1, 9, (SCANS, N, 3)).astype(np.float32), np.arange(N) * 14_000_001


def bag_of(path: Path, package: str, form: str, frame: str, cut: int = 0) -> BagRecording:
    """A message every 100 ms; `cut` bytes are missing at the end of each."""
    store = get_typestore(Stores.ROS1_NOETIC if form == "ros1" else Stores.ROS2_HUMBLE)
    kinds = get_types_from_msg(POINT, f"{package}/msg/CustomPoint")
    store.register(kinds | get_types_from_msg(CLOUD, f"{package}/msg/CustomMsg"))
    kind, t = f"{package}/msg/CustomMsg", store.types
    writer = Ros1Writer(path) if form == "ros1" else Ros2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    serialise = store.serialize_ros1 if form == "ros1" else store.serialize_cdr
    with writer:
        connection = writer.add_connection("/livox/lidar", kind, typestore=store)
        for k in range(SCANS):
            stamp_ns = ORIGIN + k * 100_000_000
            stamp = t["builtin_interfaces/msg/Time"](*divmod(stamp_ns, 10**9))
            header = t["std_msgs/msg/Header"](*([k] if form == "ros1" else []), stamp, frame)
            rows = zip(SINCE.tolist(), XYZ[k].tolist(), strict=True)
            points: Any = [t[f"{package}/msg/CustomPoint"](since, *xyz, 100 + k, 16, 3) for since, xyz in rows]
            message = t[kind](header, stamp_ns, N, 1, np.array([1, 2, 3], np.uint8), points)
            content = bytes(serialise(message, kind))
            writer.write(connection, stamp_ns + 10, content[: len(content) - cut])
    return BagRecording(path)


@each("package", ["livox_ros_driver", "livox_ros_driver2"])
@each("form", ["ros1", "ros2"])
@each("frame", ["", "f", "livox_frame", "livox_frames"])
def test_points_and_their_times(tmp_path, package, form, frame):
    bag = bag_of(tmp_path / "run.bag", package, form, frame)
    assert [(t.kind, t.count) for t in bag.topics()] == [("points", SCANS)]
    stream = scans(bag, Lidar("lidar0", ""))
    assert stream.stamps_ns.tolist() == [ORIGIN + k * 100_000_000 for k in range(SCANS)]
    np.testing.assert_array_equal(stream.xyz, XYZ.reshape(-1, 3))
    np.testing.assert_allclose(stream.offset_s, np.tile(SINCE * 1e-9, SCANS), atol=1e-8)
    assert bag.notes() == ()


@each("form", ["ros1", "ros2"])
@each("cut", [1, 25, 150])
def test_a_message_that_is_cut_off(tmp_path, form, cut):
    bag = bag_of(tmp_path / "run.bag", "livox_ros_driver2", form, "f", cut)
    with pytest.raises(RecordingError, match=f"/livox/lidar: the message received at {ORIGIN + 10} ns is damaged"):
        scans(bag, Lidar("lidar0", ""))
