"""`njit` for all kernels, with what keeps the first run short: it compiles all that later runs find on disk."""

from __future__ import annotations

import gc
import hashlib
import os
import threading
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("NUMBA_OPT", "2")  # 3, numba's own, takes a sixth longer to compile; kernels are as fast with 2

import numba  # noqa: E402
from numba.core import event  # noqa: E402


@cache
def fingerprint(package: Path = Path(__file__).parents[1]) -> str:
    """Hash of all files of `package` that have kernels, or the named tuples that kernels take."""
    found = hashlib.blake2b(digest_size=16)
    for file in sorted(package.rglob("*.py")):
        text = file.read_bytes()
        if b"njit" in text or b"NamedTuple" in text:
            found.update(text)
    return found.hexdigest()


def njit(**options: Any) -> Any:
    """numba.njit without an entry for callers in C, of which there are none, and whose cache on disk is not read after
    any kernel has changed.

    numba compares the file of a kernel with its cache, not the files of kernels that it calls. It also unpickles the
    index of a cache before it compares, which fails where a class is there no more, as after an upgrade in place.
    """
    make: Any = numba.njit  # its overloads do not know of this option
    decorator = make(no_cfunc_wrapper=True, **options)

    def compiled(function: Any) -> Any:
        dispatcher = decorator(function)
        index = getattr(dispatcher._cache, "_cache_file", None)  # none without a cache
        if index is not None:
            index._version = f"{index._version} {fingerprint()}"
        return dispatcher

    return compiled


class _NoCollection(event.Listener):
    """Holds the garbage collector while numba compiles: it makes objects by the million, nearly all of which stay, and
    looking through them took a sixth of the time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth = 0  # compiling a kernel compiles those that it calls; threads may compile at once
        self._enabled = False

    def on_start(self, event: Any) -> None:
        with self._lock:
            if self._depth == 0:
                self._enabled = gc.isenabled()
                gc.disable()
            self._depth += 1

    def on_end(self, event: Any) -> None:
        with self._lock:
            self._depth -= 1
            if self._depth == 0 and self._enabled:
                gc.enable()


event.register("numba:compile", _NoCollection())
