"""When the solver takes its steps for creeping, and how it damps them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from tests.cases import each

from icalib.estimate.solver import CAREFUL_DAMPING, Damping, Descent, Step


@each(
    ("promised", "accepted", "creeps"),
    [((8.0, 6.0), (True, True), True), ((20.0, 12.0), (True, True), False), ((8.0, 6.0), (True, False), False)],
)
def test_steps_that_fail_do_not_creep(promised: tuple[float, ...], accepted: tuple[bool, ...], creeps: bool):
    """After a step that failed the next one, damped, promises nearly as much: nothing that noise leads."""
    steps = [Step(1e3, p, 0.0, a) for p, a in zip(promised, accepted, strict=True)]
    descent, solution = (cast(Any, SimpleNamespace(**f)) for f in ({"steps": steps}, {"decrease": 5.0}))
    assert Descent.converges_slowly(descent, solution) == creeps


def test_damping_stays_near_what_the_last_failure_asked_for():
    """It grows by 2, 4, 8 and shrinks by a third at most, until one good step follows another."""
    damping = Damping(CAREFUL_DAMPING)
    grown = []
    for _ in range(5):
        damping.after_failure()
        grown.append(damping.value / CAREFUL_DAMPING.least_after_failure)
    assert grown == pytest.approx([1.0, 4.0, 32.0, 512.0, 16384.0])
    damping.after_success(curved=False, gain=1.0)
    assert damping.value == pytest.approx(grown[-1] * CAREFUL_DAMPING.least_after_failure / 3.0)
    before = damping.value
    damping.after_success(curved=False, gain=1.0)
    assert damping.value == pytest.approx(CAREFUL_DAMPING.min_factor * before)
    damping.after_success(curved=False, gain=0.1)
    assert damping.value == pytest.approx(CAREFUL_DAMPING.min_factor * before)
    damping.after_success(curved=True, gain=0.5)
    assert damping.curved and damping.value == pytest.approx(CAREFUL_DAMPING.min_factor * before)
