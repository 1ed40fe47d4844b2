"""Recognizes files that icalib wrote: each ends in a seal, the sha256 of all bytes before it.

A file without a valid seal was written or changed by the user, and is never replaced or deleted. The seal is a comment,
or in JSON the last key. Databases and Rerun files have no seal and are recognized by their header.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

from icalib.errors import CalibrationError

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
