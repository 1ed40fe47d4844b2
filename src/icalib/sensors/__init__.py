"""The kinds of sensors: one folder each. A new kind is a new folder and one entry in `SENSOR_KINDS`.

A facet is a module of a fixed name in the folder of a kind, for one stage of the program: `spec`, `record`, `read`,
`model`, `initialize`, `assess`, `show`, `simulate`, `inspect`. Each stage asks the kinds for its own facet.
"""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

# Sensors stand in this order in layouts and results; those of one kind in the order of the rig file.
SENSOR_KINDS = ("imu", "camera", "lidar", "wheels", "pose")
# Levels of their own in tests/test_layers.py.
FACETS = ("spec", "record", "stream", "read", "model", "initialize", "assess", "show", "simulate", "inspect")


def facet(kind: str, name: str) -> Any:
    """The module `name` in the folder of `kind`, imported on use; None where the kind has none."""
    module = f"{__name__}.{kind}.{name}"
    return None if find_spec(module) is None else import_module(module)
