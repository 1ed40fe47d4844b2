"""Writes a set of files into a folder so that, whatever happens, the folder holds one whole set, old or new.

The new set is written into a hidden folder inside the target, flushed, and that folder renamed to `.icalib-commit`:
from here on the new set counts. Then file by file moves into place. After a crash in between, readers look into the
commit folder first, and the next writer finishes the move. Files of others in the folder are left alone.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path

from icalib.errors import CalibrationError

COMMIT = ".icalib-commit"
# Every name that icalib writes: a leftover of an earlier result beside a new one would be a silently wrong number.
OWN_FILES = (
    "calibration.yaml", "camchain-imucam.yaml", "camchain.yaml", "fleet-job.json", "imu.yaml", "report.html",
    "result.json", "result.npz",
)  # fmt: skip


def write_files(folder: Path, files: Mapping[str, bytes]) -> None:
    """Writes `files` (name -> content) as one set; `folder` is made where absent.

    Raises CalibrationError naming the folder where it cannot be written; an earlier set is whole then.
    """
    with _errors_named(folder):
        folder.mkdir(parents=True, exist_ok=True)
        _move_in(folder)
        staging = Path(tempfile.mkdtemp(prefix=".icalib-staging-", dir=folder))
        try:
            for name, content in files.items():
                _write_through(staging / name, content)
            staging.rename(folder / COMMIT)
        except BaseException:
            shutil.rmtree(staging, ignore_errors=True)
            raise
        for name in set(OWN_FILES) - set(files):
            (folder / name).unlink(missing_ok=True)
        _move_in(folder)


def read_file(folder: Path, name: str) -> bytes:
    """The file `name` of the set that counts. Raises CalibrationError where it is absent or cannot be read."""
    if not folder.is_dir():
        raise CalibrationError(f"{folder} is not a folder; give the folder that a calibration was written to.")
    for path in (folder / COMMIT / name, folder / name):
        with contextlib.suppress(FileNotFoundError), _errors_named(path, "read"):
            return path.read_bytes()
    raise CalibrationError(f"{folder} holds no {name}; give the folder that a calibration was written to.")


def finish_writing(folder: Path) -> None:
    """Moves into place what a writer that was killed left half-moved, so that other programs see it, too.

    Raises CalibrationError where the folder cannot be written.
    """
    with _errors_named(folder):
        _move_in(folder)


def check_writable(folder: Path) -> None:
    """Makes `folder` and tries to write in it, so that a long run does not fail at its end. Raises CalibrationError."""
    with _errors_named(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass


def _write_through(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _move_in(folder: Path) -> None:
    """Moves what a commit folder holds into place."""
    commit = folder / COMMIT
    if commit.is_dir():
        for path in sorted(commit.iterdir()):
            path.replace(folder / path.name)
        commit.rmdir()


@contextlib.contextmanager
def _errors_named(path: Path, verb: str = "written") -> Iterator[None]:
    try:
        yield
    except FileNotFoundError:
        if verb == "read":
            raise
        raise CalibrationError(f"{path} cannot be written (its disk went away); choose another folder.") from None
    except OSError as error:
        advice = "check its permissions" if verb == "read" else "choose another folder"
        raise CalibrationError(f"{path} cannot be {verb} ({error.strerror or error}); {advice}.") from error
