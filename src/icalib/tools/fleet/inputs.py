"""What a job's result was made from, so that it is made again where that changed."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from icalib.tools.batch import program
from icalib.tools.fleet.jobs import Job


@dataclass(frozen=True)
class InputHashes:
    """rig: sha256 of the file. recordings: of the sizes and the times of change of all files of each, which may be
    larger than one likes to read; their names count, where they lie does not. program: digest of icalib's source."""

    rig: str
    recordings: tuple[str, ...]
    program: str

    @classmethod
    def of(cls, job: Job) -> InputHashes:
        """As they are now, with the program that runs now. What is not there is "absent"."""
        return cls(_content(job.rig), tuple(map(_sizes, job.recordings)), program())

    def changed(self, now: InputHashes) -> str:
        """What is another one now, in words; empty where nothing is."""
        found = [words for name, words in _CHANGED.items() if getattr(self, name) != getattr(now, name)]
        return ", ".join(found)


_CHANGED = {"rig": "the rig file changed", "recordings": "the recording changed", "program": "icalib changed"}


def _content(path: Path) -> str:
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return "absent"


def _sizes(path: Path) -> str:
    digest = hashlib.sha256(os.fsencode(path.name))
    found = 0
    for file in sorted(_files(path)):
        try:
            about = file.stat()
        except OSError:  # a link to nowhere, or gone in this moment: the reader will say what it misses
            continue
        digest.update(os.fsencode(f"{os.path.relpath(file, path)}\0{about.st_size}\0{about.st_mtime_ns}\0"))
        found += 1
    return digest.hexdigest() if found else "absent"


def _files(path: Path) -> Iterator[Path]:
    if not path.is_dir():
        yield path
    for folder, _, names in os.walk(path):
        yield from (Path(folder, name) for name in names)
