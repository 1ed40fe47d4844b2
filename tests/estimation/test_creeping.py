"""When the solver takes its steps for creeping."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from icalib.estimation.outcome import Step
from icalib.estimation.solver import _Descent


@pytest.mark.parametrize(
    ("promised", "accepted", "creeps"),
    [((8.0, 6.0), (True, True), True), ((20.0, 12.0), (True, True), False), ((8.0, 6.0), (True, False), False)],
)
def test_steps_that_fail_do_not_creep(promised: tuple[float, ...], accepted: tuple[bool, ...], creeps: bool):
    """After a step that failed the next one, damped, promises nearly as much: nothing that noise leads."""
    steps = [Step(1e3, p, 0.0, a) for p, a in zip(promised, accepted, strict=True)]
    descent, solution = (cast(Any, SimpleNamespace(**f)) for f in ({"steps": steps}, {"decrease": 5.0}))
    assert _Descent.creeps(descent, solution) == creeps
