"""Poses that are written another way than `PoseStream` has them: the inverse, inverse rotations, left-handed axes.

Each way is tried where the poses as they are do not fit the motion, and named where it fits far better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from icalib.errors import EstimationError
from icalib.measurements import PoseStream

Way = Callable[[PoseStream], PoseStream]
T = TypeVar("T")
WELL = 0.1  # of what was seen is left: poses that fit so are written as they should be
BETTER = 0.5  # times what is left of the poses as they are


def _inverse(x: PoseStream) -> PoseStream:
    back = np.ascontiguousarray(x.rotation.transpose(0, 2, 1))
    return replace(x, rotation=back, position=-np.einsum("nij,nj->ni", back, x.position))


def _turned_back(x: PoseStream) -> PoseStream:
    return replace(x, rotation=np.ascontiguousarray(x.rotation.transpose(0, 2, 1)))


def _other_handed(x: PoseStream) -> PoseStream:
    flip = np.array([1.0, -1.0, 1.0])
    return replace(x, rotation=flip[:, None] * x.rotation * flip, position=flip * x.position)


def _with_axis_reversed(axis: int) -> Way:
    return lambda x: replace(x, position=x.position * np.where(np.arange(3) == axis, -1.0, 1.0))


WAYS: tuple[tuple[str, Way], ...] = (
    ("are inverted: they say where its frame is, seen from it; write inverted: true for it in the rig file", _inverse),
    ("have inverted rotations; write R_frame_sensor, or turn the sign of the quaternions' x, y and z", _turned_back),
    ("are those of left-handed axes; write them in right-handed ones", _other_handed),
    *((f"have their position's {'xyz'[k]} reversed; turn its sign", _with_axis_reversed(k)) for k in range(3)),
)


def placed(stream: PoseStream, place: Callable[[PoseStream], tuple[T, float]]) -> T:
    """What `place` makes of the poses; it gives, too, what is left of what they showed of the motion.

    Raises EstimationError as `place` does, or where poses written another way would fit far better.
    """
    found: T | None = None
    failed: EstimationError | None = None
    left = 1.0
    try:
        found, left = place(stream)
    except EstimationError as error:
        failed = error
    if left > WELL:
        for words, way in WAYS:
            if _left(place, way(stream)) < BETTER * left:
                raise EstimationError(f"the poses of {stream.name} {words}.") from failed
    if found is None:
        assert failed is not None
        raise failed
    return found


def _left(place: Callable[[PoseStream], tuple[T, float]], stream: PoseStream) -> float:
    try:
        return place(stream)[1]
    except EstimationError:
        return np.inf
