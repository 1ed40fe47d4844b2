"""The same small recording in every format is the same streams; what there is, is listed; a sensor finds its topic."""

from __future__ import annotations

import pickle
import shutil
import sqlite3
import tracemalloc
from collections.abc import Generator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.data.bag_recording import bag_files
from icalib.data.measurements import ImuStream
from icalib.data.recordings import BagRecording, Recording, decode, open_recording, read_measurements
from icalib.errors import RecordingError
from icalib.geometry.targets import AprilGrid
from icalib.rig import Camera, ImuSensor, Rig, by_name
from icalib.sensors.camera.read import image_topics
from icalib.sensors.imu.read import checked_imu
from icalib.sensors.imu.read import readings as imu_readings
from icalib.sensors.imu.spec import class_noise

FORMS = [
    "ros1",
    "ros1 bz2",
    "ros1 lz4",
    "ros2 sqlite3",
    "ros2 sqlite3 message",
    "ros2 sqlite3 file",
    "ros2 mcap",
    "ros2 mcap storage",
    "ros2 mcap file",
    "mcap",
    "mcap compressed lz4",
    "mcap compressed zstd",
    "mcap without chunks",
    "mcap without index",
    "mcap of ros1",
    "euroc",
]
IMU = ImuSensor("imu0", "imu0/data.csv", class_noise("consumer"))
CAM0, CAM1 = (Camera(name, f"{name}/corners.csv", "pinhole-radtan", (32, 24)) for name in ("cam0", "cam1"))


def a_camera(name: str, topic: str | None = None) -> Camera:
    return Camera(name, "", "pinhole-radtan", (32, 24), topic=topic)


def complaint(call) -> str:
    with pytest.raises(RecordingError) as error:
        call()
    sentence = str(error.value)
    assert "\n" not in sentence and sentence.endswith(".")
    return sentence


@each("form", FORMS)
def test_streams_are_those_that_were_written(form, tmp_path, truth, write):
    recording = open_recording(write.small(form, tmp_path, truth))
    for camera, step in ((CAM0, 1), (CAM1, -1)):
        frames = list(recording.images(recording.image_topic(camera.name, camera.topic)))
        assert [f.stamp_ns for f in frames] == truth.image_stamps
        for frame, image in zip(frames, truth.images, strict=True):
            assert frame.image.dtype == np.uint8 and frame.image.flags.writeable
            np.testing.assert_array_equal(frame.image, image[::step])
    imu = imu_readings(recording, IMU)
    assert instance(imu, ImuStream).stamps_ns.tolist() == truth.imu_stamps
    np.testing.assert_allclose(imu.gyro, truth.gyro, rtol=1e-15)
    np.testing.assert_allclose(imu.accel, truth.accel, rtol=1e-15)
    assert recording.notes() == ()
    assert checked_imu(instance(imu, ImuStream), recording.where(IMU))[1] == ()


@each("form", FORMS[:-1])
def test_what_is_left_half_read_is_closed_by_any_thread(form, tmp_path, truth, write):
    """Garbage is collected in the thread that happens to make some."""
    recording = open_recording(write.small(form, tmp_path, truth))
    assert isinstance(recording, BagRecording)
    messages = instance(recording.messages(recording.image_topic(CAM0.name, CAM0.topic), "image"), Generator)
    next(messages)
    with ThreadPoolExecutor(1) as pool:
        pool.submit(messages.close).result()


@each("form", FORMS[:-1])
def test_topics_of_a_bag(form, tmp_path, truth, write):
    topics = {t.name: t for t in open_recording(write.small(form, tmp_path, truth)).topics()}
    assert list(topics) == ["/cam0/image_raw", "/cam1/compressed", "/imu0"]
    for name, kind, stamps in [("/cam0/image_raw", "image", truth.image_stamps), ("/imu0", "imu", truth.imu_stamps)]:
        topic = topics[name]
        assert (topic.kind, topic.count) == (kind, len(stamps))
        assert (topic.first_ns, topic.last_ns) == (stamps[0] + write.delay_ns, stamps[-1] + write.delay_ns)
    assert topics["/cam1/compressed"].type == "sensor_msgs/msg/CompressedImage"


def test_topics_of_a_folder(tmp_path, truth, write):
    root = write.euroc(tmp_path, truth)
    (root / "mav0/cam0/corners.csv").write_text("t,id,corner,u,v\n5,0,0,1,2\n5,0,1,1,2\n9,0,0,1,2\n")
    (root / "mav0/leica0").mkdir()
    (root / "mav0/leica0/data.csv").write_text("1,2,3,4\n")
    found = [(t.name, t.kind, t.count, t.first_ns, t.last_ns) for t in open_recording(root).topics()]
    images = ("image", len(truth.images), truth.image_stamps[0], truth.image_stamps[-1])
    readings = ("imu", len(truth.imu_stamps), truth.imu_stamps[0], truth.imu_stamps[-1])
    corners = ("cam0/corners.csv", "corners", 2, 5, 9)
    assert found == [("cam0", *images), corners, ("cam1", *images), ("imu0/data.csv", *readings)]


def test_payloads_decode_elsewhere(tmp_path, truth, write):
    """What goes to another process is small, complete, and becomes the same image there."""
    recording = open_recording(write.small("ros1", tmp_path, truth))
    for topic in image_topics(recording, [CAM0, CAM1]).values():
        payloads = list(recording.payloads(topic))
        assert all((p.width, p.height) == (32, 24) for p in payloads)
        sent = [pickle.loads(pickle.dumps(p)) for p in payloads]
        assert all(len(pickle.dumps(p)) < 2000 for p in payloads)
        for payload, frame in zip(sent, recording.images(topic), strict=True):
            np.testing.assert_array_equal(decode(payload), frame.image)


def test_folder_of_split_bags_is_one_recording(tmp_path, truth, write):
    messages = truth.messages(write.maker())
    for number in (2, 10, 1):
        part = messages[(0, 50, 90)[min(number, 3) - 1] : (50, 90, len(messages))[min(number, 3) - 1]]
        write.mcap(tmp_path / f"run_{number}.mcap", part)
    recording = open_recording(tmp_path)
    assert [p.name for p in recording.files()] == ["run_1.mcap", "run_2.mcap", "run_10.mcap"]
    assert [f.stamp_ns for f in recording.images("/cam0/image_raw")] == truth.image_stamps
    assert instance(imu_readings(recording, IMU), ImuStream).stamps_ns.tolist() == truth.imu_stamps


def test_single_database_and_odd_names(tmp_path, truth, write):
    folder = write.small("ros2 sqlite3", tmp_path, truth)
    odd = (folder / "run.db3").rename(tmp_path / "what? 100%#1.bin")
    assert len(list(open_recording(odd).images("cam0/image_raw"))) == len(truth.images)


def test_database_whose_recorder_crashed(tmp_path, truth, write):
    """What was recorded last is still in the write-ahead log."""
    folder = write.small("ros2 sqlite3", tmp_path / "closed", truth)
    crashed = tmp_path / "crashed"
    with closing(sqlite3.connect(folder / "run.db3")) as database:
        database.execute("PRAGMA journal_mode=WAL")
        database.execute("DELETE FROM messages WHERE id > 100")
        database.commit()
        shutil.copytree(folder, crashed)
    assert (crashed / "run.db3-wal").stat().st_size
    assert sum(t.count for t in open_recording(crashed).topics()) == 100


def test_mav0_itself_may_be_given(tmp_path, truth, write):
    recording = open_recording(write.euroc(tmp_path, truth) / "mav0")
    assert len(list(recording.images(recording.image_topic(CAM1.name, CAM1.topic)))) == len(truth.images)
    assert instance(imu_readings(recording, IMU), ImuStream).stamps_ns.tolist() == truth.imu_stamps


def test_a_folder_of_tables_beside_its_bag_is_tables(tmp_path, truth, write):
    write.euroc(tmp_path, truth)
    write.small("ros1", tmp_path, truth)
    assert not isinstance(open_recording(tmp_path), BagRecording)


@each("form", ["ros1", "ros2", "mcap", "mcap without chunks"])
def test_memory_does_not_grow_with_the_recording(form, tmp_path, write):
    maker = write.maker("ros1" if form == "ros1" else "ros2")
    writer = {"ros1": write.ros1, "ros2": write.ros2}.get(form, write.mcap)
    options = {"use_chunking": False} if "without" in form else {}
    rows = np.random.default_rng(0).integers(0, 256, (256, 512), dtype=np.uint8)
    peaks = []
    for count in (30, 120):
        messages = [
            ("/cam", "sensor_msgs/msg/Image", k + 1, maker.image(k + 1, np.roll(rows, k))) for k in range(count)
        ]
        recording = open_recording(writer(tmp_path / f"run{count}", messages, **options))
        next(recording.images("/cam"))  # what is imported and cached on first use does not count
        tracemalloc.start()
        assert sum(1 for _ in recording.images("/cam")) == count
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]
    assert peaks[1] < 30 * rows.size  # less than the shorter recording holds


class TestChoice:
    def bag(self, folder: Path, write, topics: list[str], kind: str = "image") -> Recording:
        make = write.maker()
        rows = np.arange(64, dtype=np.uint8).reshape(8, 8)
        if kind == "image":
            messages = [(t, "sensor_msgs/msg/Image", 5, make.image(5, rows)) for t in topics]
        else:
            messages = [(t, "sensor_msgs/msg/Imu", 5, make.imu(5, np.ones(3), np.ones(3))) for t in topics]
        return open_recording(write.mcap(folder / "run.mcap", messages))

    def test_the_one_given_with_or_without_slash(self, tmp_path, write):
        bag = self.bag(tmp_path, write, ["/left", "/right"])
        assert bag.image_topic("cam0", "/right") == "/right"
        assert bag.image_topic("cam0", "right") == "/right"

    def test_the_one_with_the_name(self, tmp_path, write):
        bag = self.bag(tmp_path, write, ["/robot/cam0/image", "/robot/cam1/image", "/cam01"])
        assert bag.image_topic("cam1", None) == "/robot/cam1/image"

    def test_the_only_one(self, tmp_path, write):
        assert self.bag(tmp_path, write, ["/camera/image"]).image_topic("cam0", None) == "/camera/image"

    def test_several(self, tmp_path, write):
        bag = self.bag(tmp_path, write, ["/left", "/right"])
        sentence = complaint(lambda: bag.image_topic("cam0", None))
        assert "cam0 may be any of /left, /right; set `topic` of cam0 in the rig file" in sentence

    def test_none(self, tmp_path, write):
        bag = self.bag(tmp_path, write, ["/left"])
        assert "run.mcap has no imu for imu0; it holds /left (sensor_msgs/msg/Image)" in complaint(
            lambda: imu_readings(bag, IMU)
        )

    def test_missing(self, tmp_path, write):
        bag = self.bag(tmp_path, write, ["/left"])
        for ask in (lambda: bag.image_topic("c", "/lefft"), lambda: list(bag.images("/lefft"))):
            assert "has no topic /lefft; it holds /left (sensor_msgs/msg/Image)" in complaint(ask)

    def test_missing_in_a_folder(self, tmp_path, truth, write):
        folder = open_recording(write.euroc(tmp_path, truth))
        assert "has no topic cam7; it holds cam0 (images), cam1" in complaint(lambda: list(folder.images("cam7")))

    def test_of_another_kind(self, tmp_path, write):
        bag = self.bag(tmp_path, write, ["/imu"], "imu")
        sentence = complaint(lambda: bag.image_topic("c", "/imu"))
        assert "/imu is sensor_msgs/msg/Imu, not image" in sentence

    def test_two_cameras_would_share(self, tmp_path, write):
        bag = self.bag(tmp_path, write, ["/cam0/image"])
        sentence = complaint(lambda: image_topics(bag, [CAM0, CAM1]))
        assert "cam1 and cam0 both match /cam0/image; set `topic`" in sentence

    def test_corners_are_detected_in_images_of_a_bag(self, tmp_path, write):
        messages = [("/cam0/image", "sensor_msgs/msg/Image", 5, write.maker().image(5, np.ones((8, 8), np.uint8)))]
        maker = write.maker()
        rng = np.random.default_rng(0)
        for k in range(20):
            imu = maker.imu(k * 5_000_000 + 1, rng.normal(size=3), rng.normal(size=3) + [0, 0, 9.8])
            messages.append(("/imu", "sensor_msgs/msg/Imu", k, imu))
        bag = open_recording(write.mcap(tmp_path / "run.mcap", messages))
        rig = Rig(by_name(IMU, CAM0), AprilGrid(6, 6, 0.088, 0.3))
        sentence = complaint(lambda: read_measurements(bag, rig))
        assert "run.mcap /cam0/image: images have 8 x 8 px, but cam0" in sentence


def test_numbers_in_names_are_numbers(tmp_path):
    for name in ("run_10.db3", "run_9.db3", "run_9.txt"):
        (tmp_path / name).touch()
    assert [p.name for p in bag_files(tmp_path)] == ["run_9.db3", "run_10.db3"]
