"""ROS 2's sqlite databases (.db3)."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Set
from contextlib import closing
from pathlib import Path
from typing import final
from urllib.parse import quote

from icalib.errors import RecordingError
from icalib.recordings.bags.storage import Connection, Tally, cut_note, full_type

SQLITE_MAGIC = b"SQLite format 3\x00"


@final
class SqliteStorage:
    """A ROS 2 database. Rows are read in the order of their ids, which is that of writing: no index is needed."""

    def __init__(self, path: Path, name: Path) -> None:
        self.path = path
        self.name = name
        self.notes: list[str] = []
        self._tally: dict[int, Tally] = {}
        try:
            with closing(self._connect()) as database:
                rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except sqlite3.OperationalError as error:
            raise RecordingError(f"{name} is a database, but not a ROS 2 bag ({error}); check the path.") from error
        except sqlite3.DatabaseError as error:
            raise RecordingError(f"{name} is a damaged database ({error}); copy or record it again.") from error
        self.connections = {key: Connection(topic, full_type(kind), form) for key, topic, kind, form in rows}
        self._count()

    def tally(self) -> dict[int, Tally]:
        return self._tally

    def messages(self, wanted: Set[int]) -> Iterator[tuple[int, int, bytes]]:
        marks = ",".join("?" * len(wanted))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY id"
        with closing(self._connect()) as database:
            try:
                yield from database.execute(query, tuple(wanted))
            except sqlite3.DatabaseError as error:
                note = f"{self.name} is damaged ({error}); the messages after the damage were left out."
                if note not in self.notes:
                    self.notes.append(note)

    def _count(self) -> None:
        try:
            with closing(self._connect()) as database:
                for key, received_ns in database.execute("SELECT topic_id, timestamp FROM messages ORDER BY id"):
                    self._tally.setdefault(key, Tally()).add(1, received_ns, received_ns)
        except sqlite3.DatabaseError as error:
            self.notes.append(cut_note(self.name, f"({error})", self._tally))

    def _connect(self) -> sqlite3.Connection:
        # Without a write-ahead log nothing needs to be written beside the file, and it may lie on a read-only disk.
        log = self.path.with_name(self.path.name + "-wal")
        options = "mode=ro" if log.exists() and log.stat().st_size else "mode=ro&immutable=1"
        database = sqlite3.connect(f"file:{quote(str(self.path.absolute()))}?{options}", uri=True)
        database.execute("PRAGMA writable_schema=ON")  # opens a file that is shorter than its header says
        return database
