"""A class has a name of its own: whoever searches for it finds one. Variables are named after the data they hold."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import icalib

SOURCE = Path(icalib.__file__).parent
# Still to be renamed, and how many classes bear the name; the list only shrinks.
REPEATED: dict[str, int] = {}
# Names that do not say which data a variable holds.
VAGUE = {"found", "own", "way", "told", "shown", "held", "judged", "leaves", "astray", "gone"}


def class_names(source: str) -> list[str]:
    """All classes of a module, private and nested ones too."""
    return [node.name for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)]


def variable_names(source: str) -> set[str]:
    """All functions, parameters, assigned variables and attributes of a module, without leading underscores."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef)):
            names.add(node.name)
        elif isinstance(node, ast.arg):
            names.add(node.arg)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.add(node.id)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            names.add(node.attr)
        elif isinstance(node, (ast.ExceptHandler, ast.MatchAs, ast.MatchStar)) and node.name:
            names.add(node.name)
    return {name.lstrip("_") for name in names}


def test_no_two_classes_have_the_same_name():
    found = defaultdict(list)
    for module in sorted(SOURCE.rglob("*.py")):
        for name in class_names(module.read_text(encoding="utf-8")):
            found[name].append(module.relative_to(SOURCE).as_posix())
    repeated = {name: where for name, where in found.items() if len(where) > 1}
    assert {name: where for name, where in repeated.items() if len(where) > REPEATED.get(name, 1)} == {}
    assert {name: len(where) for name, where in repeated.items()} == REPEATED, "renamed: take it from the list"


def test_nested_and_private_classes_are_found():
    assert class_names("class A:\n    class _B: ...\n\ndef f():\n    class C: ...\n") == ["A", "_B", "C"]


def test_variables_are_named_after_their_data():
    vague = {
        (module.relative_to(SOURCE).as_posix(), name)
        for module in SOURCE.rglob("*.py")
        for name in variable_names(module.read_text(encoding="utf-8")) & VAGUE
    }
    assert vague == set(), "name it after the data it holds"


def test_all_kinds_of_variables_are_found():
    source = """
def a(b, *c, d=1, **e):
    f, (g, *h) = b
    self._i: int = 0
    for j in (k := d):
        with l as m:
            return lambda n: [o for o in n]
    try: ...
    except ValueError as p: ...
class Q:
    r: int
"""
    assert variable_names(source) == {*"abcdefghijkmnopr"}
