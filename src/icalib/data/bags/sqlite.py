"""Reader of SQLite bags of ROS 2 (.db3)."""

from __future__ import annotations

import sqlite3
from collections import deque
from collections.abc import Iterator, Set
from contextlib import closing
from pathlib import Path
from typing import final

from icalib.base.input_files import hash_of
from icalib.data.bags.storage import Connection, Tally, cut_note, full_type
from icalib.errors import RecordingError

SQLITE_MAGIC = b"SQLite format 3\x00"
# Types are checked, as a damaged database may contain any value.
_TOPICS = (
    "SELECT id, name, type, serialization_format FROM topics WHERE typeof(name) = 'text' AND typeof(type) = 'text'"
)


@final
class SqliteStorage:
    """Reader of a ROS 2 database. Rows are read in the order of ids, the order of writing, without an index."""

    def __init__(self, path: Path, name: Path) -> None:
        self.path = path
        self.name = name
        self.notes: list[str] = []
        self._tally: dict[int, Tally] = {}
        self._last_id = -1  # id of the last usable message
        try:
            with closing(self._connect()) as database:
                rows = database.execute(_TOPICS).fetchall()
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
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE id <= ? AND topic_id IN ({marks}) ORDER BY id"
        hash_of(self.path).read_beside()
        with closing(self._connect()) as database:
            try:
                yield from database.execute(query, (self._last_id, *wanted))
            except sqlite3.DatabaseError as error:
                note = f"{self.name} is damaged ({error}); the messages after the damage were ignored."
                if note not in self.notes:
                    self.notes.append(note)

    def _count(self) -> None:
        page_bytes = _page_bytes_of_cut(self.path)
        wrong = self._tally_rows("CASE typeof(data) WHEN 'blob' THEN x'' END", 0)
        if wrong or page_bytes:  # read all contents: later pages may be missing
            wrong = self._tally_rows("data", page_bytes) or "the last pages are missing"
            self.notes.append(cut_note(self.name, f"({wrong})", self._tally))

    def _tally_rows(self, data: str, doubtful_bytes: int) -> str:
        """Count the messages before the first damage. Returns a description of the damage, empty if there is none.

        data: SQL expression for the content. The last messages, up to `doubtful_bytes`, are not counted: they may lie
        in a truncated page, whose missing part SQLite reads as zeros.
        """
        self._tally, self._last_id = {}, -1
        doubtful: deque[tuple[int, int, int, int]] = deque()  # id, topic, receive time [ns], size [bytes]
        total = 0
        try:
            with closing(self._connect()) as database:
                query = f"SELECT id, topic_id, timestamp, {data} FROM messages ORDER BY id"
                for key, topic, received_ns, content in database.execute(query):
                    if not (isinstance(topic, int) and isinstance(received_ns, int) and isinstance(content, bytes)):
                        return "a row makes no sense"
                    doubtful.append((key, topic, received_ns, len(content)))
                    total += len(content)
                    while doubtful and total - doubtful[0][3] >= doubtful_bytes:
                        self._last_id, topic, received_ns, size = doubtful.popleft()
                        self._tally.setdefault(topic, Tally()).add(1, received_ns, received_ns)
                        total -= size
        except sqlite3.DatabaseError as error:
            return str(error)
        return ""

    def _connect(self) -> sqlite3.Connection:
        # Without a write-ahead log, `immutable` avoids writing beside the database, which may be on a read-only disk.
        log = self.path.with_name(self.path.name + "-wal")
        options = "mode=ro" if log.exists() and log.stat().st_size else "mode=ro&immutable=1"
        # The garbage collector may close an unfinished query in another thread. Two threads never read at once.
        uri = f"{self.path.absolute().as_uri()}?{options}"
        database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        database.execute("PRAGMA writable_schema=ON")  # allows a file shorter than its header states
        return database


def _page_bytes_of_cut(path: Path) -> int:
    """Page size [bytes] if the database file is truncated (shorter than its header states), else 0."""
    with path.open("rb") as file:
        head = file.read(100)
    page_bytes = int.from_bytes(head[16:18]) if head[16:18] != b"\0\1" else 65536
    pages = int.from_bytes(head[28:32]) if head[24:28] == head[92:96] else 0  # else the count is invalid
    size = path.stat().st_size
    cut = size < pages * page_bytes or (page_bytes and size % page_bytes)
    return page_bytes if cut else 0
