"""The golden record's comparison finds every kind of change."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest


@pytest.fixture(scope="module")
def golden(benchmark_program) -> Any:
    return benchmark_program("golden_record")


@pytest.fixture
def record(golden: Any) -> Any:
    values = {"cam0.translation": [0.1, -0.2, 0.0], "cam0.rotation": [1.0, *[0.0] * 3, 1.0, *[0.0] * 3, 1.0]}
    std = {"cam0.translation": [1e-3, 2e-3, 1e-3], "cam0.rotation": [1e-3] * 3}
    verdict = {key: ["determined"] * 3 for key in values}
    texts = {"overall": "weak", "reasons": ["it moves by 2.5e-3 m."], "notes": ["cam0 is off.", "imu0 is off."]}
    return golden.Record(
        values, std, verdict, True, 100.0, 10, 1.0, **texts, files={"report.html": "a", "console": "b"}
    )


def test_a_record_equals_itself(golden: Any, record: Any):
    change = golden.changed(record, record)
    assert golden.is_equal(change, None) and not change.texts


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


def test_a_change_of_chi2_is_found(golden: Any, record: Any):
    change = golden.changed(record, replace(record, chi2=100.001))
    assert change.relative == pytest.approx(1e-5) and not golden.is_equal(change, None)


@pytest.mark.parametrize(
    "other",
    [
        {"verdict": {"cam0.translation": ["weak"] * 3, "cam0.rotation": ["determined"] * 3}},
        {"converged": False},
        {"values": {"cam0.translation": [0.1, -0.2, 0.0]}},
        {"std": {"cam0.translation": [1e-3, 2e-3, 0.0], "cam0.rotation": [1e-3] * 3}},
        {"overall": "usable"},
    ],
)
def test_other_changes_are_named(golden: Any, record: Any, other: dict[str, Any]):
    change = golden.changed(record, replace(record, **other))
    assert change.words and not golden.is_equal(change, 0.05)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"notes": ["cam0 is off."]}, ("notes: went: imu0 is off.",)),
        ({"reasons": []}, ("reasons: went: it moves by 2.5e-3 m.",)),
        ({"reasons": ["it moves by 2.5e-3 m.", "no IMU."]}, ("reasons: came: no IMU.",)),
        ({"refusal": "no images."}, ("refusal: came: no images.",)),
    ],
)
def test_sentences_that_come_or_go_are_named(golden: Any, record: Any, other: dict[str, Any], said: tuple[str, ...]):
    change = golden.changed(record, replace(record, **other))
    assert change.sentences == said and not golden.is_equal(change, 0.05)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"files": {"report.html": "c", "console": "b"}}, ("report.html differs",)),
        ({"files": {"report.html": "a"}}, ("console differs",)),
        ({"notes": ["imu0 is off.", "cam0 is off."]}, ("notes: in another order",)),
        (
            {"reasons": ["it moves by 0.0031 m."]},
            ("reasons: went: it moves by 2.5e-3 m.", "reasons: came: it moves by 0.0031 m."),
        ),
    ],
)
def test_files_and_numbers_in_sentences_may_differ_with_a_new_solver_only(
    golden: Any, record: Any, other: dict[str, Any], said: tuple[str, ...]
):
    change = golden.changed(record, replace(record, **other))
    assert change.texts == said and not change.sentences
    assert not golden.is_equal(change, None) and golden.is_equal(change, 0.05)


def test_a_refusal_is_recorded_without_the_folder_of_the_case(golden: Any, benchmark_program, tmp_path):
    cases = benchmark_program("golden_cases").CASES
    first, second = (golden.record_case(cases["wrong-rig-file"], tmp_path) for _ in range(2))
    assert first.refusal == second.refusal and first.refusal.startswith("rig.yaml")


def test_each_case_is_stored(benchmark_program):
    stored = {file.stem for file in benchmark_program("golden").FOLDER.glob("*.json")}
    assert stored == set(benchmark_program("golden_cases").CASES)
