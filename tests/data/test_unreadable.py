"""Raw packets of LiDARs, videos and pointers of Git LFS: named wherever they are met, with what to do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from tests.cases import each
from tests.typed import instance

from icalib.data.measurements import ImuStream
from icalib.data.messages import type_not_read
from icalib.data.recordings import open_recording
from icalib.errors import RecordingError
from icalib.rig import Camera, ImuSensor, Lidar
from icalib.sensors.camera.read import has_corners
from icalib.sensors.imu.read import readings as imu_readings
from icalib.sensors.imu.spec import class_noise
from icalib.sensors.lidar.read import scans
from icalib.tools.inspection import inspect_recording

POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a2146\nsize 12345\n"
ANNEX = b"/annex/objects/MD5E-s1234--5d4140.bag\n"
MP4 = b"\0\0\0\x20ftypisom" + bytes(100)
LIDAR, IMU = Lidar("lidar0", "lidar0/scans.npz"), ImuSensor("imu0", "imu0/data.csv", class_noise("consumer"))
CAMERA = Camera("cam0", "cam0/corners.csv", "pinhole-radtan", (64, 48))
PACKETS = (
    "velodyne_msgs/VelodyneScan",
    "velodyne_msgs/msg/VelodynePacket",
    "ouster_ros/PacketMsg",
    "ouster_sensor_msgs/msg/PacketMsg",
    "hesai_ros_driver/msg/UdpFrame",
    "hesai_lidar/PandarScan",
    "pandar_msgs/msg/PandarScan",
    "rslidar_msgs/rslidarScan",
    "rslidar_msg/msg/RslidarPacket",
    "nebula_msgs/msg/NebulaPackets",
    "lslidar_msgs/msg/LslidarScan",
    "robosense_msgs/msg/RobosenseScan",
)
VIDEOS = (
    "foxglove_msgs/msg/CompressedVideo",
    "ffmpeg_image_transport_msgs/msg/FFMPEGPacket",
    "theora_image_transport/Packet",
)


def complaint(call) -> str:
    with pytest.raises(RecordingError) as error:
        call()
    sentence = str(error.value)
    assert "\n" not in sentence and sentence.endswith(".")
    return sentence


def bag_of(folder: Path, topic: str, kind: str) -> Path:
    """Ten messages of bytes of a type that ROS does not define."""
    path = folder / "run.mcap"
    writer = McapWriter(str(path))
    writer.start()
    channel = writer.register_channel(topic, "cdr", writer.register_schema(kind, "ros2msg", b"uint8[] data"))
    for k in range(10):
        writer.add_message(channel, k * 10**8, bytes(range(50)), k * 10**8)
    writer.finish()
    return path


@each("kind", PACKETS)
def test_packets_of_a_lidar(tmp_path, kind):
    path = bag_of(tmp_path, "/lidar/packets", kind)
    words = (
        "raw packets of a LiDAR; replay the recording with the LiDAR's driver, and record the sensor_msgs/PointCloud2"
    )
    bag = open_recording(path)
    assert f"run.mcap has no points for lidar0: /lidar/packets ({bag.topics()[0].type}) holds {words}" in complaint(
        lambda: scans(bag, LIDAR)
    )
    given = Lidar("lidar0", "", topic="/lidar/packets")
    assert f"has no points in /lidar/packets: /lidar/packets ({bag.topics()[0].type}) holds {words}" in complaint(
        lambda: scans(bag, given)
    )
    assert any(f"/lidar/packets holds {words}" in f.sentence for f in inspect_recording(path).findings)
    assert "raw packets" not in complaint(lambda: imu_readings(bag, IMU))


@pytest.mark.parametrize("kind", ["sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan"])
def test_scans_of_one_plane(tmp_path, kind):
    bag = open_recording(bag_of(tmp_path, "/scan", kind))
    words = f"no points for lidar0: /scan ({kind}) holds scans of one plane, and icalib needs a 3D LiDAR's"
    assert words in complaint(lambda: scans(bag, LIDAR))
    assert "nav_msgs/Odometry as a sensor of type: pose, kind: relative." in complaint(lambda: scans(bag, LIDAR))


@each("kind", VIDEOS)
def test_compressed_video(tmp_path, kind):
    path = bag_of(tmp_path, "/cam/video", kind)
    bag = open_recording(path)
    assert "holds compressed video; decode it by its image transport, and record sensor_msgs/Image" in complaint(
        lambda: bag.image_topic(CAMERA.name, CAMERA.topic)
    )
    assert any("/cam/video holds compressed video" in f.sentence for f in inspect_recording(path).findings)


@each("kind", ["sensor_msgs/msg/Range", "diagnostic_msgs/msg/Packet", "nav_msgs/msg/Path"])
def test_other_types_are_none_of_these(kind):
    assert type_not_read(kind) is None


@each(
    ("content", "words"),
    [
        (POINTER, "run `git lfs pull`"),
        (ANNEX, "run `git annex get`"),
        (MP4, "is a video; give the folder that it lies"),
    ],
)
@each("name", ["a.bag", "a.mcap", "clip.mp4", "folder/a.db3"])
def test_a_file_that_is_none(tmp_path, content, words, name):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(content)
    opened = path.parent if name.startswith("folder") else path
    sentence = complaint(lambda: open_recording(opened))
    assert words in sentence and str(path) in sentence
    assert words in complaint(lambda: inspect_recording(opened))


def test_tables_and_scans_that_are_pointers(tmp_path):
    for name in ("imu0/data.csv", "lidar0/scans.npz"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_bytes(POINTER)
    folder = open_recording(tmp_path)
    for read in (lambda: imu_readings(folder, IMU), lambda: scans(folder, LIDAR)):
        assert "is a pointer to a file that was not downloaded; run `git lfs pull`" in complaint(read)


def test_images_that_are_pointers(tmp_path, write, truth):
    """All of them, or some that were not fetched."""
    root = write.euroc(tmp_path / "euroc", truth)
    images = sorted((root / "mav0/cam0/data").glob("*.png"))
    images[3].write_bytes(POINTER)
    folder = open_recording(root)
    assert len(list(folder.images("cam0"))) == len(images) - 1
    assert "1 of 12 images cannot be read, the first: " in folder.notes()[0] and "git lfs pull" in folder.notes()[0]
    for image in images:
        image.write_bytes(POINTER)
    assert "is a pointer to a file that was not downloaded" in complaint(
        lambda: list(open_recording(root).images("cam0"))
    )
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    (pictures / "0001.png").write_bytes(POINTER)
    assert "run `git lfs pull`" in complaint(lambda: list(open_recording(pictures).images(".")))


def test_a_video_beside_tables(tmp_path, write, truth):
    root = write.euroc(tmp_path / "euroc", truth)
    for folder in ("cam0", "cam1"):
        for image in (root / "mav0" / folder / "data").iterdir():
            image.unlink()
    (root / "mav0" / "cam0.MP4").write_bytes(MP4)
    recording = open_recording(root)
    assert not has_corners(recording, CAMERA)
    assert recording.image_topic(CAMERA.name, CAMERA.topic) == "mav0/cam0.MP4"
    words = "mav0/cam0.MP4 cannot be decoded as a video"
    assert words in complaint(lambda: list(recording.payloads("mav0/cam0.MP4")))
    assert any(words in f.sentence for f in inspect_recording(root).findings)


def test_numbers_are_no_pointers(tmp_path):
    (tmp_path / "imu0").mkdir()
    rows = np.hstack([1e6 * np.arange(20)[:, None], np.random.default_rng(1).normal(size=(20, 6))])
    np.savetxt(tmp_path / "imu0" / "data.csv", rows, delimiter=",", fmt=["%d"] + ["%.6f"] * 6)
    assert len(instance(imu_readings(open_recording(tmp_path), IMU), ImuStream).stamps_ns) == 20
