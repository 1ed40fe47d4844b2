"""`njit`: numba's decorator, with settings for the compilation and disk cache of all kernels of icalib."""

from __future__ import annotations

import gc
import hashlib
import os
import threading
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("NUMBA_OPT", "2")  # numba's default, 3, compiles a sixth longer; kernels run no faster

import numba  # noqa: E402
from numba.core import event  # noqa: E402


@cache
def fingerprint(package: Path = Path(__file__).parents[1]) -> str:
    """Hex digest (BLAKE2b, 128 bits) of all source files of `package` that define kernels, or named tuples, which are
    arguments of kernels."""
    digest = hashlib.blake2b(digest_size=16)
    for file in sorted(package.rglob("*.py")):
        text = file.read_bytes()
        if b"njit" in text or b"NamedTuple" in text:
            digest.update(text)
    return digest.hexdigest()


def njit(**options: Any) -> Any:
    """numba.njit with `options`, without the wrapper for calls from C, and with a safer disk cache.

    A change of any kernel invalidates the cache of all, by `fingerprint`. numba checks only the source file of the
    kernel itself, not those of kernels that it calls. numba also unpickles the cache index before this check, which
    fails after an upgrade that removed a class.
    """
    make: Any = numba.njit  # the type stubs of numba lack no_cfunc_wrapper
    decorator = make(no_cfunc_wrapper=True, **options)

    def compiled(function: Any) -> Any:
        dispatcher = decorator(function)
        index = getattr(dispatcher._cache, "_cache_file", None)  # None if the options do not ask for a cache
        if index is not None:
            index._version = f"{index._version} {fingerprint()}"
        return dispatcher

    return compiled


class _NoCollection(event.Listener):
    """Disables the garbage collector while numba compiles. Compilation creates millions of objects, most of which stay,
    and their collection took a sixth of the time."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._depth = 0  # compilations in progress: they nest (kernels call kernels), and threads overlap
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
