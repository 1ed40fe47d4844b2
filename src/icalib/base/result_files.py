"""Writes a set of files into a folder so that, whatever happens, the folder holds one whole set, old or new.

The new set is written into a hidden folder inside the target, flushed, and that folder renamed to `.icalib-commit`:
from here on the new set counts. Then file by file moves into place. After a crash in between, readers look into the
commit folder first, and the next writer finishes the move. Files of others in the folder are left alone.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from icalib.base.file_names import below
from icalib.base.own_files import refuse_foreign
from icalib.base.staging import staged
from icalib.errors import CalibrationError

COMMIT = ".icalib-commit"
# Every name that icalib writes: a leftover of an earlier result beside a new one would be a silently wrong number.
OWN_FILES = (
    "calibration.yaml",
    "camchain-imucam.yaml",
    "camchain.yaml",
    "fleet-job.json",
    "imu.yaml",
    "report.html",
    "result.json",
    "result.npz",
)


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes `files` (name -> content) as one set; `folder` is made where absent.

    Raises CalibrationError naming the folder where it cannot be written; an earlier set is whole then.
    """
    with _errors_named(folder):
        folder.mkdir(parents=True, exist_ok=True)
        _move_in(folder)
        with staged(folder) as staging:
            for name, content in files.items():
                _write_through(below(staging, name), content)
            staging.rename(folder / COMMIT)
        for name in set(OWN_FILES) - set(files):
            (folder / name).unlink(missing_ok=True)
        _move_in(folder)


def read_file(folder: Path, name: str) -> bytes:
    """The file `name` of the set that counts. Raises CalibrationError where it is absent or cannot be read."""
    if not folder.is_dir():
        raise CalibrationError(f"{folder} is not a folder; give the folder that a calibration was written to.")
    committed = [] if _commit(folder) is None else [folder / COMMIT / name]
    for path in (*committed, folder / name):
        with contextlib.suppress(FileNotFoundError), _errors_named(path, "read"):
            return path.read_bytes()
    raise CalibrationError(f"{folder} holds no {name}; give the folder that a calibration was written to.")


def finish_writing(folder: Path) -> None:
    """Moves into place what a writer that was killed left half-moved, so that other programs see it, too.

    Raises CalibrationError where the folder cannot be written.
    """
    with _errors_named(folder):
        _move_in(folder)


def refuse_foreign_set(folder: Path, inputs: Iterable[Path] = ()) -> None:
    """Raises CalibrationError where `folder` has a file under a name of a set that icalib did not write, that was
    changed since, or that is one of `inputs`."""
    commit = _commit(folder)
    names = set(OWN_FILES) | ({path.name for path in commit.iterdir()} if commit else set())
    refuse_foreign((folder / name for name in sorted(names)), inputs)


def set_of(folder: Path) -> list[Path]:
    """The files that a set in `folder` may have."""
    return [folder / name for name in OWN_FILES]


def check_writable(folder: Path) -> None:
    """Makes `folder` and tries to write in it, so that a long run does not fail at its end. Raises CalibrationError."""
    with _errors_named(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with staged(folder):
            pass


def _write_through(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _move_in(folder: Path) -> None:
    """Moves what a commit folder holds into place."""
    commit = _commit(folder)
    if commit is not None:
        for path in sorted(commit.iterdir()):
            path.replace(folder / path.name)
        commit.rmdir()


def _commit(folder: Path) -> Path | None:
    """The commit folder, where there is one. Raises CalibrationError where it is a link, which icalib never makes."""
    commit = folder / COMMIT
    if commit.is_symlink():
        raise CalibrationError(f"{commit} is a link, which icalib never writes; remove it.")
    return commit if commit.is_dir() else None


@contextlib.contextmanager
def _errors_named(path: Path, verb: str = "written") -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if verb == "read" and isinstance(error, FileNotFoundError):
            raise
        advice = "check its permissions" if verb == "read" else "choose another folder"
        raise CalibrationError(f"{path} cannot be {verb} ({error.strerror or error}); {advice}.") from error
