"""Section of a stream: consecutive readings, images or scans."""

from __future__ import annotations

import dataclasses
from typing import Any, Protocol, TypeVar

import numpy as np


class Stamped(Protocol):
    """A stream, checked or raw: a frozen dataclass of arrays, one of them stamps_ns (N,) int64."""

    @property
    def name(self) -> str: ...
    @property
    def stamps_ns(self) -> np.ndarray: ...


S = TypeVar("S", bound=Stamped)


def section(stream: S, begin: int, end: int) -> S:
    """The stream with stamps `begin` to before `end` of its N stamps.

    With an array `start` (N + 1,), the rows of stamp k are start[k] to start[k + 1]. Arrays of length N - 1 refer to
    the intervals between stamps.
    """
    n = len(stream.stamps_ns)
    if (begin, end) == (0, n):
        return stream
    start = getattr(stream, "start", None)
    rows = slice(begin, end) if start is None else slice(int(start[begin]), int(start[end]))
    changed: dict[str, Any] = {}
    for field in dataclasses.fields(stream):  # pyright: ignore[reportArgumentType]
        value = getattr(stream, field.name)
        if not isinstance(value, np.ndarray):
            continue
        if field.name == "stamps_ns" or (start is None and len(value) == n):
            changed[field.name] = value[begin:end]
        elif field.name == "start":
            changed[field.name] = value[begin : end + 1] - value[begin]
        elif start is None:  # (n - 1,): one for each interval between stamps
            changed[field.name] = value[begin : max(end - 1, begin)]
        else:
            changed[field.name] = value[rows]
    return dataclasses.replace(stream, **changed)  # pyright: ignore[reportArgumentType, reportCallIssue]
