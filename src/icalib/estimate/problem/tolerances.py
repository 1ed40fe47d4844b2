"""Parameter definitions of the blocks of a layout, and the tolerance of each calibration column."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from icalib.optim.state import Key, Layout
from icalib.rig import ParameterSpec, Sensor, Settings
from icalib.rig.scene import SCENE
from icalib.sensors.sensor import TIME_OFFSET

UNGUESSED_SIGMA = 0.03  # rad or m: prior uncertainty of start values that nobody guessed, such as gravity's direction
# prior uncertainty of a translation without a guess in the rig file, about the program's start value
UNGUESSED_TRANSLATION_SIGMA_M = 0.5


def specs_of(layout: Layout, sensors: Iterable[Sensor]) -> dict[Key, ParameterSpec]:
    """Parameter definition of each block: from its sensor among `sensors`, else from the scene."""
    sensor_specs = {sensor.name: {spec.name: spec for spec in sensor.specs()} for sensor in sensors}
    scene = {spec.name: spec for spec in SCENE}
    block_specs = {b.key: sensor_specs.get(b.sensor, scene)[b.name] for b in layout.blocks}
    return block_specs | {b.key: TIME_OFFSET.in_recordings(b.size) for b in layout.blocks if b.name == TIME_OFFSET.name}


def tolerance_of(layout: Layout, specs: Mapping[Key, ParameterSpec], settings: Settings) -> np.ndarray:
    """(B,) tolerance of each calibration column: a parameter with a smaller standard deviation is `determined`. Units:
    rad, m, s, and px for image quantities."""
    out = np.zeros(layout.size)
    for b in layout.free:
        tolerance = specs[b.key].tolerance
        out[b.columns] = settings.tolerance(tolerance) if isinstance(tolerance, str) else tolerance
    return out
