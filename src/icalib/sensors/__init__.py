"""The kinds of sensors: one folder each. A new kind is a new folder and one entry in `SENSOR_KINDS`.

Three things of a kind are registered elsewhere. A kind that gives the motion needs a rank, one of the BY_... in
`initialize/steps/initializer.py`. Parameters of the scene belong to `SCENE` in `rig/scene.py`. A simulated kind needs
a free `random_stream`; `CONTRIBUTING.md` lists those taken.

A facet is a module or package of a fixed name in the folder of a kind, for one stage of the program: see `FACETS`.
Each stage asks the kinds for its own facet.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from typing import Any

# Sensors stand in this order in layouts and results; those of one kind in the order of the rig file.
SENSOR_KINDS = ("imu", "camera", "lidar", "wheels", "pose", "position")
# Levels of their own in tests/test_layers.py.
FACETS = ("spec", "record", "stream", "read", "model", "initialize", "assess", "show", "simulate", "inspect")


def ask(name: str, question: str, *arguments: Any) -> Iterator[Any]:
    """What functions called `question` in the facets called `name` yield, kind by kind."""
    for kind in SENSOR_KINDS:
        yield from answer(kind, name, question, *arguments) or ()


def answer(kind: str, name: str, question: str, *arguments: Any) -> Any:
    """What the function `question` in the facet `name` of one kind returns; None where the kind has none."""
    function = getattr(facet(kind, name), question, None)
    return None if function is None else function(*arguments)


def facet(kind: str, name: str) -> Any:
    """The module `name` in the folder of `kind`, imported on use; None where the kind has none."""
    module = f"{__name__}.{kind}.{name}"
    return None if find_spec(module) is None else import_module(module)
