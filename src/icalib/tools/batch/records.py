"""What a task leaves behind, as JSON, and what is said where it failed."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from icalib.errors import CalibrationError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def record_json(record: DataclassInstance, form: int) -> bytes:
    """A dataclass of arrays and plain values, numbers in full; form: number of its format."""
    return json.dumps({"format": form} | asdict(record), default=lambda array: array.tolist()).encode()


def plain_record(text: bytes, form: int) -> dict[str, Any]:
    """The fields that `record_json` was given. Raises ValueError, KeyError or TypeError where `text` is something
    else."""
    plain: dict[str, Any] = json.loads(text)
    if plain.pop("format") != form:
        raise ValueError("another format")
    return plain


def sentence_on(caught: Exception) -> str:
    """A fault of the program must not end the work on a thousand tasks, nor be lost in it."""
    if isinstance(caught, CalibrationError):
        return str(caught)
    return f"the program failed ({type(caught).__name__}: {caught}), which is a fault of icalib; please report it."


def check_worker(by: str, here: str) -> None:
    """Raises CalibrationError where a task was done `by` another program than that of `here`, who asked for it."""
    if by != here:
        raise CalibrationError(
            "a worker of the cluster runs another version of icalib than this machine; install the same "
            "version everywhere."
        )
