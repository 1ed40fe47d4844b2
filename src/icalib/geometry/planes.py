"""Planes n . p = d, held as a unit normal n and a point on them: the point that they turn about when corrected.

A plane's tangent is (two angles that turn the normal towards `tangents`, distance moved along the normal). About its
own centroid these three hardly correlate; about the world's origin a far wall's distance and angles are nearly one. The
paper's closest point (d n) is singular for planes through the origin, and its residual (24) flips its sign when the
plane lies behind the sensor.
"""

from __future__ import annotations

from math import cos, sin, sqrt

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3


@njit(cache=True, nogil=True)
def tangents(normal):
    """(2, 3): two unit vectors across a unit normal (3,), right-handed with it (Duff et al. 2017)."""
    x, y, z = normal[0], normal[1], normal[2]
    sign = 1.0 if z >= 0.0 else -1.0
    a = -1.0 / (sign + z)
    b = x * y * a
    out = np.empty((2, 3))
    out[0, 0], out[0, 1], out[0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    out[1, 0], out[1, 1], out[1, 2] = b, sign + y * y * a, -y
    return out


def plane_of(normal: np.ndarray, point: np.ndarray) -> np.ndarray:
    """(6,) plane of a normal (3,) of any length and a point (3,) on it [m]."""
    return np.concatenate([normal / np.linalg.norm(normal), point])


def moved(plane: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Plane (6,) corrected by d (3,): the normal's turn towards its two tangents [rad], then along it [m]."""
    normal, point = plane[:3], plane[3:]
    angle = sqrt(d[0] * d[0] + d[1] * d[1])
    towards = d[:2] @ tangents(np.ascontiguousarray(normal))
    turned = cos(angle) * normal + (sin(angle) / angle if angle > 0.0 else 1.0) * towards
    return plane_of(turned, point + d[2] * normal)


def moved_and_turned(plane: np.ndarray, d: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """As `moved`, to first order, in a world that turns by `turn` (3,) about its origin, exactly: d (3,) less what the
    turn makes of it comes first."""
    normal, point = plane[:3], plane[3:]
    across = tangents(np.ascontiguousarray(normal))
    own = d - np.append(across @ np.cross(turn, normal), normal @ np.cross(turn, point))
    Q, at = so3.exp(turn), moved(plane, own)
    return np.concatenate([Q @ at[:3], Q @ at[3:]])


def difference(to: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """(3,) d with `moved(plane, d)` the plane `to` (6,), to first order."""
    across = tangents(np.ascontiguousarray(plane[:3]))
    return np.append(across @ to[:3], plane[:3] @ (to[3:] - plane[3:]))


def closest_point(plane: np.ndarray) -> np.ndarray:
    """(3,) the paper's p_pi = d n: the point of `plane` (6,) closest to the origin [m]."""
    return (plane[:3] @ plane[3:]) * plane[:3]


def closest_point_residual(
    p_pi: np.ndarray, R_world_lidar: np.ndarray, p_world_lidar: np.ndarray, xyz: np.ndarray
) -> np.ndarray:
    """(N,) the paper's (24) and (25) for a closest point (3,) in the world and points xyz (N, 3) in the sensor's frame.

    It is n . p - d of each point if the sensor and the origin are on the same side of the plane, and the negative if
    not. It is not defined for a plane through the origin or through the sensor. In (24) p_pi / |p_pi| stands for n:
    with d_L < 0 that is -n.
    """
    d = np.linalg.norm(p_pi)
    normal = p_pi / d
    d_lidar = d - normal @ p_world_lidar
    p_pi_lidar = d_lidar * (R_world_lidar.T @ normal)
    size = np.linalg.norm(p_pi_lidar)
    return xyz @ p_pi_lidar / size - size
