"""Checks dtypes and shapes of arrays of a result that was read from files, which may have been edited."""

from __future__ import annotations

from typing import Any

import numpy as np

from icalib.result.calibration import Calibration, Trajectory
from icalib.sensors.records import Shapes

_WORDS = {"f": "decimal", "iu": "whole", "b": "boolean"}  # by accepted values of numpy's dtype.kind
_TRAJECTORY: Shapes = {
    "seconds": ("f", "n"),
    "rotation": ("f", "n", 3, 3),
    "position": ("f", "n", 3),
    "velocity": ("f", "n", 3),
    "gyro_bias": ("f", "n", 3),
    "accel_bias": ("f", "n", 3),
}


def check_arrays(c: Calibration) -> None:
    """Raise ValueError, naming the array, if a dtype is wrong or a shape is inconsistent with the other arrays.

    Shapes of the covariance and of the null space are not checked here.
    """
    _check_kind("the covariance", c.covariance, "f")
    _check_kind("the null space", c.null_space, "f")
    for (sensor, _), record in c.residuals.items():
        _check(record, sensor, record.shapes)
    _check(c.trajectory, Trajectory.__name__, _TRAJECTORY)


def _check(part: Any, what: str, shapes: Shapes) -> None:
    """Check the arrays of one object against `shapes`, in which equal names of axes are equal lengths."""
    lengths: dict[str, int] = {"labels": len(getattr(part, "labels", ()))}
    for name, (kind, *axes) in shapes.items():
        array = getattr(part, name)
        _check_kind(f"{name} of {what}", array, str(kind))
        if array.ndim != len(axes) or any(
            n != (lengths.setdefault(a, n) if isinstance(a, str) else a) for a, n in zip(axes, array.shape, strict=True)
        ):
            raise ValueError(f"{name} of {what} has shape {array.shape}, which does not fit the rest")
    if "edges" in lengths:
        start, images, n = part.start, lengths["images"], lengths["n"]
        if len(start) != images + 1 or start[0] != 0 or start[-1] != n or (np.diff(start) < 0).any():
            raise ValueError(f"start of {what} does not divide its points among its images")


def _check_kind(what: str, array: np.ndarray, kinds: str) -> None:
    if array.dtype.kind not in kinds:
        raise ValueError(f"{what} holds {array.dtype}, not {_WORDS[kinds]} values")
