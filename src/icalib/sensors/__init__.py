"""The kinds of sensors: one folder each. A new kind is a new folder and one entry in `SENSOR_KINDS`.

Three things of a kind are registered elsewhere. A kind that gives the motion needs a rank, one of the BY_... in
`initialize/initializer.py`. Parameters of the scene belong to `SCENE` in `rig/scene.py`. A simulated kind needs
a free `random_stream`; `CONTRIBUTING.md` lists those taken.

A facet is a module or package of a fixed name in the folder of a kind that serves one stage of the program: see
`FACETS`. Each stage calls functions of its facet for all kinds of sensors (`call_all_kinds`, `call_kind`).
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


def call_all_kinds(name: str, function: str, *arguments: Any) -> Iterator[Any]:
    """Calls `function` in the facet `name` of every kind that has it, and yields the items that it yields."""
    for kind in SENSOR_KINDS:
        yield from call_kind(kind, name, function, *arguments) or ()


def call_kind(kind: str, name: str, function: str, *arguments: Any) -> Any:
    """Calls `function` in the facet `name` of one kind. Returns its value, or None if the kind has no such function."""
    called = getattr(facet(kind, name), function, None)
    return None if called is None else called(*arguments)


def facet(kind: str, name: str) -> Any:
    """The facet module `name` of a kind, imported at the first call; None if the kind has no such module."""
    module = f"{__name__}.{kind}.{name}"
    return None if find_spec(module) is None else import_module(module)
