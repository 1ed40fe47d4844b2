"""`njit` for all kernels, with what keeps the first run short: it compiles all that later runs find on disk."""

from __future__ import annotations

import gc
import os
import threading
from typing import Any

os.environ.setdefault("NUMBA_OPT", "2")  # 3, numba's own, takes a sixth longer to compile; kernels are as fast with 2

import numba  # noqa: E402
from numba.core import event  # noqa: E402


def njit(**options: Any) -> Any:
    """numba.njit without an entry for callers in C, of which there are none."""
    decorator: Any = numba.njit
    return decorator(no_cfunc_wrapper=True, **options)


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
