"""Whether the arrays of a result that was read are as long, and of the kind, that its parts say."""

from __future__ import annotations

from typing import Any

import numpy as np

from icalib.calibration.images import CornerResiduals, TrackResiduals
from icalib.calibration.result import Calibration, ImuResiduals, Trajectory
from icalib.calibration.robot import LidarResiduals, PoseResiduals, WheelResiduals

_FLOAT, _WHOLE, _BOOL = "f", "iu", "b"  # kinds of numpy
# Of each array the kind, and its axes: names stand for lengths that are the same throughout one object.
_Shapes = dict[str, tuple[str | int, ...]]
_IMAGES: _Shapes = {
    "seconds": (_FLOAT, "images"), "start": (_WHOLE, "edges"), "point": (_WHOLE, "n"), "uv": (_FLOAT, "n", 2),
    "residual": (_FLOAT, "n", 2), "rejected": (_BOOL, "n"),
}  # fmt: skip
_ROWS: _Shapes = {"seconds": (_FLOAT, "n"), "residual": (_FLOAT, "n", "labels"), "whitened": (_FLOAT, "n", "labels")}
_SHAPES: dict[type, _Shapes] = {
    CornerResiduals: _IMAGES | {"sigma": (_FLOAT, "n")},
    TrackResiduals: _IMAGES,
    WheelResiduals: _ROWS,
    PoseResiduals: _ROWS,
    LidarResiduals: {
        "seconds": (_FLOAT, "n"), "plane": (_WHOLE, "n"), "distance": (_FLOAT, "n"), "sigma": (_FLOAT, "n"),
        "world": (_FLOAT, "n", 3), "residual": (_FLOAT, "n"), "first_world": (_FLOAT, "n", 3),
        "first_residual": (_FLOAT, "n"),
    },
    ImuResiduals: {"seconds": (_FLOAT, "n"), "whitened": (_FLOAT, "n", 15)},
    Trajectory: {
        "seconds": (_FLOAT, "n"), "rotation": (_FLOAT, "n", 3, 3), "position": (_FLOAT, "n", 3),
        "velocity": (_FLOAT, "n", 3), "gyro_bias": (_FLOAT, "n", 3), "accel_bias": (_FLOAT, "n", 3),
    },
}  # fmt: skip


def check_arrays(c: Calibration) -> None:
    """Raises ValueError, naming the array, where one does not fit the others."""
    _refuse_other_kind("the covariance", c.covariance, _FLOAT)
    residuals = (*c.corner_residuals, *c.track_residuals, *c.wheel_residuals, *c.pose_residuals, *c.lidar_residuals)
    for part in (*residuals, c.imu_residuals, c.trajectory):
        _check(part)


def _check(part: Any) -> None:
    what = getattr(part, "sensor", type(part).__name__)
    known: dict[str, int] = {"labels": len(getattr(part, "labels", ()))}
    for name, (kind, *axes) in _SHAPES[type(part)].items():
        array = getattr(part, name)
        _refuse_other_kind(f"{name} of {what}", array, str(kind))
        if array.ndim != len(axes) or any(
            n != (known.setdefault(a, n) if isinstance(a, str) else a) for a, n in zip(axes, array.shape, strict=True)
        ):
            raise ValueError(f"{name} of {what} has shape {array.shape}, which does not fit the rest")
    if "edges" in known:
        start = part.start
        if len(start) != known["images"] + 1 or start[0] != 0 or start[-1] != known["n"] or (np.diff(start) < 0).any():
            raise ValueError(f"start of {what} does not divide its points among its images")


def _refuse_other_kind(what: str, array: np.ndarray, kinds: str) -> None:
    if array.dtype.kind not in kinds:
        raise ValueError(f"{what} holds {array.dtype} numbers")
