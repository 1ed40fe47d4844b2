"""Hashes of a job's inputs: a job is calibrated again if they changed."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from icalib.base.input_files import regular
from icalib.tools.batch import program
from icalib.tools.fleet.jobs import Job


@dataclass(frozen=True)
class InputHashes:
    """Hashes of the inputs of a job. rig: sha256 of the file. recordings: for each, sha256 of the names, sizes and
    modification times of its files, as hashing the contents would take long; the folder does not matter. program: see
    `tools.batch.program`."""

    rig: str
    recordings: tuple[str, ...]
    program: str

    @classmethod
    def of(cls, job: Job) -> InputHashes:
        """Hashes of the current files and the running program; "absent" for a missing file."""
        return cls(_content(job.rig), tuple(map(_sizes, job.recordings)), program())

    def changed(self, now: InputHashes) -> str:
        """Words on the inputs that differ from `now`; "" if none does."""
        changes = [words for name, words in _CHANGED.items() if getattr(self, name) != getattr(now, name)]
        return ", ".join(changes)


_CHANGED = {"rig": "the rig file changed", "recordings": "the recording changed", "program": "icalib changed"}


def _content(path: Path) -> str:
    try:
        return hashlib.sha256(regular(path).read_bytes()).hexdigest()
    except OSError:
        return "absent"


def _sizes(path: Path) -> str:
    digest = hashlib.sha256(os.fsencode(path.name))
    n_files = 0
    for file in sorted(_files(path)):
        try:
            status = file.stat()
        except OSError:  # a dangling link, or just deleted: the reader of the recording reports what is missing
            continue
        digest.update(os.fsencode(f"{os.path.relpath(file, path)}\0{status.st_size}\0{status.st_mtime_ns}\0"))
        n_files += 1
    return digest.hexdigest() if n_files else "absent"


def _files(path: Path) -> Iterator[Path]:
    if not path.is_dir():
        yield path
    for folder, _, names in os.walk(path):
        yield from (Path(folder, name) for name in names)
