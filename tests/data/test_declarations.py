"""What kinds of sensors declare that they are read from: bags and folders follow it, and know no kind."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from icalib.data import messages as topics
from icalib.data import tables as files
from icalib.data.messages import MessageType, message_types
from icalib.data.recordings import FolderRecording, open_recording
from icalib.data.tables import STAMP, TableFile, TableKind, read_table, table_files
from icalib.kinds import readers
from icalib.sensors import SENSOR_KINDS
from icalib.sensors.pose import read as pose

STAMPS = [1_700_000_000_000_000_000 + 100_000_000 * k for k in range(4)]
POSITIONS = TableKind(("t [ns]",), ("x [m]", "y [m]", "z [m]"), (STAMP, ("x",), ("y",), ("z",)))


@pytest.fixture
def declare(monkeypatch) -> Iterator[Callable[[str, object], None]]:
    """Adds one declaration to those of pose sensors."""
    caches = (readers, topics.message_types, files.table_files)

    def add(name: str, declared: object) -> None:
        more = dataclasses.replace(pose.READER, **{name: (*getattr(pose.READER, name), declared)})
        monkeypatch.setattr(pose, "READER", more)
        for cache in caches:
            cache.cache_clear()

    yield add
    monkeypatch.undo()
    for cache in caches:
        cache.cache_clear()


def test_every_kind_declares_what_it_is_read_from():
    assert tuple(readers()) == SENSOR_KINDS
    assert all(reader.messages and reader.tables for reader in readers().values())


def test_kinds_that_share_a_type_of_messages_call_its_content_alike():
    declared = [t for reader in readers().values() for t in reader.messages]
    assert all(t == message_types()[t.name] for t in declared)
    assert len(declared) > len(message_types())  # odometry: wheels and pose sensors


@pytest.mark.parametrize("form", ["ros1", "ros2"])
def test_messages_of_a_new_type_are_read(tmp_path, write, declare, form):
    declare("messages", MessageType("geometry_msgs/msg/PointStamped", "point"))
    make = write.maker(form)
    points = [make.make("geometry_msgs/msg/PointStamped", make.header(t, "map"), make.vector([k, 2.0, 3.0], "Point"))
              for k, t in enumerate(STAMPS)]  # fmt: skip
    messages = [("/prism", "geometry_msgs/msg/PointStamped", t + 5, m) for t, m in zip(STAMPS, points, strict=True)]
    path = tmp_path / ("run.bag" if form == "ros1" else "run")
    bag = open_recording((write.ros1 if form == "ros1" else write.ros2)(path, messages))
    assert [(t.name, t.kind, t.count) for t in bag.topics()] == [("/prism", "point", 4)]
    topic = bag.topic("prism", None, "point").name
    assert [(t, m.point.x) for t, m in bag.messages(topic, "point")] == [(t, float(k)) for k, t in enumerate(STAMPS)]


def test_files_of_a_new_name_are_listed(tmp_path, declare):
    def stamps(path: Path, layout: object) -> np.ndarray:
        return read_table(path, POSITIONS).integers[:, 0]

    declare("tables", TableFile("*.pos", "table of positions", "position", stamps))
    (tmp_path / "gnss0").mkdir()
    rows = "".join(f"{t},{k},0,0\n" for k, t in enumerate(STAMPS))
    (tmp_path / "gnss0" / "solution.pos").write_text("t,x,y,z\n" + rows)
    folder = open_recording(tmp_path)
    assert isinstance(folder, FolderRecording)
    (topic,) = folder.topics()
    assert (topic.name, topic.type, topic.kind) == ("gnss0/solution.pos", "table of positions", "position")
    assert folder.stamps(topic.name).tolist() == STAMPS


def test_a_file_that_two_kinds_declare_is_told_by_its_columns(tmp_path):
    """`poses.csv` holds poses in a frame, or relative poses of wheels."""
    for name, header in (("mocap0", "t,x,y,z,qx,qy,qz,qw"), ("wheel0", "from,to,yaw,x,y,c00,c01,c02,c11,c12,c22")):
        (tmp_path / name).mkdir()
        numbers = ",".join("0" * (header.count(",") - 1))
        text = f"{header}\n{STAMPS[0]},{STAMPS[1] if name == 'wheel0' else 0},{numbers}\n"
        (tmp_path / name / "poses.csv").write_text(text)
    names = {path.parent.name: declared.kind for p in tmp_path.iterdir() for path, declared in files.files_in(p)}
    assert names == {"mocap0": "pose", "wheel0": "wheels"}
    assert [t.kind for t in table_files() if t.name == "poses.csv"] == ["wheels", "pose"]
