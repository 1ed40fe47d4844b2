"""Planes n . p = d, parametrised by a unit normal n and a point on the plane, about which the plane rotates.

The three tangent parameters are two angles, which rotate the normal towards `tangents`, and a distance along the
normal. With the centroid of its measurements as the point, these parameters hardly correlate. With the world's origin
instead, distance and angles of a far wall would correlate almost perfectly.

The iCalib paper uses the closest point d n instead (equations as numbered in docs/estimator.md). It is singular for
planes through the origin, and its residual (24) changes sign if the plane is behind the sensor.
"""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3


@njit(cache=True, nogil=True)
def tangents(normal):
    """(2, 3) two unit vectors that form a right-handed frame with a unit normal (3,) as third axis (Duff et al.
    2017)."""
    x, y, z = normal[0], normal[1], normal[2]
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    out = np.empty((2, 3))
    out[0, 0], out[0, 1], out[0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    out[1, 0], out[1, 1], out[1, 2] = b, sign + y * y * a, -y
    return out


def plane_of(normal: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Plane (6,) with a normal (3,) of any length and a point (3,) on the plane [m]."""
    return np.concatenate([normal / np.linalg.norm(normal), point])


def moved(plane: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Plane (6,) after a correction d (3,): rotation of the normal towards its two tangents [rad], then a shift along
    it [m]."""
    normal, point = plane[:3], plane[3:]
    angle = sqrt(d[0] * d[0] + d[1] * d[1])
    towards = d[:2] @ tangents(np.ascontiguousarray(normal))
    tilted = cos(angle) * normal + (sin(angle) / angle if angle > 0.0 else 1.0) * towards
    return plane_of(tilted, point + d[2] * normal)


def moved_and_turned(plane: np.ndarray, d: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Plane (6,) after a correction d (3,) and an exact rotation of the world by `turn` (3,) [rad] about its origin. d
    includes the first-order effect of the rotation, which is subtracted first."""
    normal, point = plane[:3], plane[3:]
    across = tangents(np.ascontiguousarray(normal))
    correction = d - np.append(across @ np.cross(turn, normal), normal @ np.cross(turn, point))
    Q, at = so3.exp(turn), moved(plane, correction)
    return np.concatenate([Q @ at[:3], Q @ at[3:]])


def difference(to: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """(3,) correction d for which `moved(plane, d)` is the plane `to` (6,), to first order."""
    across = tangents(np.ascontiguousarray(plane[:3]))
    return np.append(across @ to[:3], plane[:3] @ (to[3:] - plane[3:]))


# Fits of the two edges that meet in a corner of a target, one row for each edge.
#
# Columns: first end (2,) and second end (2,) px of the fitted piece, relative to the corner; gain (2,) px^2,
# derivative of the corner by the curvature of the edge; fitted curvature [1 / px]. The curvature is positive if the
# piece turns left from the first end to the second, with u to the right and v down.

EDGE = 7  # number of columns
NO_EDGES = np.zeros((0, 2, EDGE), dtype=np.float32)  # the fits of no corners
