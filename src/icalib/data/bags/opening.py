"""Finds the files of a bag, and chooses the reader of each by its content."""

from __future__ import annotations

import re
import shutil
import tempfile
import weakref
from pathlib import Path

from icalib.base.extras import load_zstd
from icalib.base.input_files import HEAD_BYTES, HashedFile, TooLargeError, copy_unpacked, not_data, regular
from icalib.base.yaml_nodes import read_yaml
from icalib.data.bags.mcap import MCAP_MAGIC, McapStorage
from icalib.data.bags.ros1 import ROS1_MAGIC, Ros1Storage
from icalib.data.bags.sqlite import SQLITE_MAGIC, SqliteStorage
from icalib.data.bags.storage import Storage
from icalib.errors import RecordingError, RigError

_READERS = {ROS1_MAGIC: Ros1Storage, MCAP_MAGIC: McapStorage, SQLITE_MAGIC: SqliteStorage}
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_SUFFIXES = (".bag", ".active", ".mcap", ".db3", ".zstd")


def bag_files(folder: Path) -> list[Path]:
    """Bag files directly in `folder`, sorted by the numbers in their names: run_2.db3 before run_10.db3."""
    paths = [p for p in folder.iterdir() if p.is_file() and p.suffix in _SUFFIXES]
    return sorted(paths, key=lambda p: [int(t) if t.isdigit() else t for t in re.split(r"(\d+)", p.name)])


def open_storages(path: Path) -> tuple[list[Storage], list[str]]:
    """Readers of the bag file or folder `path`, and notes on missing and unreadable files of a folder.

    Raises RecordingError if no file can be read.
    """
    if not path.is_dir():
        return [open_storage(path)], []
    files = bag_files(path)
    notes = [f"{path}: metadata.yaml lists {name}, which does not exist." for name in _absent(path)]
    storages: list[Storage] = []
    for file in files:
        try:
            storages.append(open_storage(file))
        except RecordingError as error:
            if len(files) == 1:
                raise
            notes.append(str(error))
    if not storages:
        raise RecordingError(f"{path}: none of its {len(files)} bag files can be read. {notes[-1]}")
    return storages, notes


def open_storage(path: Path, name: Path | None = None) -> Storage:
    """Reader of the bag file `path`. name: its name in messages; default: `path`. Raises RecordingError if the file is
    empty, damaged or no bag."""
    name = name or path
    try:
        with regular(path).open("rb") as file:
            head = file.read(HEAD_BYTES)
        if not head:
            raise RecordingError(f"{name} is empty; record or copy it again.")
        for magic, reader in _READERS.items():
            if head.startswith(magic):
                return reader(path, name)
        if head.startswith(ZSTD_MAGIC):
            return _open_compressed(path)
        if sentence := not_data(name, head):
            raise RecordingError(sentence)
    except OSError as error:
        raise RecordingError(
            f"{name} cannot be read ({error.strerror or error}); check the file and its permissions."
        ) from error
    raise RecordingError(
        f"{name} is neither a ROS 1 bag nor an MCAP file nor a ROS 2 database; "
        "give a .bag, .mcap or .db3 file, a folder that ROS 2 recorded, or a folder of tables."
    )


def _open_compressed(path: Path) -> Storage:
    """Reader of a file that ROS 2 compressed as a whole. It reads a temporary copy, deleted with the reader."""
    zstd = load_zstd()
    folder = tempfile.mkdtemp(prefix="icalib-")
    copy = Path(folder) / path.stem
    try:
        with HashedFile(path) as file, zstd.open(file, "rb") as packed, copy.open("wb") as out:
            copy_unpacked(packed, out, path.stat().st_size)
    except TooLargeError as error:
        shutil.rmtree(folder)
        raise RecordingError(f"{path}: {error}; unpack it with zstd -d and check its content.") from error
    except (zstd.ZstdError, EOFError):
        pass  # truncated: the reader of the copy notes how much is readable
    except OSError:
        shutil.rmtree(folder)
        raise
    try:
        if not copy.stat().st_size:
            raise RecordingError(f"{path} is truncated or damaged before its first message; copy or record it again.")
        storage = open_storage(copy, path)
    except RecordingError:
        shutil.rmtree(folder)
        raise
    weakref.finalize(storage, shutil.rmtree, folder)
    return storage


def _absent(folder: Path) -> list[str]:
    """Names of missing files that metadata.yaml lists; empty if it is missing or damaged, as nothing else needs it."""
    try:
        about = read_yaml(folder / "metadata.yaml").entries()["rosbag2_bagfile_information"].entries()
        names = [Path(item.text()).name for item in about["relative_file_paths"].items()]
    except (RigError, KeyError):
        return []
    present = {path.name for path in folder.iterdir()}
    return [n for n in names if not {n, n + ".zstd"} & present]
