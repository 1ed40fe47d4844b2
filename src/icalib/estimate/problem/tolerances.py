"""Definitions of the parameters in a layout, and what follows from them for each column."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np

from icalib.optim.state import Key, Layout
from icalib.rig import ParameterSpec, Sensor, Settings
from icalib.rig.scene import SCENE
from icalib.sensors.sensor import TIME_OFFSET

UNGUESSED_SIGMA = 0.03  # rad or m: how well the start knows what nobody guessed, such as which way is up
# prior uncertainty of a translation that nobody guessed: where the program took it to be
UNGUESSED_TRANSLATION_SIGMA_M = 0.5


def specs_of(layout: Layout, sensors: Iterable[Sensor]) -> dict[Key, ParameterSpec]:
    """The definition of each block: of one of the `sensors`, else of the scene."""
    own = {sensor.name: {spec.name: spec for spec in sensor.specs()} for sensor in sensors}
    scene = {spec.name: spec for spec in SCENE}
    found = {b.key: own.get(b.sensor, scene)[b.name] for b in layout.blocks}
    return found | {b.key: TIME_OFFSET.in_recordings(b.size) for b in layout.blocks if b.name == TIME_OFFSET.name}


def tolerance_of(layout: Layout, specs: Mapping[Key, ParameterSpec], settings: Settings) -> np.ndarray:
    """(B,) of each calibration column: standard deviations below are `determined`. Angles rad, lengths m, times s,
    image quantities px."""
    out = np.zeros(layout.size)
    for b in layout.free:
        tolerance = specs[b.key].tolerance
        out[b.columns] = settings.tolerance(tolerance) if isinstance(tolerance, str) else tolerance
    return out
