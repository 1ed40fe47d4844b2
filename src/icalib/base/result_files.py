"""Atomic replacement of a set of result files: after a crash the folder holds the complete old or new set.

1. The new files are written to a hidden subfolder and flushed.
2. The subfolder is renamed to `.icalib-commit`. From here on the new set is valid.
3. The files are moved one by one from `.icalib-commit` into the folder.

After a crash during step 3, readers look into `.icalib-commit` first, and the next writer finishes the move. Files that
icalib did not write stay unchanged.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from icalib.base.file_names import below
from icalib.base.own_files import refuse_foreign
from icalib.base.staging import staged
from icalib.base.writing import writing
from icalib.errors import CalibrationError

COMMIT = ".icalib-commit"
# All file names of a result. A new result deletes those that it does not write, so that no outdated file remains.
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
    """Replaces the result in `folder` by `files` (name -> content); creates `folder` if needed.

    Raises CalibrationError with the folder if it cannot be written; an earlier result is then still complete.
    """
    with writing(folder):
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
    """Content of the result file `name`: the new one if a writer was killed while it moved its files. Raises
    CalibrationError if it is missing or cannot be read."""
    if not folder.is_dir():
        raise CalibrationError(f"{folder} is not a folder; give the folder that a calibration was written to.")
    # After such a crash, `.icalib-commit` still holds the new files that were not moved.
    committed = [] if _commit(folder) is None else [folder / COMMIT / name]
    for path in (*committed, folder / name):
        try:
            return path.read_bytes()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise CalibrationError(
                f"{path} cannot be read ({error.strerror or error}); check its permissions."
            ) from error
    raise CalibrationError(f"{folder} holds no {name}; give the folder that a calibration was written to.")


def finish_writing(folder: Path) -> None:
    """Finishes the move of a writer that was killed (step 3), so that other programs see the new files, too.

    Raises CalibrationError if the folder cannot be written.
    """
    with writing(folder):
        _move_in(folder)


def refuse_foreign_set(folder: Path, inputs: Iterable[Path] = ()) -> None:
    """Raises CalibrationError if a result in `folder` would overwrite one of `inputs`, or a file that icalib did not
    write or that was changed since."""
    commit = _commit(folder)
    names = set(OWN_FILES) | ({path.name for path in commit.iterdir()} if commit else set())
    refuse_foreign((folder / name for name in sorted(names)), inputs)


def set_of(folder: Path) -> list[Path]:
    """Paths of all files that a result in `folder` may have, whether they exist or not."""
    return [folder / name for name in OWN_FILES]


def check_writable(folder: Path) -> None:
    """Creates `folder` and writes to it, so that a long run does not fail at its end. Raises CalibrationError."""
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with staged(folder):
            pass


def _write_through(path: Path, content: bytes) -> None:
    with path.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())


def _move_in(folder: Path) -> None:
    """Moves the files of `.icalib-commit`, if it exists, into `folder`."""
    commit = _commit(folder)
    if commit is not None:
        for path in sorted(commit.iterdir()):
            path.replace(folder / path.name)
        commit.rmdir()


def _commit(folder: Path) -> Path | None:
    """Path of `.icalib-commit`; None if absent. Raises CalibrationError if it is a link, which icalib never creates."""
    commit = folder / COMMIT
    if commit.is_symlink():
        raise CalibrationError(f"{commit} is a link, which icalib never writes; remove it.")
    return commit if commit.is_dir() else None
