"""Recordings that are being written: what is new is read, nothing twice, and a writer is not disturbed."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.typed import instance, not_none

from icalib.data.bag_recording import BagRecording, MessagePart
from icalib.data.folder import FilePart
from icalib.data.recording import Growing, NewPart
from icalib.data.recordings import open_growing_recording, open_recording
from icalib.tools.simulation.output import IMAGE, IMU, BagForm, BagWriter

COUNT = 400
STEP_NS = 10_000_000


def written(form: BagForm, path: Path) -> Path:
    """The file of a bag of readings, and an image at every tenth."""
    with BagWriter(form, path, {"/imu0": IMU, "/cam0/image_raw": IMAGE}) as bag:
        for k in range(COUNT):
            bag.write("/imu0", bag.imu(1 + k * STEP_NS, [float(k), 0.0, 0.0, 0.0, 0.0, 9.81]), 1 + k * STEP_NS)
            if k % 10 == 0:
                pixels = np.full((48, 64), 1 + k % 200, np.uint8)
                bag.write("/cam0/image_raw", bag.image(1 + k * STEP_NS, "cam0", pixels), 2 + k * STEP_NS)
    return path if path.is_file() else next(p for p in path.iterdir() if p.suffix in (".mcap", ".db3"))


def parts_of(source: Growing) -> list[NewPart]:
    return list(iter(source.part, None))


def stamps(parts: list[NewPart], topic: str) -> list[int]:
    return [s for p in parts for s in instance(p, MessagePart).recording(Path()).stamps(topic).tolist()]


@pytest.mark.parametrize("form", ["mcap", "ros1"])
def test_a_bag_of_chunks_is_read_once_as_it_grows(form: BagForm, tmp_path: Path):
    whole = written(form, tmp_path / "whole").read_bytes()
    path = tmp_path / "growing"
    assert open_growing_recording(path) is None
    path.write_bytes(whole[:5])
    source = not_none(open_growing_recording(path))
    found: list[NewPart] = []
    cuts = np.unique(np.random.default_rng(1).integers(6, len(whole), 30)).tolist()
    for cut in (*cuts, len(whole)):
        path.write_bytes(whole[:cut])
        found += parts_of(source)
    assert stamps(found, "/imu0") == [1 + k * STEP_NS for k in range(COUNT)]
    last = found[0].joined(found[1:]).without({"/imu0"}).joined([found[-1]])
    assert instance(last, MessagePart).recording(Path()).topics()[0].name == "/cam0/image_raw"
    assert parts_of(source) == []


def test_a_long_file_comes_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("icalib.data.bag_recording.PART_BYTES", 10_000)
    found = parts_of(not_none(open_growing_recording(written("mcap", tmp_path / "whole"))))
    assert len(found) > 10 and stamps(found, "/imu0") == [1 + k * STEP_NS for k in range(COUNT)]


def test_what_a_killed_writer_left_is_read(tmp_path: Path):
    file = written("mcap", tmp_path / "whole")
    file.write_bytes(file.read_bytes()[:-2000])
    complete = BagRecording(file).stamps("/imu0")
    found = stamps(parts_of(not_none(open_growing_recording(file))), "/imu0")
    assert found == complete[: len(found)].tolist()
    file.write_bytes(b"")  # cut: waits until it grows again
    assert parts_of(not_none(open_growing_recording(file))) == []


def test_a_file_that_is_cut_is_not_read_twice(tmp_path: Path):
    file = written("mcap", tmp_path / "whole")
    source = not_none(open_growing_recording(file))
    assert len(stamps(parts_of(source), "/imu0")) == COUNT
    file.write_bytes(file.read_bytes()[:1000])
    assert parts_of(source) == []


def test_an_open_chunk_of_ros_is_left_to_its_recorder(tmp_path: Path):
    """The recorder writes messages behind a header with size 0, which it replaces when it closes the chunk."""
    whole = written("ros1", tmp_path / "whole").read_bytes()
    data_at = whole.index(b"size=", whole.index(b"op=\x05")) + 9  # behind the header of the first chunk
    length = int.from_bytes(whole[data_at : data_at + 4], "little")
    path = tmp_path / "growing.bag"
    path.write_bytes(whole[:data_at] + bytes(4) + whole[data_at + 4 : data_at + 4 + length // 2])
    source = not_none(open_growing_recording(path))
    assert parts_of(source) == []
    path.write_bytes(whole)
    assert len(stamps(parts_of(source), "/imu0")) == COUNT


@pytest.mark.parametrize("journal", ["delete", "memory", "wal"])
def test_a_database_is_read_beside_its_writer(journal: str, tmp_path: Path):
    rows = _rows(written("sqlite3", tmp_path / "whole"))
    path = tmp_path / "growing.db3"
    found: list[NewPart] = []
    with closing(sqlite3.connect(path, timeout=0.0)) as writer:
        writer.execute(f"PRAGMA journal_mode={journal}")
        writer.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        writer.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        writer.executemany("INSERT INTO topics VALUES (?, ?, ?, ?)", rows["topics"])
        writer.commit()
        source = not_none(open_growing_recording(path))
        for k in range(0, len(rows["messages"]), 50):
            writer.executemany("INSERT INTO messages VALUES (?, ?, ?, ?)", rows["messages"][k : k + 50])
            writer.commit()  # a lock of the reader would raise OperationalError
            found += parts_of(source)
        found += parts_of(source) + parts_of(source)
    assert stamps(found, "/imu0") == [1 + k * STEP_NS for k in range(COUNT)]


def _rows(file: Path) -> dict[str, list[Any]]:
    with closing(sqlite3.connect(file)) as database:
        topics = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        messages = database.execute("SELECT id, topic_id, timestamp, data FROM messages").fetchall()
        return {"topics": topics, "messages": messages}


def test_files_that_a_recorder_adds_are_read(tmp_path: Path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "metadata.yaml").touch()
    assert open_growing_recording(folder) is None
    first = written("mcap", tmp_path / "whole")
    shutil.copy(first, folder / "run_0.mcap")
    source = not_none(open_growing_recording(folder))
    assert len(stamps(parts_of(source), "/imu0")) == COUNT
    shutil.copy(first, folder / "run_1.mcap")
    assert len(stamps(parts_of(source), "/imu0")) == COUNT


def test_no_bag_is_named(tmp_path: Path):
    path = tmp_path / "notes.txt"
    path.write_text("these are notes on a recording, and no recording at all, as anybody can see here")
    source = not_none(open_growing_recording(path))
    sentence = f"{path} is no bag that can be followed; give a .bag, .mcap or .db3 file, or a folder."
    assert source.part() is None and source.unread == {path: sentence}


def lines(header: str, first: int, count: int) -> str:
    return header + "".join(f"{1 + k * STEP_NS},{k}.5,0.0,0.0,0.0,0.0,9.81\n" for k in range(first, first + count))


@pytest.mark.parametrize("header", ["", "#t [ns],wx,wy,wz,ax,ay,az\n"])
def test_a_folder_gets_rows_and_images(header: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    cv2 = pytest.importorskip("cv2")
    monkeypatch.setattr("icalib.data.folder._SETTLED_S", 0.0)
    (tmp_path / "imu0").mkdir()
    (tmp_path / "cam0" / "data").mkdir(parents=True)
    table = tmp_path / "imu0" / "data.csv"
    table.write_text(lines(header, 0, 30) + "1234,0.")  # a row that is half written
    source = not_none(open_growing_recording(tmp_path))
    found = [instance(not_none(source.part()), FilePart)]
    assert source.part() is None
    table.write_text(lines(header, 0, 50))
    assert cv2.imwrite(str(tmp_path / "cam0" / "data" / "1000.png"), np.full((4, 4), 9, np.uint8))
    found += [instance(not_none(source.part()), FilePart)]
    assert source.part() is None
    both = tmp_path / "both"
    joined = found[0].joined(found[1:]).recording(both)
    assert joined.stamps("imu0/data.csv").tolist() == open_recording(tmp_path).stamps("imu0/data.csv").tolist()
    one = found[1].recording(tmp_path / "one")
    assert [(t.name, t.count) for t in one.topics()] == [("cam0", 1), ("imu0/data.csv", 20)]
    assert found[1].without(set()).images == {}
