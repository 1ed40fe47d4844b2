"""Each remark of a result has an identifier that the docs list, and the sentence that sentences.yaml pins.

Every remark of every test is compared with sentences.yaml as well (`_pinned_sentences` of conftest.py).
"""

from __future__ import annotations

import ast
import copy
import json
import pickle
import re
from collections import Counter
from pathlib import Path

import pytest
from tests.remarks import is_pinned, named, names, sentences

import icalib
from icalib.base.remark import Remark

SOURCE = Path(icalib.__file__).parent
ROOT = Path(__file__).parents[1]
BY_VARIABLE = {"base/remark.py", "result/saving.py"}  # copies of a remark, and remarks of a file


def identifiers(source: str) -> list[str | None]:
    """First argument of each call of `Remark`; None if it is no text."""
    calls = (node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call))
    first = (call.args[0] for call in calls if isinstance(call.func, ast.Name) and call.func.id == "Remark")
    return [arg.value if isinstance(arg, ast.Constant) and isinstance(arg.value, str) else None for arg in first]


@pytest.fixture(scope="module")
def composed() -> list[str | None]:
    modules = (m for m in SOURCE.rglob("*.py") if m.relative_to(SOURCE).as_posix() not in BY_VARIABLE)
    return [name for m in sorted(modules) for name in identifiers(m.read_text(encoding="utf-8"))]


def test_each_identifier_is_composed_at_one_place(composed: list[str | None]):
    assert {name: n for name, n in Counter(composed).items() if n > 1 or name is None} == {}


def test_identifiers_are_two_to_six_words(composed: list[str | None]):
    assert [name for name in composed if not re.fullmatch(r"[a-z]+(_[a-z]+){1,5}", name or "")] == []


def test_docs_list_all_identifiers_and_no_others(composed: list[str | None]):
    page = (ROOT / "docs" / "reasons.md").read_text(encoding="utf-8")
    assert sorted(re.findall(r"^\| `(\w+)` \|", page, re.MULTILINE)) == sorted(filter(None, composed))


def test_sentences_are_pinned_for_all_identifiers_and_no_others(composed: list[str | None]):
    assert sorted(sentences()) == sorted(filter(None, composed))


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ('yield Remark("clock_drifts", f"{x} drifts")', ["clock_drifts"]),
        ('a = Remark(name, "x") if b else Remark("b_c", "x")', [None, "b_c"]),
        ('print("Remark")', []),
    ],
)
def test_the_check_finds_identifiers(source: str, found: list[str | None]):
    assert identifiers(source) == found


def test_sentences_of_the_golden_record_are_pinned():
    records = [json.loads(file.read_text()) for file in (ROOT / "benchmarks" / "golden").glob("*.json")]
    lists = [(r[f"{kind}_names"], r[f"{kind}s"]) for r in records for kind in ("reason", "note")]
    pairs = [pair for some in lists for pair in zip(*some, strict=True)]
    assert len(pairs) > 100
    assert [(name, sentence) for name, sentence in pairs if not is_pinned(name, sentence)] == []


JUMP = "the time offset of wheel0 changes by about +4.1 ms near 10.2 s: its clock jumped, or stamps are wrong."
DRIFT = (
    "the clock of wheel0 runs about 944 ppm slow against that of imu0, 65 ms over the recording. Write "
    "clock_rate: {prior: 0, sigma: 1000}, and leave time_offset free; or stamp all sensors by one clock, and record "
    "again."
)


@pytest.mark.parametrize(
    ("name", "sentence", "pinned"),
    [
        ("clock_drifts", DRIFT, True),
        ("clock_jumps", JUMP, True),
        ("clock_jumps", JUMP + " This explains 89% of what varies over the recording.", True),
        ("clock_drifts", f"monday: {DRIFT}", True),
        ("clock_jumps", JUMP.replace("wheel0 changes", "wheel0 (or that of cam0 the opposite way) changes"), True),
        ("clock_drifts", DRIFT.replace("clock of", "time of"), False),
        ("clock_drifts", DRIFT.replace("record again", "try again"), False),
        ("clock_drifts", DRIFT + " Then look.", False),
        ("clock_jumps", DRIFT, False),
        ("clock_runs", DRIFT, False),
        ("vertical_ambiguous", "w: nothing shows which way is up. Either cam0 looks up, or signs are wrong.", True),
        ("vertical_ambiguous", "w: nothing shows which way is up. Either cam0 looks away, or signs are wrong.", False),
    ],
)
def test_another_sentence_is_found(name: str, sentence: str, pinned: bool):
    assert is_pinned(name, sentence) is pinned


def test_a_remark_of_any_test_must_have_its_sentence():
    with pytest.raises(AssertionError, match="drifts a lot"):
        Remark("clock_drifts", "the clock drifts a lot")


def test_a_remark_is_text_that_keeps_its_identifier():
    remark = Remark("clock_drifts", DRIFT)
    assert remark == DRIFT and str(remark) == DRIFT and f"{remark}" == DRIFT and json.dumps(remark) == json.dumps(DRIFT)
    copies = [pickle.loads(pickle.dumps(remark)), copy.deepcopy(remark), remark.with_sentence(f"monday: {remark}")]
    assert names(copies) == ["clock_drifts"] * 3 and copies[:2] == [DRIFT] * 2 and copies[2] == f"monday: {DRIFT}"
    assert type(str(remark)) is str and named("clock_drifts", [remark]) is remark
