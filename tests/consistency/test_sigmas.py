"""Standard deviations are as large as errors, for every kind of sensor: 1.3 times too small or too large fails."""

from __future__ import annotations

from collections.abc import Callable
from types import ModuleType

import pytest

FIRST_SEED = 1000


@pytest.fixture(scope="module")
def program(benchmark_program: Callable[[str], ModuleType]) -> ModuleType:
    """It makes as many rounds of the same as one likes, with other seeds."""
    return benchmark_program("nees")


RATES = [f"imu at {rate} Hz" for rate in (100, 200, 400, 1000)]
NAMES = ["board", "tracks", "drive", "poses", "imus", *RATES]
ONLY_IN_FULL = {"poses", *RATES}
MOST_BIAS = 4.5  # standard deviations of a mean; an honest component exceeds it once in 150 000


@pytest.mark.parametrize("name", [pytest.param(n, marks=pytest.mark.full if n in ONLY_IN_FULL else ()) for n in NAMES])
def test_errors_are_as_large_as_their_standard_deviations(program: ModuleType, name: str):
    """The bounds hold every honest round but one in a thousand; `python benchmarks/nees.py` draws other seeds."""
    found = program.judge(program.CASES[name](), FIRST_SEED)
    assert found[0].dof >= program.LEAST_DOF
    assert [str(kind) for kind in found if not kind.consistent or kind.bias > MOST_BIAS] == []


def test_all_cases_are_tested(program: ModuleType):
    assert list(program.CASES) == NAMES
