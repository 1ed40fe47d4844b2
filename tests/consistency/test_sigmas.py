"""Standard deviations are as large as errors, for every kind of sensor: 1.3 times too small or too large fails."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

PROGRAM = Path(__file__).parents[2] / "benchmarks" / "nees.py"
FIRST_SEED = 1000


@pytest.fixture(scope="module")
def program() -> ModuleType:
    """It makes as many rounds of the same as one likes, with other seeds."""
    spec = importlib.util.spec_from_file_location("nees_of_short_recordings", PROGRAM)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["board", "tracks", "drive", "poses"])
def test_errors_are_as_large_as_their_standard_deviations(program: ModuleType, name: str):
    """The bounds hold every honest round but one in a thousand; `python benchmarks/nees.py` draws other seeds."""
    found = program.judge(program.CASES[name](), FIRST_SEED)
    assert found[0].dof >= program.LEAST_DOF
    assert [str(kind) for kind in found if not kind.consistent] == []


def test_all_cases_are_tested(program: ModuleType):
    assert list(program.CASES) == ["board", "tracks", "drive", "poses"]
