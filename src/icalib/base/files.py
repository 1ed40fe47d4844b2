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
import gzip
import hashlib
import io
import json
import math
import os
import re
import shutil
import stat
import struct
import tempfile
import threading
import tokenize
import zipfile
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from errno import EINVAL
from math import isfinite
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

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


def refuse_unwritable(files: Iterable[Path | None], inputs: Iterable[Path | None]) -> None:
    """Raises CalibrationError if the folder of one of `files` does not exist, or as `refuse_foreign`; None: no file. To
    be called before a long run."""
    written = [path for path in files if path]
    for path in written:
        if not path.parent.is_dir():
            raise CalibrationError(f"{path} cannot be written (its folder does not exist); choose another place.")
    refuse_foreign(written, [path for path in inputs if path], "choose another place")


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


# Input files: their sha256, safe decompression, and files without readable data.
#
# The sha256 is computed while a file is read, so that large files are not read twice. A reader passes each block to
# `hash_of(path).saw`. `hexdigest` reads only the bytes after those that were passed.
#
# Decompression limits the unpacked size relative to the stored size, against decompression bombs. Files without
# readable data are pointers of Git LFS and git-annex, and videos in place of bags.

_NEAR = 1 << 20  # bytes: a gap up to this (headers, an index) between two blocks is read at once, to continue the hash
_BLOCK = 1 << 14  # bytes per read of `FileHash` itself; small, so that it needs no noticeable memory
_MOST = 200_000  # remembered hashes; each takes 0.5 kB


def regular(path: Path) -> Path:
    """`path`. Raises OSError if it does not exist, or is a pipe or a device, which may have no end."""
    if not (stat.S_ISREG(mode := path.stat().st_mode) or stat.S_ISDIR(mode)):
        raise OSError(EINVAL, "a pipe or a device, not a file", str(path))
    return path


class FileHash:
    """sha256 of a file that a reader reads at the same time, mostly from front to back, perhaps several times."""

    def __init__(self, path: Path) -> None:
        self._path, self._hash, self._at = path, hashlib.sha256(), 0
        self._beside: threading.Thread | None = None

    def saw(self, offset: int, content: bytes, file: BinaryIO | None = None) -> None:
        """Add `content`, which was read at byte `offset`. Bytes hashed before are skipped.

        A gap of up to 1 MiB before `offset` is read from `file`, whose position changes. After a larger gap, or without
        `file`, `content` is ignored, and `hexdigest` reads it again.
        """
        if file is not None and 0 < offset - self._at <= _NEAR:
            file.seek(self._at)
            self._add(file.read(offset - self._at))
        if offset <= self._at < offset + len(content):
            self._add(memoryview(content)[self._at - offset :])

    def read_beside(self) -> None:
        """Hash the file in a background thread, for readers that do not call `saw`."""

        def read_on() -> None:
            with contextlib.suppress(OSError):  # the file is gone by now; `hexdigest` says so
                self._read_on()

        if self._beside is None:
            self._beside = threading.Thread(target=read_on, daemon=True)
            self._beside.start()

    def hexdigest(self) -> str:
        """Hash of the whole file, in hexadecimal; reads the bytes that are not hashed yet. Raises OSError."""
        if self._beside is not None:
            self._beside.join()
        self._read_on()
        return self._hash.hexdigest()

    def _read_on(self) -> None:
        with self._path.open("rb") as file:
            file.seek(self._at)
            while block := file.read(_BLOCK):
                self._add(block)

    def _add(self, content: bytes | memoryview) -> None:
        self._hash.update(content)
        self._at += len(content)


_hashes: dict[tuple[str, int, int, int], FileHash] = {}


def hash_of(path: Path) -> FileHash:
    """The hash of the file in its current state, shared by all readers. A changed file (other inode, size or
    modification time) has a new one. Raises OSError."""
    about = path.stat()
    key = (str(path.absolute()), about.st_ino, about.st_size, about.st_mtime_ns)
    if key not in _hashes and len(_hashes) >= _MOST:
        _hashes.clear()
    return _hashes.setdefault(key, FileHash(path))


class HashedFile(io.FileIO):
    """A file opened for reading whose `read` also updates its hash (`hash_of`)."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._hash = hash_of(path)

    def read(self, size: int | None = -1, /) -> bytes:
        at = self.tell()
        content = super().read(-1 if size is None else size) or b""
        self._hash.saw(at, content)
        return content


FREE_BYTES, RATIO = 16 << 20, 256  # sensor data shrink to a tenth; uniform images and zeros shrink more
LIMIT_WORDS = f"{FREE_BYTES >> 20} MiB and {RATIO} times its size"
_NOT_ARRAYS = (
    OSError,
    ValueError,
    EOFError,
    KeyError,
    TypeError,
    SyntaxError,
    RuntimeError,
    OverflowError,
    MemoryError,
    struct.error,
    tokenize.TokenError,
    zlib.error,
    zipfile.BadZipFile,
)


class TooLargeError(ValueError):
    """The unpacked data exceed the limit for their stored size (`most_bytes`)."""

    def __init__(self) -> None:
        super().__init__(f"it unpacks to more than {LIMIT_WORDS}")


def most_bytes(stored: int) -> int:
    """Largest permitted size [bytes] after unpacking `stored` bytes."""
    return FREE_BYTES + RATIO * stored


def unpacked(decompressor: Any, stored: bytes) -> bytes:
    """`stored`, unpacked by a decompressor of bz2, lz4 or zstd. Raises TooLargeError, and the decompressor's errors."""
    most = most_bytes(len(stored))
    return _within(decompressor.decompress(stored, max_length=most + 1), most)


def gunzipped(stored: bytes) -> bytes:
    """`stored`, a gzip file, unpacked. Raises TooLargeError, and errors of the module gzip."""
    most = most_bytes(len(stored))
    with gzip.open(io.BytesIO(stored)) as file:
        return _within(file.read(most + 1), most)


def copy_unpacked(packed: BinaryIO, out: BinaryIO, stored: int) -> None:
    """Copies the unpacked content of `packed`, a file that decompresses `stored` bytes, to `out`.

    Raises TooLargeError, and errors of `packed`.
    """
    remaining = most_bytes(stored)
    while block := packed.read(1 << 16):  # small: the last block of a truncated file is lost
        remaining -= len(block)
        if remaining < 0:
            raise TooLargeError
        out.write(block)


def load_arrays(source: Path | bytes, names: Collection[str] | None = None) -> dict[str, np.ndarray]:
    """Arrays of an npz file by name, without pickle: all, or those of `names` that exist. source: path or content.

    Raises OSError if the file is not found, ValueError with the reason for any other failure.
    """
    in_memory = isinstance(source, bytes)
    stored = len(source) if in_memory else source.stat().st_size
    try:
        file = io.BytesIO(source) if in_memory else HashedFile(source)
        with file, zipfile.ZipFile(file) as archive:
            members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
            wanted = [name for name in members if names is None or name in names]
            if sum(members[name].file_size for name in wanted) > most_bytes(stored):
                raise TooLargeError
            return {name: _array(archive, members[name]) for name in wanted}
    except _NOT_ARRAYS as error:
        raise ValueError(next(iter(str(error).splitlines()), "") or type(error).__name__) from error


def _array(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> np.ndarray:
    """One array of an npz file. Raises ValueError for Python objects, and before memory is allocated if the size in the
    header differs from the stored one."""
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        shape, _, dtype = readers[version](file) if version in readers else ((-1,), False, np.dtype("O"))
        n_bytes = member.file_size - file.tell()
    if dtype.hasobject and version in readers:
        raise ValueError("Object arrays cannot be loaded: they may run programs")
    if dtype.hasobject or any(side < 0 for side in shape):
        raise ValueError(f"{member.filename} is not an array of numbers")
    if math.prod(shape) * dtype.itemsize != n_bytes:
        raise ValueError(f"{member.filename} does not have the size that its header states")
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _within(content: bytes, most: int) -> bytes:
    if len(content) > most:
        raise TooLargeError
    return content


VIDEO_FILE = "video file"  # `TopicInfo.type` of a video
CLOUD_SUFFIXES = (".pcd", ".ply", ".bin")  # of files with one point cloud each
HEAD_BYTES = 64  # length of `head` for `not_data`
VIDEO_SUFFIXES = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".h264", ".h265", ".mjpeg", ".insv", ".360")
_POINTERS = {b"version https://git-lfs.github.com/spec": "git lfs pull", b"/annex/objects/": "git annex get"}
_CONTAINERS = ((4, b"ftyp"), (0, b"\x1aE\xdf\xa3"), (8, b"AVI "))  # MP4 and MOV, Matroska and WebM, AVI


def not_data(path: Path, head: bytes) -> str | None:
    """Error message if a file that begins with `head` is a pointer of Git LFS or git-annex, or a video; else None."""
    for magic, command in _POINTERS.items():
        if head.startswith(magic):
            return f"{path} is a pointer to a file that was not downloaded; run `{command}` where it comes from."
    if any(head[at : at + len(magic)] == magic for at, magic in _CONTAINERS):
        return f"{path} is a video; give the folder that it lies in as the recording."
    return None


def is_video(path: Path) -> bool:
    """True if the suffix is that of a video file."""
    return path.suffix.lower() in VIDEO_SUFFIXES
