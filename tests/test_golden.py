"""The golden record's comparison finds every kind of change."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest


@pytest.fixture(scope="module")
def golden(benchmark_program) -> Any:
    return benchmark_program("golden")


@pytest.fixture
def record(golden: Any) -> Any:
    values = {"cam0.translation": [0.1, -0.2, 0.0], "cam0.rotation": [1.0, *[0.0] * 3, 1.0, *[0.0] * 3, 1.0]}
    std = {"cam0.translation": [1e-3, 2e-3, 1e-3], "cam0.rotation": [1e-3] * 3}
    verdict = {key: ["determined"] * 3 for key in values}
    return golden.Record(values, std, verdict, True, 100.0, 10, 1.0)


def test_a_record_equals_itself(golden: Any, record: Any):
    assert golden.is_equal(golden.changed(record, record), None)


@pytest.mark.parametrize("where", ["values", "std"])
def test_a_change_of_a_millionth_is_found(golden: Any, record: Any, where: str):
    numbers = getattr(record, where)
    other = replace(
        record, **{where: numbers | {"cam0.translation": [x * (1.0 + 1e-6) for x in numbers["cam0.translation"]]}}
    )
    change = golden.changed(record, other)
    assert change.relative == pytest.approx(1e-6, rel=1e-3)
    assert not golden.is_equal(change, None) and golden.is_equal(change, 0.05)


def test_a_value_of_zero_is_compared_with_its_standard_deviation(golden: Any, record: Any):
    moved = replace(record, values=record.values | {"cam0.translation": [0.1, -0.2, 1e-4]})
    change = golden.changed(record, moved)
    assert change.moved == pytest.approx(0.1) and change.relative == pytest.approx(0.1)
    assert not golden.is_equal(change, 0.05)


@pytest.mark.parametrize(
    "other",
    [
        {"verdict": {"cam0.translation": ["weak"] * 3, "cam0.rotation": ["determined"] * 3}},
        {"converged": False},
        {"values": {"cam0.translation": [0.1, -0.2, 0.0]}},
        {"std": {"cam0.translation": [1e-3, 2e-3, 0.0], "cam0.rotation": [1e-3] * 3}},
    ],
)
def test_other_changes_are_named(golden: Any, record: Any, other: dict[str, Any]):
    change = golden.changed(record, replace(record, **other))
    assert change.words and not golden.is_equal(change, 0.05)
