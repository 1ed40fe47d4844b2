"""Kernels compile without the garbage collector, which is afterwards as it was."""

from __future__ import annotations

import gc
from pathlib import Path

import numpy as np
import pytest
from numba.core import event

from icalib.base.compiled import fingerprint, njit
from icalib.geometry import so3


@pytest.mark.parametrize("enabled", [True, False])
def test_the_garbage_collector_rests_while_a_kernel_is_compiled(enabled: bool, monkeypatch):
    @njit()
    def inner(x):
        return x + 1

    @njit()
    def kernel(x):
        return 2 * inner(x)

    listener, before = event.RecordingListener(), gc.isenabled()
    during: list[bool] = []
    monkeypatch.setattr(listener, "on_start", lambda _: during.append(gc.isenabled()))
    try:
        (gc.enable if enabled else gc.disable)()
        with event.install_listener("numba:compile", listener):
            assert kernel(1) == 4
        assert (during, gc.isenabled()) == ([False, False], enabled)
    finally:
        (gc.enable if before else gc.disable)()


def test_caches_are_of_the_kernels_as_they_are(tmp_path: Path):
    (tmp_path / "other.py").write_text("x = 1")
    empty = fingerprint(tmp_path)
    (tmp_path / "other.py").write_text("x = 2")
    fingerprint.cache_clear()
    assert fingerprint(tmp_path) == empty
    (tmp_path / "callee.py").write_text("@njit()\ndef f(x): return x")
    fingerprint.cache_clear()
    first = fingerprint(tmp_path)
    (tmp_path / "callee.py").write_text("@njit()\ndef f(x): return -x")
    fingerprint.cache_clear()
    assert len({empty, first, fingerprint(tmp_path)}) == 3
    assert so3.exp._cache._cache_file._version.endswith(fingerprint())


def test_an_index_of_other_kernels_is_not_unpickled(tmp_path: Path):
    index = so3.exp._cache._cache_file
    path = Path(index._index_path)
    so3.exp(np.zeros(3))
    assert index._load_index()
    old = tmp_path / "old.nbi"
    old.write_bytes(path.read_bytes().replace(fingerprint().encode(), b"0" * len(fingerprint())) + b"garbage")
    other = type(index)(str(tmp_path), "old", index._source_stamp)
    other._version = index._version
    assert other._load_index() == {}
