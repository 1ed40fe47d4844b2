"""A class has a name of its own: whoever searches for it finds one."""

from __future__ import annotations

import ast
from collections import defaultdict
from pathlib import Path

import icalib

SOURCE = Path(icalib.__file__).parent
# Still to be renamed, and how many classes bear the name; the list only shrinks.
REPEATED: dict[str, int] = {}


def class_names(source: str) -> list[str]:
    """All classes of a module, private and nested ones too."""
    return [node.name for node in ast.walk(ast.parse(source)) if isinstance(node, ast.ClassDef)]


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
