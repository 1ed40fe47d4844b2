"""Detects poses in a convention other than that of the rig file.

These are another unit of positions, another way to write rotations, inverted poses or rotations, left-handed axes, and
positions and rotations in different frames. If the poses do not fit the motion, all conventions are tried. An error
names the one that fits, unless another fits as well.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from icalib.data.measurements import PoseStream
from icalib.data.tables import in_axes
from icalib.errors import EstimationError
from icalib.initialize.trajectories import LeverArmRows
from icalib.rig import Axes, PoseSensor
from icalib.sensors.pose.read.transforms import angle_unit, rotations_of
from icalib.sensors.pose.spec import METRES, THREE_NUMBERS, LengthUnit

T = TypeVar("T")
MAX_UNEXPLAINED = 0.1  # unexplained share of the motion, up to which the convention is taken to be right
MAX_RIVAL_RATIO = 1.5  # up to this ratio of its unexplained share to the least one, a convention fits as well
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


def _with_axes(x: PoseStream, axes: Axes) -> PoseStream:
    """Poses whose positions have other axes."""
    return replace(x, position=in_axes(x.position, axes))


def _w_first(x: PoseStream) -> PoseStream:
    """Corrects poses whose quaternions w, x, y, z were read as x, y, z, w."""
    w_x_y_z = Rotation.from_matrix(x.rotation).as_quat()  # the recorded order; the sign does not matter
    return replace(x, rotation=Rotation.from_quat(w_x_y_z[:, [1, 2, 3, 0]]).as_matrix())


@dataclass(frozen=True)
class Convention:
    """Poses as another convention has them. words: what they are; fields: of the rig file, that state it; changes:
    number of differences from the rig file."""

    stream: PoseStream
    words: str
    fields: tuple[str, ...] = ()
    changes: int = 1

    def sentence(self, name: str) -> str:
        advice = f"; write {' and '.join(self.fields)} for it in the rig file" if self.fields else ""
        return f"the poses of {name} {self.words}{advice}."


UNIT_NOUNS: dict[LengthUnit, str] = {"m": "metres", "cm": "centimetres", "mm": "millimetres"}


def conventions(stream: PoseStream, sensor: PoseSensor) -> Iterator[Convention]:
    """Poses of `sensor` in all other conventions: combinations of unit, rotations and inversion, then single others."""
    written = _inverse(stream) if sensor.inverted else stream
    for how, rotation in _readings(written, sensor):
        words, fields = ([], []) if how is None else _rotation_words(how, len(stream.numbers) > 0)
        for length_unit, noun in UNIT_NOUNS.items():
            position = written.position * (METRES[length_unit] / METRES[sensor.position_unit])
            read = replace(written, rotation=rotation, position=position)
            other = length_unit != sensor.position_unit
            in_unit = [*words, *([f"are in {noun}"] if other else [])]
            unit_fields = [*fields, *([f"position_unit: {length_unit}"] if other else [])]
            if in_unit:
                poses = _inverse(read) if sensor.inverted else read
                yield Convention(poses, " and ".join(in_unit), tuple(unit_fields), len(in_unit))
            turned = read if sensor.inverted else _inverse(read)
            every = " and ".join([*in_unit, _NOT_INVERTED if sensor.inverted else _INVERTED])
            turned_fields = (*unit_fields, f"inverted: {'false' if sensor.inverted else 'true'}")
            yield Convention(turned, every, turned_fields, len(in_unit) + 1)
    yield Convention(
        _with_inverse_rotations(stream),
        "have inverted rotations; write R_frame_sensor, or change the signs of x, y, z of the quaternions",
    )
    yield Convention(_with_y_reversed(stream), "are in left-handed axes; write them in right-handed axes")
    if not sensor.inverted and sensor.position_axes is None:  # position_axes are those of the poses as written
        axes: Axes
        for name, axes in zip("xyz", (("-x", "y", "z"), ("x", "-y", "z"), ("x", "y", "-z")), strict=True):
            words = f"have the {name} axis of the position reversed; set its position_axes to [{', '.join(axes)}]"
            yield Convention(_with_axes(stream, axes), words)


_INVERTED = "are inverted: they give the pose of the reference frame in the sensor's frame"
_TWO_FRAMES = "have positions and rotations in different frames, for example one with z up and the other with y up"
_NOT_INVERTED = "are not inverted: they give the pose of the sensor in the reference frame"


def is_unstated(stream: PoseStream, sensor: PoseSensor) -> bool:
    """Whether the table writes a rotation as three numbers, and the rig file does not tell how."""
    return sensor.rotations is None and stream.numbers.shape[1] == 3


def unstated(stream: PoseStream) -> EstimationError:
    """The error for poses of which `is_unstated` is true, and whose motion does not show the convention."""
    return EstimationError(
        f"{stream.name}: three numbers give each rotation, and the motion does not show how they are written; write "
        "rotations: [xyz, degrees] (angles about fixed axes), [ZYX, degrees] (about turning axes) or [vector, radians] "
        "for it in the rig file."
    )


def _readings(x: PoseStream, sensor: PoseSensor) -> Iterator[tuple[str | None, np.ndarray]]:
    """Rotations (N, 3, 3) read in all ways, each with its `rotations` in the rig file, or None for that of `x`."""
    size = x.numbers.shape[1]
    if not is_unstated(x, sensor):
        yield None, x.rotation
    if not size:
        yield "wxyz", _w_first(x).rotation
    if size == 4:
        how = "xyzw" if sensor.rotations == "wxyz" else "wxyz"
        yield how, rotations_of(x.numbers, how)
    for name in THREE_NUMBERS if size == 3 else ():
        how = f"{name}, {angle_unit(x.numbers)}"
        if how != sensor.rotations:
            yield how, rotations_of(x.numbers, how)


def _rotation_words(how: str, in_table: bool) -> tuple[list[str], list[str]]:
    """What poses have whose rotations are written as `how`, and the field of the rig file that says so."""
    if not in_table:
        return ["have quaternions with w first (correct the program that sends them)"], []
    if how in ("wxyz", "xyzw"):
        order, place = how, "first" if how == "wxyz" else "last"
        return [f"have quaternions with w {place}"], [f"rotations: {order}"]
    return [f"have rotations written as [{how}]"], [f"rotations: [{how}]"]


def other_axes(stream: PoseStream) -> Iterator[Convention]:
    """Poses with exchanged axes of positions. One convention for each direction of the vertical, as planar motion of a
    vehicle does not distinguish any more."""
    axes: Axes
    for axes in (("x", "z", "-y"), ("x", "-z", "y"), ("y", "z", "x"), ("z", "x", "y")):
        words = f"{_TWO_FRAMES}; set its position_axes to [{', '.join(axes)}]"
        yield Convention(_with_axes(stream, axes), words)


def with_checked_convention(
    stream: PoseStream,
    sensor: PoseSensor,
    place: Callable[[PoseStream], tuple[T, float]],
    rotation_of: Callable[[PoseStream], np.ndarray | None] = lambda stream: None,
) -> T:
    """Result of `place` for the poses, after a check of their convention.

    place: returns its result, and the share of the motion that the poses do not explain. rotation_of: a candidate
    rotation (3, 3) from the frame of positions to that of rotations, or None. Raises EstimationError as `place` does,
    or if the poses fit with another convention, and far better than in that of the rig file.
    """
    result: T | None = None
    failed: EstimationError | None = None
    unexplained = 1.0
    try:
        result, unexplained = place(stream)
    except EstimationError as error:
        failed = error
    open_ = is_unstated(stream, sensor)
    if unexplained > MAX_UNEXPLAINED or open_:
        others = [*_in_two_frames(stream, rotation_of), *conventions(stream, sensor)]
        most = MAX_UNEXPLAINED if open_ else min(MAX_UNEXPLAINED, MAX_CONVERTED_RATIO * unexplained)
        best = best_convention(others, [_unexplained(place, x.stream) for x in others], most)
        if best is not None:
            raise EstimationError(best.sentence(stream.name)) from failed
        if open_:
            raise unstated(stream) from failed
    if result is None:
        assert failed is not None
        raise failed
    return result


def best_convention(others: list[Convention], shares: list[float], most: float) -> Convention | None:
    """The convention with the least unexplained share of the motion; None if it is not below `most`, or if another one
    with as few changes explains as much."""
    least = min(shares)
    rivals = [x for x, share in zip(others, shares, strict=True) if share <= MAX_RIVAL_RATIO * least]
    fewest = [x for x in rivals if x.changes == min(r.changes for r in rivals)]
    return fewest[0] if least < most and len(fewest) == 1 else None


def _in_two_frames(stream: PoseStream, rotation_of: Callable[[PoseStream], np.ndarray | None]) -> Iterator[Convention]:
    """Poses whose positions are turned into the frame of the rotations, if `rotation_of` finds such a rotation."""
    try:
        C = rotation_of(stream)
    except EstimationError:
        return
    if C is None:
        return
    axes = axes_text(C)
    degrees = ", ".join(f"{angle:.0f}" for angle in Rotation.from_matrix(C).as_euler("xyz", degrees=True))
    yield Convention(
        replace(stream, position=stream.position @ C.T),
        f"{_TWO_FRAMES}; "
        + (
            f"set its position_axes to {axes}"
            if axes
            else f"positions turned by roll, pitch, yaw of {degrees} deg would fit; write both in one frame"
        ),
    )


def _unexplained(place: Callable[[PoseStream], tuple[T, float]], stream: PoseStream) -> float:
    """Share of the motion that the poses do not explain; infinite if `place` raises EstimationError."""
    try:
        return place(stream)[1]
    except EstimationError:
        return np.inf


# Poses whose positions and rotations are in different frames, for example with z up and with y up.
#
# With C from the frame of positions to that of rotations, the lever arm rows are linear in M = C^T:
#
#     y = M a + M S p + g    y: from positions, a: from the IMU, S: factor of the lever arm p, g: gravity
#
# M is estimated by linear regression of y on a, S and g, with M, M p and g as independent unknowns. C is the
# orthogonal factor of its polar decomposition. It is a candidate: the caller rotates the positions by it and tests the
# fit.

MAX_AXES_ERROR = 0.35  # largest entry of the difference from an exchange of axes: within 20 deg, C is replaced by it
MIN_POLAR_RATIO = 0.5  # least ratio of smallest to largest singular value of M; 1 for a rotation
MIN_FRAME_ROWS = 40  # least number of measurements, three times the 13 regressors
IDENTITY = np.eye(3)


def rotation_of_positions(rows: LeverArmRows, R_world_frame: np.ndarray = IDENTITY) -> np.ndarray | None:
    """Estimated rotation C (3, 3) from the frame of positions to that of rotations. None if it is the identity, if the
    regression does not give a rotation, or if there are few rows. R_world_frame (3, 3): rotation from the frame of
    rotations to the axes of the rows."""
    from_imu, n = rows.motion - rows.b, len(rows.b)
    X = np.concatenate([from_imu, rows.A[:, :, 3:6].reshape(n, 9), rows.A[:, 0, 6:7]], axis=1)
    if n < MIN_FRAME_ROWS:
        return None
    weight, M = np.ones(n), np.eye(3)
    for _ in range(3):
        x = np.linalg.lstsq(X * weight[:, None], rows.motion * weight[:, None], rcond=None)[0]
        size = np.linalg.norm(rows.motion - X @ x, axis=1)
        weight, M = (size < 4.0 * np.median(size) + 1e-9).astype(float), x[:3].T
    U, singular, Vt = np.linalg.svd(M)
    if singular[2] < MIN_POLAR_RATIO * singular[0] or np.linalg.det(U @ Vt) < 0.0:
        return None
    C = nearest_axes(R_world_frame.T @ (U @ Vt).T @ R_world_frame)
    return None if np.allclose(C, np.eye(3)) else C


def nearest_axes(C: np.ndarray) -> np.ndarray:
    """The nearest of the 24 rotations that exchange axes, if C (3, 3) is close to one; otherwise C."""
    cube = [
        np.diag(signs)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
        if np.linalg.det(np.diag(signs)[list(order)]) > 0.0
    ]
    best = max(cube, key=lambda P: float(np.sum(P * C)))
    return best if np.abs(C - best).max() < MAX_AXES_ERROR else C


def axes_text(C: np.ndarray) -> str | None:
    """C (3, 3) as `position_axes` in the rig file; None if it is not an exchange of axes."""
    if not np.allclose(np.abs(C).max(axis=1), 1.0):
        return None
    entries = [("-" if row.min() < -0.5 else "") + "xyz"[int(np.argmax(np.abs(row)))] for row in C]
    return f"[{', '.join(entries)}]"
