"""How far a result is from the truth, in the perturbations that its covariance is of."""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3
from icalib.tools.simulation import Truth


def true_value(truth: Truth, sensor: str, name: str) -> np.ndarray | None:
    """The truth of the group `name` of `sensor`, in the form of `ParameterGroup.value`; None where none is stated, as
    of a target's tilt."""
    return truth.values.get(sensor, {}).get(name)


def error(name: str, value: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(n,) estimated minus true; of rotations e of R_estimated = R_true Exp(e), in the sensor's axes."""
    return so3.log(np.ascontiguousarray(true.T @ value)) if name == "rotation" else value - true
