"""The kinds of sensors: one folder each. A new kind is a new folder and one entry in `SENSOR_KINDS`.

Three things of a kind are registered elsewhere. A kind that gives the motion needs a rank, one of the BY_... in
`initialize/steps/initializer.py`. Parameters of the scene belong to `SCENE` in `rig/scene.py`. A simulated kind needs
a free `random_stream`; `CONTRIBUTING.md` lists those taken.

A facet is a module or package of a fixed name in the folder of a kind that serves one stage of the program: see
`FACETS`. Each stage calls functions of its facet for all kinds of sensors (`ask`, `answer`).
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from typing import Any

# Order of sensors in layouts and results; sensors of one kind are in the order of the rig file.
SENSOR_KINDS = ("imu", "camera", "lidar", "wheels", "pose", "position")
# Names of facets. Each is a separate import level in tests/test_layers.py.
FACETS = ("spec", "record", "stream", "read", "model", "initialize", "assess", "show", "simulate", "inspect")


def ask(name: str, question: str, *arguments: Any) -> Iterator[Any]:
    """Yields all items that the functions named `question` in the facets named `name` yield, kind by kind."""
    for kind in SENSOR_KINDS:
        yield from answer(kind, name, question, *arguments) or ()


def answer(kind: str, name: str, question: str, *arguments: Any) -> Any:
    """The return value of the function `question` in the facet `name` of one kind; None if it has no such function."""
    function = getattr(facet(kind, name), question, None)
    return None if function is None else function(*arguments)


def facet(kind: str, name: str) -> Any:
    """The facet module `name` of a kind, imported at the first call; None if the kind has no such module."""
    module = f"{__name__}.{kind}.{name}"
    return None if find_spec(module) is None else import_module(module)
