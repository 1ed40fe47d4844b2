"""One test of many cases fails for each of them, and says which."""

from __future__ import annotations

import re

import pytest
from tests.cases import each


def test_all_that_fail_are_named_and_all_are_run():
    run = []

    @each("a, b", [(1, 1), pytest.param(2, 3, id="unequal"), (3, 3), (4, 5)])
    def check(a: int, b: int) -> None:
        run.append(a)
        assert a == b

    with pytest.raises(
        AssertionError, match=re.compile(r"2 of 4 cases fail\nunequal: Assert.*^4, 5: Assert", re.S | re.M)
    ):
        check()
    assert run == [1, 2, 3, 4]


def test_what_does_not_raise_or_is_skipped_fails():
    @each("name", ["raises", "skip"])
    def check(name: str) -> None:
        with pytest.raises(ValueError, match="never"):
            pytest.skip(name) if name == "skip" else None

    with pytest.raises(AssertionError, match="2 of 2 cases fail"):
        check()


@each("a", [1, 2])
@each("b", [3.0, 4.0])
def test_it_nests_and_leaves_fixtures(a: int, b: float, tmp_path):
    assert tmp_path.is_dir() and a < b


@each("a", [1, 2], full=[3])
@each("b", [3.0, 4.0])
def test_further_cases_are_an_item_of_their_own(a: int, b: float, request):
    assert (a == 3) == (request.node.get_closest_marker("full") is not None)
    assert request.node.callspec.params == {"in_full": a == 3}


def test_no_case_or_one_of_other_length_is_an_error():
    for names, cases in (("a", []), ("a, b", [(1, 2, 3)])):
        with pytest.raises((AssertionError, ValueError)):
            each(names, cases)


def test_each_case_has_its_own_folder_patches_and_output(tmp_path, monkeypatch, capsys):
    @each("a", [1, 2])
    def check(a: int, tmp_path, monkeypatch, capsys):
        assert not hasattr(each, "patched") and not list(tmp_path.iterdir()) and not capsys.readouterr().out
        monkeypatch.setattr(each, "patched", a, raising=False)
        (tmp_path / "file").touch()
        print(a)

    check(tmp_path=tmp_path, monkeypatch=monkeypatch, capsys=capsys)
    assert not hasattr(each, "patched")
