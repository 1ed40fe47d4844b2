"""Files that icalib writes: never incomplete for a reader, and never in place of a file of the user.

Names from input files are checked before they become names of files. Files are written in hidden temporary folders of
the output folder; those left by killed processes are removed. An error of writing has the path and advice.

Each file ends in a seal, the sha256 of all bytes before it. A file without a valid seal was written or changed by the
user, and is never replaced or deleted. The seal is a comment, or in JSON the last key. Databases and Rerun files have
no seal and are recognized by their header.

A set of result files is replaced as a whole: after a crash the folder holds the complete old or new set.

1. The new files are written to a hidden subfolder and flushed.
2. The subfolder is renamed to `.icalib-commit`. From here on the new set is valid.
3. The files are moved one by one from `.icalib-commit` into the folder.

After a crash during step 3, readers look into `.icalib-commit` first, and the next writer finishes the move. Files that
icalib did not write stay unchanged.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from math import isfinite
from pathlib import Path
from typing import Any

from icalib.base.input_files import regular
from icalib.errors import CalibrationError

NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]{0,99}")  # valid name of a sensor or target
NAME_WORDS = "a letter, then up to 99 letters, digits, _ or -"


def below(folder: Path, name: str) -> Path:
    """`folder / name`. Raises CalibrationError if this is not a file directly in `folder`."""
    if name in ("", ".", "..") or any(c in name for c in "/\\\0"):
        raise CalibrationError(f"{name!r} cannot be the name of a file in {folder}; rename this sensor or target.")
    return folder / name


@contextmanager
def writing(path: Path, advice: str = "choose another folder") -> Iterator[None]:
    """Context in which `path` is written. Raises CalibrationError in place of OSError."""
    try:
        yield
    except OSError as error:
        raise CalibrationError(f"{path} cannot be written ({error.strerror or error}); {advice}.") from error


try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

PREFIX = ".icalib-staging-"


@contextlib.contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """Context manager: a new hidden folder in the existing `folder`, removed at exit with its content.

    The process locks the hidden folder; the lock ends with the process. Hidden folders without a lock are leftovers of
    killed processes and are removed. Raises OSError.
    """
    with _locked(folder):
        _remove_leftovers(folder)
        place = Path(tempfile.mkdtemp(prefix=PREFIX, dir=folder))
        lock = _lock(place, wait=True)
    try:
        yield place
    finally:
        shutil.rmtree(place, ignore_errors=True)
        _release(lock)


def _remove_leftovers(folder: Path) -> None:
    for old in folder.glob(f"{PREFIX}*"):
        if old.is_symlink() or not old.is_dir():
            continue
        with contextlib.suppress(OSError):  # a folder of another user
            lock = _lock(old, wait=False)
            if lock is not None:
                shutil.rmtree(old, ignore_errors=True)
            _release(lock)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    lock = _lock(folder, wait=True)
    try:
        yield
    finally:
        _release(lock)


def _lock(folder: Path, wait: bool) -> int | None:
    """Descriptor of the locked `folder`; None if another process has the lock, or the system has no flock.

    wait: wait until the lock is free.
    """
    if fcntl is None:
        return None
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except OSError:
        os.close(handle)
        return None
    return handle


def _release(lock: int | None) -> None:
    if lock is not None:
        os.close(lock)


def printable(text: str) -> str:
    """`text` that UTF-8 can encode: lone surrogates become escapes such as \\udcfc.

    Python represents bytes of a file name that are not UTF-8 as lone surrogates. JSON and quoted YAML read the escapes
    back as the same name.
    """
    return text.encode("utf-8", "backslashreplace").decode("utf-8")


def json_text(plain: Any) -> str:
    """`plain` (dicts, lists, numbers, text) as JSON. NaN and infinity become null, as JSON lacks them."""
    return json.dumps(_finite(plain), indent=1, ensure_ascii=False, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    return None if isinstance(value, float) and not isfinite(value) else value


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Writes `texts` (name -> content) into `folder`, created if needed. Each file is replaced atomically, after all
    new files were written to a temporary folder. Raises CalibrationError if the folder cannot be written."""
    with writing(folder, "choose another place"):
        folder.mkdir(parents=True, exist_ok=True)
        with staged(folder) as place:
            for name, text in texts.items():
                write_text(below(place, name), text)
            for name in texts:
                (place / name).replace(folder / name)


def write_sealed(path: Path, text: str) -> None:
    """Writes `text` with the seal of `sealed_texts` to `path`, atomically. Raises CalibrationError as `write_texts`."""
    write_texts(path.parent, sealed_texts({path.name: text}))


def write_text(path: Path, text: str) -> None:
    """Writes `text` in UTF-8, with unchanged line ends and without atomicity. Bytes that are not UTF-8 are preserved
    (surrogateescape). Raises OSError."""
    with path.open("w", encoding="utf-8", errors="surrogateescape", newline="") as file:
        file.write(text)


SEAL = "icalib_sha256"  # key of the seal in JSON
_COMMENT = re.compile(rb"(?:# |% |<!-- )icalib sha256 ([0-9a-f]{64})(?: -->)?\r?\n\Z")
_LAST_KEY = re.compile(rb',\s*"icalib_sha256": "([0-9a-f]{64})"\n\}\]?\Z')
_ARCHIVE = re.compile(rb"(?s:..)icalib sha256 ([0-9a-f]{64})\n\Z")  # length (2 bytes) and text of a zip comment
_ZIP = b"PK\x03\x04"
_LONGEST_SEAL = 200  # bytes
_DATABASE, _DATABASE_ID_AT = b"SQLite format 3\x00", 68
DATABASE_ID = 0x49434C42  # "ICLB": SQLite application id of databases that icalib writes
_RERUN = (b"RRF2", b"RRIO", b"RRIX")
_RERUN_HEAD = 4096  # bytes at the begin of a Rerun file that contain the name of the program


def sealed(content: bytes) -> bytes:
    """`content` of a file with a seal appended: a comment with its sha256, by which `is_ours` recognizes the file.

    The seal replaces an earlier one. content: npz, XML, HTML, PDF, JSON (an object, or a list that ends with one), or
    text whose comments begin with #. All other formats get the comment of a text, so they must allow bytes after their
    end, as PNG does.
    """
    content = _COMMENT.sub(b"", content)  # an earlier seal: the content comes from a file of icalib
    if content.startswith(_ZIP):  # npz by numpy has no comment: its last 2 bytes are the length 0
        comment = f"icalib sha256 {hashlib.sha256(content[:-2]).hexdigest()}\n".encode()
        return content[:-2] + len(comment).to_bytes(2, "little") + comment
    head = content.removeprefix(b"\xef\xbb\xbf").lstrip()[:1]
    if head in (b"{", b"["):
        end = "]" if head == b"[" else ""
        body = content.rstrip().removesuffix(end.encode()).rstrip().removesuffix(b"}").rstrip()
        return body + f',\n "{SEAL}": "{hashlib.sha256(body).hexdigest()}"\n}}{end}'.encode()
    body = content if content.endswith(b"\n") else content + b"\n"
    begin, end = {b"<": ("<!-- ", " -->"), b"%": ("% ", "")}.get(head, ("# ", ""))
    if head == b"%" and not content.startswith(b"%PDF"):  # YAML as OpenCV writes it
        begin = "# "
    line_end = "\r\n" if body.endswith(b"\r\n") else "\n"
    return body + f"{begin}icalib sha256 {hashlib.sha256(body).hexdigest()}{end}{line_end}".encode()


def sealed_texts(texts: dict[str, str]) -> dict[str, str]:
    """`texts` (name -> content), each `sealed`. Bytes that are not UTF-8 are preserved (surrogateescape)."""
    return {
        name: sealed(text.encode("utf-8", "surrogateescape")).decode("utf-8", "surrogateescape")
        for name, text in texts.items()
    }


def is_ours(path: Path) -> bool:
    """True if icalib wrote the file and nobody changed it since, so that it may be replaced or deleted.

    The sha256 in the seal must match the file. A database or a Rerun file has no seal: its header suffices, and changes
    are not noticed.

    Raises OSError.
    """
    if path.is_symlink() or not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(_RERUN_HEAD)
    if head.startswith(_DATABASE):
        return int.from_bytes(head[_DATABASE_ID_AT : _DATABASE_ID_AT + 4]) == DATABASE_ID
    if head.startswith(_RERUN):
        return b"icalib" in head
    return _has_seal(path, (_ARCHIVE,) if head.startswith(_ZIP) else (_COMMENT, _LAST_KEY))


def refuse_foreign(paths: Iterable[Path], inputs: Iterable[Path] = (), advice: str = "choose another folder") -> None:
    """Raises CalibrationError if writing `paths` would overwrite one of `inputs`, or an existing file that `is_ours`
    does not recognize. advice: end of the message."""
    input_paths = {path.resolve() for path in inputs}
    for path in paths:
        try:
            if not (path.exists() or path.is_symlink()):
                continue
            if path.resolve() in input_paths:
                raise CalibrationError(f"{path} is an input of this command and would be overwritten; {advice}.")
            if path.is_dir():
                raise CalibrationError(f"{path} cannot be written (it is a folder); {advice}.")
            if not is_ours(path):
                raise CalibrationError(
                    f"{path} was not written by icalib, or was changed since, and would be overwritten; move it away, "
                    f"or {advice}."
                )
        except OSError as error:
            raise CalibrationError(f"{path} cannot be read ({error.strerror or error}); {advice}.") from error


def refuse_existing(path: Path, advice: str = "give another name") -> None:
    """Raises CalibrationError if `path` exists, whoever wrote it. advice: end of the message."""
    if os.path.lexists(path):
        raise CalibrationError(f"{path} exists and was not changed; {advice}.")


def write_new(path: Path, text: str) -> None:
    """Writes `text` to `path` atomically. Raises CalibrationError if `path` exists or cannot be written."""
    with writing(path, "choose another place"):
        try:
            with staged(path.parent) as place:
                write_text(place / path.name, text)
                _link(place / path.name, path, text)
        except FileExistsError:
            raise CalibrationError(f"{path} exists and was not changed; give another name.") from None


def _link(part: Path, path: Path, text: str) -> None:
    """Gives the file `part` the name `path`. Unlike a rename, this raises FileExistsError if `path` exists."""
    try:
        os.link(part, path)
    except FileExistsError:
        raise
    except OSError:  # a file system without links
        with path.open("x", encoding="utf-8") as file:
            file.write(text)


def _has_seal(path: Path, kinds: tuple[re.Pattern[bytes], ...]) -> bool:
    size = path.stat().st_size
    with path.open("rb") as file:
        begin = max(0, size - _LONGEST_SEAL)
        file.seek(begin)
        tail = file.read()
        seal = next((match for kind in kinds if (match := kind.search(tail))), None)
        if seal is None:
            return False
        file.seek(0)
        digest, n_bytes = hashlib.sha256(), begin + seal.start()
        while n_bytes and (block := file.read(min(n_bytes, 1 << 20))):
            digest.update(block)
            n_bytes -= len(block)
    return digest.hexdigest() == seal[1].decode()


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
            return regular(path).read_bytes()
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
