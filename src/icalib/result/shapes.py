"""Checks dtypes and shapes of the arrays of a result that was read from files, which others may have changed."""

from __future__ import annotations

from typing import Any

import numpy as np

from icalib.result.calibration import Calibration, ImuResiduals, Trajectory
from icalib.result.images import CornerResiduals, TrackResiduals
from icalib.result.robot import LidarResiduals, PoseResiduals, WheelResiduals

_FLOAT, _WHOLE, _BOOL = "f", "iu", "b"  # values of numpy's dtype.kind
_WORDS = {_FLOAT: "decimal", _WHOLE: "whole", _BOOL: "boolean"}
# For each array its kind, then its axes. An axis is a length, or a name: equal names in one object are equal lengths.
# "edges" is "images" + 1, and "labels" the number of the object's labels.
_Shapes = dict[str, tuple[str | int, ...]]
_IMAGES: _Shapes = {
    "seconds": (_FLOAT, "images"),
    "start": (_WHOLE, "edges"),
    "point": (_WHOLE, "n"),
    "uv": (_FLOAT, "n", 2),
    "residual": (_FLOAT, "n", 2),
    "rejected": (_BOOL, "n"),
}
_ROWS: _Shapes = {"seconds": (_FLOAT, "n"), "residual": (_FLOAT, "n", "labels"), "whitened": (_FLOAT, "n", "labels")}
_SHAPES: dict[type, _Shapes] = {
    CornerResiduals: _IMAGES | {"sigma": (_FLOAT, "n")},
    TrackResiduals: _IMAGES | {"sigma": (_FLOAT, "n")},
    WheelResiduals: _ROWS,
    PoseResiduals: _ROWS,
    LidarResiduals: {
        "seconds": (_FLOAT, "n"),
        "plane": (_WHOLE, "n"),
        "distance": (_FLOAT, "n"),
        "sigma": (_FLOAT, "n"),
        "world": (_FLOAT, "n", 3),
        "residual": (_FLOAT, "n"),
        "first_world": (_FLOAT, "n", 3),
        "first_residual": (_FLOAT, "n"),
    },
    ImuResiduals: {"seconds": (_FLOAT, "n"), "whitened": (_FLOAT, "n", 15)},
    Trajectory: {
        "seconds": (_FLOAT, "n"),
        "rotation": (_FLOAT, "n", 3, 3),
        "position": (_FLOAT, "n", 3),
        "velocity": (_FLOAT, "n", 3),
        "gyro_bias": (_FLOAT, "n", 3),
        "accel_bias": (_FLOAT, "n", 3),
    },
}


def check_arrays(c: Calibration) -> None:
    """Raises ValueError, naming the array, where one has another kind of numbers or does not fit the rest in shape.

    The shape of the covariance is not checked here.
    """
    _check_kind("the covariance", c.covariance, _FLOAT)
    residuals = (*c.corner_residuals, *c.track_residuals, *c.wheel_residuals, *c.pose_residuals, *c.lidar_residuals)
    for part in (*residuals, c.imu_residuals, c.trajectory):
        _check(part)


def _check(part: Any) -> None:
    """Checks one object of a class in `_SHAPES`."""
    what = getattr(part, "sensor", type(part).__name__)
    lengths: dict[str, int] = {"labels": len(getattr(part, "labels", ()))}
    for name, (kind, *axes) in _SHAPES[type(part)].items():
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
