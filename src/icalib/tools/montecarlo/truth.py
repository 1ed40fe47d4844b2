"""Errors of a result, as the perturbations that its covariance describes."""

from __future__ import annotations

import numpy as np

from icalib.geometry import so3
from icalib.tools.simulation import Truth


def true_value(truth: Truth, sensor: str, name: str) -> np.ndarray | None:
    """True value of the group `name` of `sensor`, in the form of `ParameterGroup.value`; None if the truth has none, as
    for the tilt of a target."""
    return truth.values.get(sensor, {}).get(name)


def error(name: str, value: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(n,) estimated minus true; for rotations e of R_estimated = R_true Exp(e) [rad], in the sensor's axes."""
    return so3.log(np.ascontiguousarray(true.T @ value)) if name == "rotation" else value - true
