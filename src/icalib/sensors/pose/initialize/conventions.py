"""Detects poses in a convention other than that of `PoseStream`.

These are inverted poses or rotations, left-handed axes, quaternions with w first, and positions and rotations in
different frames. Each convention is tried if the poses do not fit the motion. An error names the convention if the
poses fit far better with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from icalib.data.measurements import PoseStream
from icalib.data.tables.columns import in_axes
from icalib.errors import EstimationError
from icalib.rig import Axes
from icalib.sensors.pose.initialize.position_frame import axes_text

Conversion = Callable[[PoseStream], PoseStream]  # converts poses from a convention to that of `PoseStream`
T = TypeVar("T")
MAX_UNEXPLAINED = 0.1  # unexplained share of the motion, up to which the convention is taken to be right
MAX_CONVERTED_RATIO = 0.5  # ratio of converted to original unexplained share, below which a convention fits far better


def _inverse(x: PoseStream) -> PoseStream:
    """The inverse of each pose."""
    back = np.ascontiguousarray(x.rotation.transpose(0, 2, 1))
    return replace(x, rotation=back, position=-np.einsum("nij,nj->ni", back, x.position))


def _with_inverse_rotations(x: PoseStream) -> PoseStream:
    """Poses with inverted rotations and unchanged positions."""
    return replace(x, rotation=np.ascontiguousarray(x.rotation.transpose(0, 2, 1)))


def _with_y_reversed(x: PoseStream) -> PoseStream:
    """Poses with reversed y axes of both the frame and the sensor."""
    flip = np.array([1.0, -1.0, 1.0])
    return replace(x, rotation=flip[:, None] * x.rotation * flip, position=flip * x.position)


def _with_axis_reversed(axis: int) -> Conversion:
    """A conversion that reverses one axis of the positions."""
    return lambda x: replace(x, position=x.position * np.where(np.arange(3) == axis, -1.0, 1.0))


def _w_first(x: PoseStream) -> PoseStream:
    """Corrects poses whose quaternions w, x, y, z were read as x, y, z, w."""
    w_x_y_z = Rotation.from_matrix(x.rotation).as_quat()  # the recorded order; the sign does not matter
    return replace(x, rotation=Rotation.from_quat(w_x_y_z[:, [1, 2, 3, 0]]).as_matrix())


CONVENTIONS: tuple[tuple[str, Conversion], ...] = (
    (
        "are inverted: they give the pose of the reference frame in the sensor's frame; write inverted: true for "
        "it in the rig file",
        _inverse,
    ),
    (
        "have inverted rotations; write R_frame_sensor, or change the signs of x, y, z of the quaternions",
        _with_inverse_rotations,
    ),
    ("are in left-handed axes; write them in right-handed axes", _with_y_reversed),
    *(
        (f"have the {'xyz'[k]} axis of the position reversed; set its position_axes to {axes}", _with_axis_reversed(k))
        for k, axes in enumerate(("[-x, y, z]", "[x, -y, z]", "[x, y, -z]"))
    ),
    (
        "have quaternions with w first; for a table of stamp, position and quaternion write columns: "
        "[1, 2, 3, 4, 6, 7, 8, 5], else correct the program that writes them",
        _w_first,
    ),
)


def _with_axes(axes: Axes) -> Conversion:
    """A conversion that exchanges axes of the positions."""
    return lambda x: replace(x, position=in_axes(x.position, axes))


# One convention for each direction of the vertical, as planar motion of a vehicle does not distinguish any more.
POSITION_AXES: tuple[tuple[str, Conversion], ...] = tuple(
    (
        "have positions and rotations in different frames, for example one with z up and the other with y up; "
        f"set its position_axes to [{', '.join(axes)}]",
        _with_axes(axes),
    )
    for axes in (("x", "z", "-y"), ("x", "-z", "y"), ("y", "z", "x"), ("z", "x", "y"))
)


def with_checked_convention(
    stream: PoseStream,
    place: Callable[[PoseStream], tuple[T, float]],
    rotation_of: Callable[[PoseStream], np.ndarray | None] = lambda stream: None,
) -> T:
    """Result of `place` for the poses, after a check of their convention.

    place: returns its result, and the share of the motion that the poses do not explain. rotation_of: a candidate
    rotation (3, 3) from the frame of positions to that of rotations, or None. Raises EstimationError as `place` does,
    or if the poses fit far better with another convention.
    """
    result: T | None = None
    failed: EstimationError | None = None
    unexplained = 1.0
    try:
        result, unexplained = place(stream)
    except EstimationError as error:
        failed = error
    if unexplained > MAX_UNEXPLAINED:
        most = MAX_CONVERTED_RATIO * unexplained
        _refuse_two_frames(stream, place, rotation_of, most)
        for words, convert in CONVENTIONS:
            if _unexplained(place, convert(stream)) < most:
                raise EstimationError(f"the poses of {stream.name} {words}.") from failed
    if result is None:
        assert failed is not None
        raise failed
    return result


def _refuse_two_frames(
    stream: PoseStream,
    place: Callable[[PoseStream], tuple[T, float]],
    rotation_of: Callable[[PoseStream], np.ndarray | None],
    most: float,
) -> None:
    """Raise EstimationError if rotating the positions reduces the unexplained share of the motion below `most`."""
    try:
        C = rotation_of(stream)
    except EstimationError:
        return
    if C is None or not _unexplained(place, replace(stream, position=stream.position @ C.T)) < most:
        return
    axes = axes_text(C)
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


def _unexplained(place: Callable[[PoseStream], tuple[T, float]], stream: PoseStream) -> float:
    """Share of the motion that the poses do not explain; infinite if `place` raises EstimationError."""
    try:
        return place(stream)[1]
    except EstimationError:
        return np.inf
