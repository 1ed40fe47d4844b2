"""Poses that are written another way than `PoseStream` has them: the inverse, inverse rotations, left-handed axes,
quaternions with w first, positions and rotations in different frames.

Each way is tried where the poses as they are do not fit the motion, and named where it fits far better.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from icalib.data.measurements import PoseStream
from icalib.data.tables.axes import in_axes
from icalib.errors import EstimationError
from icalib.rig import Axes
from icalib.sensors.pose.initialize.position_frame import words_for

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


def _w_first(x: PoseStream) -> PoseStream:
    """A product with a permutation: each quaternion may have either sign."""
    w_x_y_z = Rotation.from_matrix(x.rotation).as_quat()  # as written, taken for x, y, z, w
    return replace(x, rotation=Rotation.from_quat(w_x_y_z[:, [1, 2, 3, 0]]).as_matrix())


WAYS: tuple[tuple[str, Way], ...] = (
    (
        "are inverted: they give the pose of the reference frame in the sensor's frame; write inverted: true for "
        "it in the rig file",
        _inverse,
    ),
    ("have inverted rotations; write R_frame_sensor, or change the signs of x, y, z of the quaternions", _turned_back),
    ("are in left-handed axes; write them in right-handed axes", _other_handed),
    *(
        (f"have the {'xyz'[k]} axis of the position reversed; set its position_axes to {axes}", _with_axis_reversed(k))
        for k, axes in enumerate(("[-x, y, z]", "[x, -y, z]", "[x, y, -z]"))
    ),
    (
        "have quaternions with w first; name the columns in the rig file as x, y, z, w, or correct the program "
        "that writes them",
        _w_first,
    ),
)


def _with_axes(axes: Axes) -> Way:
    return lambda x: replace(x, position=in_axes(x.position, axes))


# Which of those that agree in which way is up it is does not matter to a vehicle on a floor.
TURNED: tuple[tuple[str, Way], ...] = tuple(
    (
        "have positions and rotations in different frames, for example one with z up and the other with y up; "
        f"set its position_axes to [{', '.join(axes)}]",
        _with_axes(axes),
    )
    for axes in (("x", "z", "-y"), ("x", "-z", "y"), ("y", "z", "x"), ("z", "x", "y"))
)


def placed(
    stream: PoseStream,
    place: Callable[[PoseStream], tuple[T, float]],
    turn: Callable[[PoseStream], np.ndarray | None] = lambda stream: None,
) -> T:
    """What `place` makes of the poses; it gives, too, what is left of what they showed of the motion. `turn` proposes a
    turn (3, 3) of their positions into the frame of their rotations.

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
        _refuse_two_frames(stream, place, turn, BETTER * left)
        for words, way in WAYS:
            if _left(place, way(stream)) < BETTER * left:
                raise EstimationError(f"the poses of {stream.name} {words}.") from failed
    if found is None:
        assert failed is not None
        raise failed
    return found


def _refuse_two_frames(
    stream: PoseStream,
    place: Callable[[PoseStream], tuple[T, float]],
    turn: Callable[[PoseStream], np.ndarray | None],
    left: float,
) -> None:
    """Raises EstimationError where less is `left` of poses whose positions are turned."""
    try:
        C = turn(stream)
    except EstimationError:
        return
    if C is None or not _left(place, replace(stream, position=stream.position @ C.T)) < left:
        return
    axes = words_for(C)
    degrees = ", ".join(f"{angle:.0f}" for angle in Rotation.from_matrix(C).as_euler("xyz", degrees=True))
    raise EstimationError(
        f"the positions and rotations of {stream.name} are in different frames, for example one with z up and "
        "the other with y "
        + (
            f"up; set position_axes of {stream.name} to {axes} in the rig file."
            if axes
            else f"up: positions turned by roll, pitch, yaw of {degrees} deg would fit; write both in one frame."
        )
    )


def _left(place: Callable[[PoseStream], tuple[T, float]], stream: PoseStream) -> float:
    try:
        return place(stream)[1]
    except EstimationError:
        return np.inf
