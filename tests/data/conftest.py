"""One small recording, written by other people's programs (rosbags, mcap), and as EuRoC's folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ORIGIN = 1_404_733_405_732_800_001
IMAGE_STEP, IMU_STEP, DELAY = 50_000_000, 5_000_000, 7_000_000  # DELAY: from the stamp to when it is received
IMAGES, READINGS, SHAPE = 12, 120, (24, 32)

GPS_STATUS = """std_msgs/Header header
uint16 satellites_used
int32[] satellite_used_prn
uint16 satellites_visible
int32[] satellite_visible_prn
int32[] satellite_visible_z
int32[] satellite_visible_azimuth
int32[] satellite_visible_snr
int16 status
uint16 motion_source
uint16 orientation_source
uint16 position_source
"""
GPS_FIX = "std_msgs/Header header\nGPSStatus status\n" + "".join(
    f"float64 {name}\n"
    for name in (
        "latitude", "longitude", "altitude", "track", "speed", "climb", "pitch", "roll", "dip", "time", "gdop", "pdop",
        "hdop", "vdop", "tdop", "err", "err_horz", "err_vert", "err_track", "err_speed", "err_climb", "err_time",
        "err_pitch", "err_roll", "err_dip",
    )
) + "float64[9] position_covariance\nuint8 position_covariance_type\n"  # fmt: skip
PVT_CLOCK = "uint32 itow\nuint16 year\nuint8 month\nuint8 day\nuint8 hour\nuint8 min\nuint8 sec\n"
PVT_PLACE = "".join(
    f"{kind} {name}\n"
    for kind, names in (
        ("int32", ("lon", "lat", "height", "h_msl")), ("uint32", ("h_acc", "v_acc")),
        ("int32", ("vel_n", "vel_e", "vel_d", "g_speed", "heading")), ("uint32", ("s_acc", "head_acc")),
        ("uint16", ("p_dop",)),
    )
    for name in names
)  # fmt: skip
PVT_END = "int32 head_veh\nint16 mag_dec\nuint16 mag_acc\n"
UBX = "ublox_ubx_msgs/msg"
# Messages of receivers as their packages define them, with nested messages.
RECEIVERS = {
    **{f"{package}/msg/GPSStatus": GPS_STATUS for package in ("gps_common", "gps_msgs")},
    **{f"{package}/msg/GPSFix": GPS_FIX for package in ("gps_common", "gps_msgs")},
    "nmea_msgs/msg/Sentence": "std_msgs/Header header\nstring sentence\n",
    "ublox_msgs/msg/NavPVT": f"{PVT_CLOCK}uint8 valid\nuint32 t_acc\nint32 nano\nuint8 fix_type\nuint8 flags\n"
    f"uint8 flags2\nuint8 num_sv\n{PVT_PLACE}uint8[6] reserved1\n{PVT_END}",
    f"{UBX}/GpsFix": "uint8 fix_type\n",
    f"{UBX}/PSMPVT": "uint8 state\n",
    f"{UBX}/CarrSoln": "uint8 status\n",
    f"{UBX}/UBXNavPVT": f"std_msgs/Header header\n{PVT_CLOCK}bool valid_date\nbool valid_time\nbool fully_resolved\n"
    "bool valid_mag\nuint32 t_acc\nint32 nano\nGpsFix gps_fix\nbool gnss_fix_ok\nbool diff_soln\nPSMPVT psm\n"
    "bool head_veh_valid\nCarrSoln carr_soln\nbool confirmed_avail\nbool confirmed_date\nbool confirmed_time\n"
    f"uint8 num_sv\n{PVT_PLACE}bool invalid_llh\n{PVT_END}",
}
Store = Literal["ros1", "ros2"]
Message = tuple[str, str, int, Any]  # topic, type, when it was received [ns], content


@dataclass(frozen=True)
class Maker:
    """Messages of ROS 1 or ROS 2 with the fields given."""

    kind: Store = "ros2"
    store: Any = field(init=False)

    def __post_init__(self) -> None:
        store = get_typestore(Stores.ROS1_NOETIC if self.kind == "ros1" else Stores.ROS2_HUMBLE)
        if self.kind == "ros1":  # of which rosbags has none
            for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
                store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", name))
        for name, fields in RECEIVERS.items():
            store.register(get_types_from_msg(fields, name))
        object.__setattr__(self, "store", store)

    def make(self, type_name: str, *values: Any) -> Any:
        return self.store.types[type_name](*values)

    def header(self, stamp_ns: int, frame: str = "f") -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000))
        return self.make("std_msgs/msg/Header", *([0] if self.kind == "ros1" else []), stamp, frame)

    def image(self, stamp_ns: int, data: np.ndarray, encoding: str = "mono8", **others: int) -> Any:
        """`data` (height, step) uint8; width defaults to step."""
        width = others.get("width", data.shape[1])
        values = (encoding, others.get("big_endian", 0), data.shape[1], np.ascontiguousarray(data).ravel())
        return self.make("sensor_msgs/msg/Image", self.header(stamp_ns), data.shape[0], width, *values)

    def compressed(self, stamp_ns: int, data: bytes, described: str) -> Any:
        values = (self.header(stamp_ns), described, np.frombuffer(data, np.uint8))
        return self.make("sensor_msgs/msg/CompressedImage", *values)

    def imu(self, stamp_ns: int, gyro: np.ndarray, accel: np.ndarray) -> Any:
        unknown, turn = np.zeros(9), self.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
        w, f = (self.vector(v) for v in (gyro, accel))
        return self.make("sensor_msgs/msg/Imu", self.header(stamp_ns), turn, unknown, w, unknown, f, unknown)

    def vector(self, v: Iterable[float], kind: str = "Vector3") -> Any:
        return self.make(f"geometry_msgs/msg/{kind}", *(float(x) for x in v))

    def serialise(self, type_name: str, message: Any) -> bytes:
        write = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        return bytes(write(message, type_name))


@dataclass(frozen=True)
class Truth:
    """What the small recording holds: two cameras and an IMU."""

    image_stamps: list[int]
    images: list[np.ndarray]  # of cam0; cam1 has them upside down
    imu_stamps: list[int]
    gyro: np.ndarray
    accel: np.ndarray

    def messages(self, maker: Maker) -> list[Message]:
        found: list[Message] = []
        for t, image in zip(self.image_stamps, self.images, strict=True):
            png = cv2.imencode(".png", image[::-1])[1].tobytes()
            found.append(("/cam0/image_raw", "sensor_msgs/msg/Image", t + DELAY, maker.image(t, image)))
            compressed = maker.compressed(t, png, "mono8; png compressed mono8")
            found.append(("/cam1/compressed", "sensor_msgs/msg/CompressedImage", t + DELAY, compressed))
        for t, w, f in zip(self.imu_stamps, self.gyro, self.accel, strict=True):
            found.append(("/imu0", "sensor_msgs/msg/Imu", t + DELAY, maker.imu(t, w, f)))
        return sorted(found, key=lambda m: m[2])


@pytest.fixture(scope="session")
def truth() -> Truth:
    rng = np.random.default_rng(3)
    images = [rng.integers(0, 256, SHAPE, dtype=np.uint8) for _ in range(IMAGES)]
    gyro, accel = rng.normal(size=(READINGS, 3)), rng.normal(size=(READINGS, 3)) + [0, 0, 9.81]
    image_stamps = [ORIGIN + k * IMAGE_STEP for k in range(IMAGES)]
    return Truth(image_stamps, images, [ORIGIN + k * IMU_STEP for k in range(READINGS)], gyro, accel)


def write_ros1(path: Path, messages: list[Message], compression: str = "") -> Path:
    """A ROS 1 bag of many chunks."""
    maker = Maker("ros1")
    writer = Ros1Writer(path)
    writer.chunk_threshold = 4096
    if compression:
        writer.set_compression(Ros1Writer.CompressionFormat[compression.upper()])
    _write(writer, maker, messages)
    return path


def write_ros2(path: Path, messages: list[Message], plugin: str = "SQLITE3", mode: str = "") -> Path:
    """A folder as ROS 2 records it."""
    maker = Maker()
    writer = Ros2Writer(path, version=9, storage_plugin=StoragePlugin[plugin])
    if mode:
        writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    _write(writer, maker, messages)
    return path


def _write(writer: Any, maker: Maker, messages: list[Message]) -> None:
    with writer:
        topics = {(topic, kind) for topic, kind, _, _ in messages}
        connections = {t: writer.add_connection(t, kind, typestore=maker.store) for t, kind in sorted(topics)}
        for topic, kind, received_ns, message in messages:
            writer.write(connections[topic], received_ns, maker.serialise(kind, message))


def write_mcap(path: Path, messages: list[Message], kind: Store = "ros2", **options: Any) -> Path:
    """A single file, by the package mcap."""
    maker = Maker(kind)
    options = {"chunk_size": 4096, "compression": CompressionType.NONE} | options
    writer = McapWriter(str(path), **options)
    writer.start()
    channels: dict[str, int] = {}
    for topic, type_name, received_ns, message in messages:
        if topic not in channels:
            text, _ = maker.store.generate_msgdef(type_name, ros_version=2 if kind == "ros2" else 1)
            shown = type_name if kind == "ros2" else type_name.replace("/msg/", "/")
            schema = writer.register_schema(shown, f"{kind}msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr" if kind == "ros2" else "ros1", schema)
        writer.add_message(channels[topic], received_ns, maker.serialise(type_name, message), received_ns)
    writer.finish()
    return path


def write_euroc(root: Path, truth: Truth) -> Path:
    for name, step in (("cam0", 1), ("cam1", -1)):
        data = root / "mav0" / name / "data"
        data.mkdir(parents=True)
        lines = ["#timestamp [ns],filename"]
        for t, image in zip(truth.image_stamps, truth.images, strict=True):
            cv2.imwrite(str(data / f"{t}.png"), image[::step])
            lines.append(f"{t},{t}.png")
        (data.parent / "data.csv").write_text("\r\n".join(lines) + "\r\n")
    imu = root / "mav0/imu0/data.csv"
    imu.parent.mkdir()
    readings = zip(truth.imu_stamps, truth.gyro.tolist(), truth.accel.tolist(), strict=True)
    imu.write_text(
        "#timestamp [ns],wx,wy,wz,ax,ay,az\n" + "".join(f"{t},{_join(w)},{_join(f)}\n" for t, w, f in readings)
    )
    return root


def _join(values: list[float]) -> str:
    return ",".join(repr(v) for v in values)


@dataclass(frozen=True)
class Writers:
    """The writers above, for tests."""

    maker: type[Maker] = Maker
    ros1: Callable[..., Path] = write_ros1
    ros2: Callable[..., Path] = write_ros2
    mcap: Callable[..., Path] = write_mcap
    euroc: Callable[..., Path] = write_euroc
    delay_ns: int = DELAY
    compression: type[CompressionType] = CompressionType

    def small(self, form: str, folder: Path, truth: Truth) -> Path:
        """The small recording in one of FORMS."""
        ros1, ros2 = Maker("ros1"), Maker()
        if form == "euroc":
            return self.euroc(folder / "euroc", truth)
        if form.startswith("ros1"):
            return self.ros1(folder / "run.bag", truth.messages(ros1), form.removeprefix("ros1").strip())
        if form.startswith("ros2"):
            _, plugin, mode = f"{form} ".split(" ", 2)
            return self.ros2(folder / "run", truth.messages(ros2), plugin.upper(), mode.strip().upper())
        options: dict[str, Any] = {"kind": "ros1"} if "of ros1" in form else {}
        if "compressed" in form:
            options["compression"] = CompressionType[form.split()[-1].upper()]
        if "without chunks" in form:
            options["use_chunking"] = False
        if "without index" in form:
            options |= {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False}
        messages = truth.messages(ros1 if "of ros1" in form else ros2)
        return self.mcap(folder / "run.mcap", messages, **options)


@pytest.fixture(scope="session")
def write() -> Writers:
    return Writers()
