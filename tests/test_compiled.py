"""Kernels compile without the garbage collector, which is afterwards as it was."""

from __future__ import annotations

import gc

import pytest
from numba.core import event

from icalib.base.compiled import njit


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
