"""A path through noisy poses: around each instant a parabola of rotation and position, fitted to the poses nearby."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from icalib.geometry import so3
from icalib.geometry.small import tmul3

HALF_S = 0.1  # of the window, at least
HALF_STEPS = 3.2  # and in steps between poses
FEWEST = 5  # poses under a parabola


@dataclass(frozen=True)
class SmoothPath:
    """At seconds (m,): R_world_body (m, 3, 3), p_world_body (m, 3), the rate (m, 3) rad/s in the body's axes, the
    velocity (m, 3) m/s in the world's, the acceleration (m, 3) m/s^2 in the body's; near (m,): whether there are poses
    within the window, on both sides."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    near: np.ndarray


@dataclass(frozen=True)
class BodyPoses:
    """Poses of the body in one recording, on its clock since its first stamp: seconds (n,), R_world_body (n, 3, 3),
    p_world_body (n, 3) m."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray

    def at(self, seconds: np.ndarray) -> SmoothPath:
        """See `smooth_path`."""
        return smooth_path(self.seconds, self.rotation, self.position, seconds)


def smooth_path(t: np.ndarray, R: np.ndarray, p: np.ndarray, at: np.ndarray) -> SmoothPath:
    """Through poses R (n, 3, 3), p (n, 3) at increasing t (n,), n >= FEWEST, looked at at `at` (m,)."""
    half = max(HALF_S, HALF_STEPS * float(np.median(np.diff(t))))
    first, last = np.searchsorted(t, at - half), np.searchsorted(t, at + half)
    few = last - first < FEWEST
    middle = np.clip(np.searchsorted(t, at) - FEWEST // 2, 0, len(t) - FEWEST)
    first, last = np.where(few, middle, first), np.where(few, middle + FEWEST, last)
    near = ~few & (t[first] <= at) & (t[last - 1] >= at)
    fitted = np.empty((len(at), 3, 6))
    reference = np.clip(np.searchsorted(0.5 * (t[1:] + t[:-1]), at), 0, len(t) - 1)
    _parabolas(t, R, p, at, first, last, reference, half, fitted)
    turn, way = fitted[:, 0, :3], fitted[:, 0, 3:]
    rotation = R[reference] @ so3.exp_many(np.ascontiguousarray(turn))
    acceleration = np.einsum("mji,mj->mi", rotation, fitted[:, 2, 3:])
    return SmoothPath(at, rotation, way, fitted[:, 1, :3], fitted[:, 1, 3:], acceleration, near)


@njit(cache=True, nogil=True)
def _parabolas(t, R, p, at, first, last, reference, half, out):
    """out (m, 3, 6): value, slope and curvature of rotation vectors from R[reference] and of positions; in place of the
    slope of the former the rate in the body's axes."""
    row, y = np.empty(3), np.empty(6)
    for m in range(len(at)):
        A, b = np.zeros((3, 3)), np.zeros((3, 6))
        R0 = R[reference[m]]
        for i in range(first[m], last[m]):
            u = (t[i] - at[m]) / half
            row[0], row[1], row[2] = 1.0, u, 0.5 * u * u
            turn = so3.log(tmul3(R0, R[i]))
            for k in range(3):
                y[k], y[3 + k] = turn[k], p[i, k]
            for a in range(3):
                for c in range(3):
                    A[a, c] += row[a] * row[c]
                for c in range(6):
                    b[a, c] += row[a] * y[c]
        x = np.linalg.solve(A, b)
        for c in range(6):
            out[m, 0, c], out[m, 1, c], out[m, 2, c] = x[0, c], x[1, c] / half, x[2, c] / (half * half)
        J = so3.right_jacobian(out[m, 0, :3])
        for a in range(3):
            row[a] = J[a, 0] * out[m, 1, 0] + J[a, 1] * out[m, 1, 1] + J[a, 2] * out[m, 1, 2]
        for a in range(3):
            out[m, 1, a] = row[a]
