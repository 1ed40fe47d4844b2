"""Records of tasks as JSON, and messages on failed tasks."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from icalib.errors import CalibrationError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def record_json(record: DataclassInstance, form: int) -> bytes:
    """JSON of a dataclass of arrays and plain values, with all digits; form: number of the file format."""
    return json.dumps({"format": form} | asdict(record), default=lambda array: array.tolist()).encode()


def plain_record(text: bytes, form: int) -> dict[str, Any]:
    """The fields of the dataclass that `record_json` wrote, as plain values. Raises ValueError, KeyError or TypeError
    if `text` is not such a record of format `form`."""
    plain: dict[str, Any] = json.loads(text)
    if plain.pop("format") != form:
        raise ValueError("another format")
    return plain


def sentence_on(error: Exception) -> str:
    """The message for the record of a failed task, which does not stop the others. An unexpected exception is reported
    as a fault of icalib."""
    if isinstance(error, CalibrationError):
        return str(error)
    return f"the program failed ({type(error).__name__}: {error}), which is a fault of icalib; please report it."


def check_worker(worker_program: str, local_program: str) -> None:
    """Raises CalibrationError if the digest of the worker's program differs from that on this machine."""
    if worker_program != local_program:
        raise CalibrationError(
            "a worker of the cluster runs another version of icalib than this machine; install the same "
            "version everywhere."
        )
