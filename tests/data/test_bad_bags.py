"""Bags that are cut off, damaged, of other types, or of cameras and clocks that failed."""

from __future__ import annotations

import sys
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest
from tests.cases import each
from tests.remarks import named, names
from tests.typed import instance

from icalib.data.bags import Ros1Storage
from icalib.data.measurements import ImuStream
from icalib.data.recordings import Recording, open_recording
from icalib.errors import RecordingError
from icalib.rig import ImuSensor
from icalib.sensors.imu.read import checked_imu
from icalib.sensors.imu.read import readings as imu_readings
from icalib.sensors.imu.spec import class_noise

IMU = ImuSensor("imu0", "imu0/data.csv", class_noise("consumer"))
S = 1_000_000_000
STEP = 50_000_000
T = [1_700 * S + k * STEP for k in range(8)]
CUTTABLE = [
    "ros1",
    "ros1 bz2",
    "ros1 lz4",
    "ros2 sqlite3",
    "ros2 mcap",
    "mcap",
    "mcap compressed lz4",
    "mcap compressed zstd",
    "mcap without chunks",
    "mcap without index",
]


def complaint(call) -> str:
    with pytest.raises(RecordingError) as error:
        call()
    sentence = str(error.value)
    assert "\n" not in sentence and sentence.endswith(".")
    return sentence


def bag_file(path: Path) -> Path:
    """The file itself of a folder that ROS 2 recorded."""
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".db3", ".mcap"))


class TestCutOff:
    @each("form", CUTTABLE)
    def test_what_is_readable_is_used_and_a_note_says_how_much(self, form, tmp_path, truth, write):
        path = bag_file(write.small(form, tmp_path, truth))
        whole = path.read_bytes()
        read_at: list[int] = []
        for size in np.linspace(1, len(whole) - 1, 97 if "sqlite" in form else 24).astype(int):
            path.write_bytes(whole[:size])
            try:
                recording = open_recording(path)
                read_at.append(self.check_beginning(recording, truth))
            except RecordingError as error:
                assert path.name in str(error)
                read_at.append(0)
        assert read_at == sorted(read_at)
        assert read_at[len(read_at) // 2] > 0 and read_at[-2] > 100  # of 132 messages

    def check_beginning(self, recording: Recording, truth) -> int:
        """All that is read is what was written, from the beginning; returns how many messages."""
        assert "bag_truncated" in names(recording.notes())
        images = readings = 0
        kinds = {t.kind for t in recording.topics() if t.count}
        if any(t.name.startswith("/cam0") and t.count for t in recording.topics()):
            frames = list(recording.images("/cam0/image_raw"))
            images = len(frames)
            assert [f.stamp_ns for f in frames] == truth.image_stamps[:images]
            assert all((f.image == i).all() for f, i in zip(frames, truth.images, strict=False))
        if "imu" in kinds:
            imu = imu_readings(recording, IMU)
            readings = len(instance(imu, ImuStream).stamps_ns)
            assert instance(imu, ImuStream).stamps_ns.tolist() == truth.imu_stamps[:readings]
            np.testing.assert_allclose(imu.gyro, truth.gyro[:readings], rtol=1e-15)
        return images + readings

    @pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
    def test_compressed_file(self, plugin, tmp_path, write):
        rng = np.random.default_rng(0)
        maker = write.maker()
        stamps = [S + k * STEP for k in range(60)]
        rows = [maker.image(t, rng.integers(0, 256, (100, 100), dtype=np.uint8)) for t in stamps]
        messages = [("/cam", "sensor_msgs/msg/Image", t, i) for t, i in zip(stamps, rows, strict=True)]
        folder = write.ros2(tmp_path / "run", messages, plugin, "FILE")
        path = next(folder.glob("*.zstd"))
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) * 2 // 3])
        recording = open_recording(folder)
        assert len(recording.notes()) == 1 and f"{path} is truncated or damaged" in recording.notes()[0]
        read = [f.stamp_ns for f in recording.images("/cam")]
        assert 10 < len(read) < 60 and read == stamps[: len(read)]
        path.write_bytes(whole[:1000])
        assert f"{path} is truncated or damaged before its first message" in complaint(lambda: open_recording(folder))

    def test_bag_that_was_not_closed(self, tmp_path, truth, write):
        """ROS 1 writes the place of its index into the header last."""
        path = write.small("ros1", tmp_path, truth)
        whole = path.read_bytes()
        at = whole.index(b"index_pos=") + len(b"index_pos=")
        end = int.from_bytes(whole[at : at + 8], "little")
        path.write_bytes(whole[:at] + bytes(8) + whole[at + 8 : end])
        recording = open_recording(path)
        assert f"at byte {end} of {end}; the readable part is used: 144 messages, 0.6 s" in recording.notes()[0]
        assert self.check_beginning(recording, truth) == 132

    def test_index_of_the_last_block_is_cut_off(self, tmp_path, truth, write):
        """It names some of the block's connections only; their messages are there all the same."""
        path = write.small("ros1", tmp_path, truth)
        whole, last = path.read_bytes(), Ros1Storage(path, path).spans[-1]
        counts = []
        for size in (0, 30, 100, 150):
            path.write_bytes(whole[: last.offset + last.size + size])
            counts.append(sum(t.count for t in open_recording(path).topics()))
        assert counts == [144] * 4

    def test_database_cut_within_a_page(self, tmp_path, write):
        """sqlite takes the missing part of a page for zeros; an image that ends in these must not pass for one."""
        rng = np.random.default_rng(0)
        maker = write.maker()
        images = [rng.integers(1, 256, (100, 100), dtype=np.uint8) for _ in range(30)]
        messages = [("/cam", "sensor_msgs/msg/Image", k, maker.image(k, i)) for k, i in enumerate(images, 1)]
        path = bag_file(write.ros2(tmp_path / "run", messages))
        whole = path.read_bytes()
        read_at = []
        for size in range(len(whole) // 2, len(whole), 1500):
            path.write_bytes(whole[:size])
            frames = list(open_recording(path).images("/cam"))
            assert all((f.image == i).all() for f, i in zip(frames, images, strict=False))
            read_at.append(len(frames))
        assert read_at[0] > 8 and read_at[-1] == len(images) - 1
        assert all(b >= a - 1 for a, b in pairwise(read_at))  # the one in doubt

    def test_half_of_a_split_recording(self, tmp_path, truth, write):
        messages = truth.messages(write.maker())
        write.mcap(tmp_path / "run_0.mcap", messages[:70])
        (tmp_path / "run_1.mcap").write_bytes(b"")
        recording = open_recording(tmp_path)
        assert recording.notes() == (f"{tmp_path / 'run_1.mcap'} is empty; record or copy it again.",)
        assert 0 < len(instance(imu_readings(recording, IMU), ImuStream).stamps_ns) < 70

    def test_no_part_can_be_read(self, tmp_path):
        for k in range(2):
            (tmp_path / f"run_{k}.db3").write_bytes(b"")
        assert "none of its 2 bag files can be read" in complaint(lambda: open_recording(tmp_path))

    def test_without_metadata(self, tmp_path, truth, write):
        """ROS 2 writes metadata.yaml when it closes the bag."""
        folder = write.small("ros2 mcap", tmp_path, truth)
        (folder / "metadata.yaml").unlink()
        recording = open_recording(folder)
        assert (
            len(instance(imu_readings(recording, IMU), ImuStream).stamps_ns) == len(truth.imu_stamps)
            and recording.notes() == ()
        )

    def test_part_that_metadata_names_is_missing(self, tmp_path, truth, write):
        folder = write.small("ros2 mcap", tmp_path, truth)
        file = folder / "metadata.yaml"
        file.write_text(file.read_text().replace("- run.mcap", "- run.mcap\n  - run_1.mcap", 1))
        assert open_recording(folder).notes() == (f"{folder}: metadata.yaml lists run_1.mcap, which does not exist.",)


class TestDamaged:
    @each("form", CUTTABLE)
    def test_any_byte_may_be_wrong(self, form, tmp_path, truth, write):
        """Whatever is written over, there are messages, or a sentence, and never another error."""
        path = bag_file(write.small(form, tmp_path, truth))
        whole = path.read_bytes()
        rng = np.random.default_rng(5)
        for at in rng.integers(0, len(whole), 40):
            damaged = bytearray(whole)
            damaged[at : at + 8] = rng.bytes(8)
            path.write_bytes(damaged)
            for read in (lambda r: list(r.images("/cam0/image_raw")), lambda r: imu_readings(r, IMU)):
                try:
                    read(open_recording(path))
                except RecordingError as error:
                    assert "\n" not in str(error)

    @each("compression", ["NONE", "ZSTD", "LZ4"])
    def test_a_damaged_block_is_left_out(self, compression, tmp_path, truth, write):
        path = tmp_path / "run.mcap"
        kind = write.compression[compression]
        write.mcap(path, truth.messages(write.maker()), compression=kind)
        damaged = bytearray(path.read_bytes())
        damaged[len(damaged) // 2] ^= 0xFF
        path.write_bytes(damaged)
        recording = open_recording(path)
        stamps = instance(imu_readings(recording, IMU), ImuStream).stamps_ns.tolist()
        assert set(stamps) < set(truth.imu_stamps) and len(stamps) > 90 and stamps[-1] == truth.imu_stamps[-1]
        assert "bag_block_damaged" in names(recording.notes())

    def test_a_message_that_is_none(self, tmp_path, write):
        maker = write.maker()
        message = ("/imu", "std_msgs/msg/String", 5 * S, maker.make("std_msgs/msg/String", "hello"))
        path = write.mcap(tmp_path / "a.mcap", [message], enable_crcs=False)
        path.write_bytes(path.read_bytes().replace(b"std_msgs/msg/String", b"sensor_msgs/msg/Imu"))
        recording = open_recording(path)
        sentence = complaint(lambda: imu_readings(recording, IMU))
        assert f"a.mcap /imu: the message received at {5 * S} ns is damaged" in sentence

    @pytest.mark.parametrize("kind", ["ros1", "ros2"])
    def test_single_messages_that_are_none_are_left_out(self, kind, tmp_path, truth, write):
        """As a recorder leaves them that ran out of memory or of disk: bytes of something else."""
        maker = write.maker(kind)
        messages = truth.messages(maker)
        kinds = {topic: message_type for topic, message_type, _, _ in messages}
        for k, (topic, _, received_ns, _) in enumerate(messages):
            if k % 20 == 10:
                messages[k] = (topic, "std_msgs/msg/String", received_ns, maker.make("std_msgs/msg/String", "x" * 17))
        recording = open_recording(write.mcap(tmp_path / "run.mcap", messages, kind))
        lost = {topic: [m[2] for m in messages if m[0] == topic and "String" in m[1]] for topic in kinds}
        assert len(lost["/imu0"]) > 3
        left = [t for t in truth.imu_stamps if t + write.delay_ns not in lost["/imu0"]]
        assert instance(imu_readings(recording, IMU), ImuStream).stamps_ns.tolist() == left
        frames = [f.stamp_ns for f in recording.images("/cam0/image_raw")]
        assert frames == [t for t in truth.image_stamps if t + write.delay_ns not in lost["/cam0/image_raw"]]
        counted = f"/imu0: {len(lost['/imu0'])} of 120 messages are damaged and were left out, the first received at "
        assert any(f"{counted}{lost['/imu0'][0]} ns (" in note for note in recording.notes())


class TestNoBag:
    def test_zero_length(self, tmp_path):
        (tmp_path / "a.bag").touch()
        assert complaint(lambda: open_recording(tmp_path / "a.bag")).endswith(
            "a.bag is empty; record or copy it again."
        )

    @each("name", ["a.bag", "a.db3", "a.mcap", "a.zip"])
    def test_something_else(self, name, tmp_path):
        (tmp_path / name).write_bytes(b"PK\x03\x04 something else")
        sentence = complaint(lambda: open_recording(tmp_path / name))
        assert f"{name} is neither a ROS 1 bag nor an MCAP file nor a ROS 2 database" in sentence

    def test_older_bag(self, tmp_path):
        (tmp_path / "a.bag").write_bytes(b"#ROSBAG V1.2\n" + bytes(100))
        assert "older than format 2.0; convert it with `rosbag fix`" in complaint(
            lambda: open_recording(tmp_path / "a.bag")
        )

    def test_encrypted_bag(self, tmp_path, truth, write):
        path = write.small("ros1", tmp_path, truth)
        path.write_bytes(path.read_bytes().replace(b"chunk_count=", b"encryptor==", 1))
        assert "is encrypted" in complaint(lambda: Ros1Storage(path, path))

    def test_other_database(self, tmp_path):
        import sqlite3

        database = sqlite3.connect(tmp_path / "a.db3")
        database.execute("CREATE TABLE songs (name TEXT)")
        database.commit()
        database.close()
        assert "is a database, but not a ROS 2 bag" in complaint(lambda: open_recording(tmp_path / "a.db3"))

    def test_unreadable(self, tmp_path, monkeypatch):
        path = tmp_path / "a.bag"
        path.write_bytes(b"x")

        def refuse(*_, **__):
            raise PermissionError(13, "Permission denied")

        monkeypatch.setattr(Path, "open", refuse)
        assert "a.bag cannot be read (Permission denied)" in complaint(lambda: open_recording(path))

    def test_messages_of_another_world(self, tmp_path, write):
        imu = write.maker().imu(5, np.ones(3), np.ones(3))
        path = write.mcap(tmp_path / "a.mcap", [("/imu", "sensor_msgs/msg/Imu", 5, imu)], enable_crcs=False)
        path.write_bytes(path.read_bytes().replace(b"\x03\0\0\0cdr", b"\x03\0\0\0xml"))
        sentence = complaint(lambda: imu_readings(open_recording(path), IMU))
        assert "/imu: messages have the encoding 'xml', which is not one of ROS" in sentence

    def test_without_rosbags_the_sentence_names_the_extra(self, tmp_path, truth, write, monkeypatch):
        from icalib.data import bag_recording as bag

        recording = open_recording(write.small("mcap", tmp_path, truth))
        monkeypatch.setitem(sys.modules, "rosbags.typesys", None)
        bag._stores.cache_clear()
        assert 'need the package rosbags, which is not installed; run pip install ".[bags]"' in complaint(
            lambda: imu_readings(recording, IMU)
        )

    def test_unknown_compression(self, tmp_path, truth, write):
        path = write.small("mcap compressed lz4", tmp_path, truth)
        path.write_bytes(path.read_bytes().replace(b"\x03\0\0\0lz4", b"\x03\0\0\0lzo"))
        sentence = complaint(lambda: imu_readings(open_recording(path), IMU))
        assert "run.mcap is compressed by 'lzo'" in sentence


class TestClocks:
    def bag(self, tmp_path, write, stamps: list[int]) -> Recording:
        rng = np.random.default_rng(0)
        maker = write.maker()
        values = [(rng.normal(size=3), rng.normal(size=3) + [0, 0, 9.81]) for _ in stamps]
        messages = [
            ("/imu", "sensor_msgs/msg/Imu", 9 * S + k * 5_000_000, maker.imu(t, *values[k]))
            for k, t in enumerate(stamps)
        ]
        return open_recording(write.mcap(tmp_path / "run.mcap", messages))

    def test_no_stamp_in_the_header(self, tmp_path, write):
        bag = self.bag(tmp_path, write, [0] * 20)
        assert instance(imu_readings(bag, IMU), ImuStream).stamps_ns.tolist() == [
            9 * S + k * 5_000_000 for k in range(20)
        ]
        assert "/imu: 20 " in named("messages_without_stamp", bag.notes())

    def test_readings_that_overtook_each_other_are_sorted(self, tmp_path, write):
        stamps = [S + k * 5_000_000 for k in range(20)]
        stamps[7], stamps[9] = stamps[9], stamps[7]
        bag = self.bag(tmp_path, write, stamps)
        imu = imu_readings(bag, IMU)
        assert instance(imu, ImuStream).stamps_ns.tolist() == sorted(stamps)
        rng = np.random.default_rng(0)
        written = np.array([[rng.normal(size=3), rng.normal(size=3)] for _ in stamps])[:, 0]
        np.testing.assert_array_equal(imu.gyro, written[np.argsort(stamps)])
        assert " by up to 10.0 ms" in named("readings_out_of_order", bag.notes())

    def test_clock_that_was_set_back_is_refused(self, tmp_path, write):
        stamps = [S + k * 5_000_000 for k in range(10)] + [5 + k * 5_000_000 for k in range(10)]
        bag = self.bag(tmp_path, write, [100 * S + t for t in stamps[:10]] + stamps[10:])
        sentence = complaint(lambda: checked_imu(instance(imu_readings(bag, IMU), ImuStream), bag.where(IMU)))
        assert f"run.mcap /imu (imu0): the reading at 5 ns comes after the one at {101 * S + 45_000_000} ns" in sentence


class TestImages:
    def bag(self, tmp_path, write, images, stamps=T, encoding: str = "mono8") -> Recording:
        maker = write.maker()
        messages = [
            ("/cam", "sensor_msgs/msg/Image", t, maker.image(t, i, encoding))
            for t, i in zip(stamps, images, strict=True)
        ]
        return open_recording(write.mcap(tmp_path / "run.mcap", messages))

    def pictures(self, n: int = 8) -> list[np.ndarray]:
        rng = np.random.default_rng(2)
        return [rng.integers(1, 256, (6, 8), dtype=np.uint8) for _ in range(n)]

    def test_two_resolutions(self, tmp_path, write):
        images = self.pictures()
        for k in (4, 5, 7):
            images[k] = np.full((8, 6), k, np.uint8)
        sentence = complaint(lambda: list(self.bag(tmp_path, write, images).images("/cam")))
        assert f"/cam: the image at {T[7]} ns has 6 x 8 px, others have 8 x 6 px" in sentence

    @each("odd", [0, 1, 5])
    def test_single_images_of_another_size_are_left_out(self, tmp_path, write, odd):
        images = self.pictures()
        images[odd] = np.ones((8, 6), np.uint8)
        bag = self.bag(tmp_path, write, images)
        assert [f.stamp_ns for f in bag.images("/cam")] == [T[k] for k in range(8) if k != odd]
        words = f"1 images that have another size than 8 x 6 px were left out, the first at {T[odd]} ns"
        assert words in bag.notes()[0]

    def test_unknown_encoding(self, tmp_path, write):
        bag = self.bag(tmp_path, write, self.pictures(), encoding="32FC1")
        for read in (bag.images, bag.payloads):
            assert f"/cam: the image at {T[0]} ns has the encoding '32FC1'" in complaint(
                lambda read=read: list(read("/cam"))
            )

    def check_left_out(self, bag: Recording, kept: list[int], note: str):
        assert [T.index(p.stamp_ns) for p in bag.payloads("/cam")] == kept
        assert [T.index(f.stamp_ns) for f in bag.images("/cam")] == kept
        assert len(bag.notes()) == 1 and note in bag.notes()[0]

    def test_zero_filled(self, tmp_path, write):
        images = self.pictures()
        images[2] = images[3] = np.zeros((6, 8), np.uint8)
        bag = self.bag(tmp_path, write, images)
        note = f"/cam: 2 images that consist of zeros were left out, the first at {T[2]} ns"
        self.check_left_out(bag, [0, 1, 4, 5, 6, 7], note)

    def test_camera_that_freezes(self, tmp_path, write):
        images = self.pictures()
        images[4] = images[5] = images[3]
        note = (
            f"3 images that repeat their predecessor exactly (the camera froze) were left out, the first at {T[4]} ns"
        )
        images[6] = images[3]
        self.check_left_out(self.bag(tmp_path, write, images), [0, 1, 2, 3, 7], note)

    def test_images_out_of_order(self, tmp_path, write):
        bag = self.bag(tmp_path, write, self.pictures(), [*T[:3], T[4], T[3], T[4], *T[6:]])
        note = f"2 images that are not later than their predecessor were left out, the first at {T[3]} ns"
        self.check_left_out(bag, [0, 1, 2, 4, 6, 7], note)

    def test_clock_that_was_set_back(self, tmp_path, write):
        bag = self.bag(tmp_path, write, self.pictures(), [*T[:4], *(t - 5 * S for t in T[4:])])
        sentence = complaint(lambda: list(bag.images("/cam")))
        assert (
            f"/cam: the image at {T[4] - 5 * S} ns comes after the one at {T[3]} ns, so the camera's clock" in sentence
        )

    @pytest.mark.parametrize(
        ("image", "words"),
        [(0, "of 8 images, 8 consist of zeros"), (1, "of 8 images, 7 repeat their predecessor exactly")],
    )
    def test_no_usable_image(self, image, words, tmp_path, write):
        bag = self.bag(tmp_path, write, [np.full((6, 8), image, np.uint8)] * 8)
        assert words in complaint(lambda: list(bag.images("/cam")))

    def test_damaged_images_are_left_out_with_a_note(self, tmp_path, write):
        maker = write.maker()
        good = [cv2.imencode(".jpg", i)[1].tobytes() for i in self.pictures()]
        good[3] = b"\xff\xd8\xff rubbish"
        kind = "sensor_msgs/msg/CompressedImage"
        messages = [("/cam", kind, t, maker.compressed(t, d, "jpeg")) for t, d in zip(T, good, strict=True)]
        bag = open_recording(write.mcap(tmp_path / "run.mcap", messages))
        assert [T.index(f.stamp_ns) for f in bag.images("/cam")] == [0, 1, 2, 4, 5, 6, 7]
        assert f"/cam: 1 images that are damaged were left out, the first at {T[3]} ns" in bag.notes()[0]

    def test_all_images_damaged(self, tmp_path, write):
        maker = write.maker()
        kind = "sensor_msgs/msg/CompressedImage"
        messages = [("/cam", kind, t, maker.compressed(t, b"\xff\xd8\xff%d" % t, "jpeg")) for t in T]
        bag = open_recording(write.mcap(tmp_path / "run.mcap", messages))
        assert f"the image at {T[0]} ns is damaged" in complaint(lambda: list(bag.images("/cam")))
