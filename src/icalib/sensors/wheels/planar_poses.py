"""Planar poses of a differential drive between wheel stamps, integrated from its wheels (paper (27), its z_W).

In the frame of the wheels at the first stamp, with both rates constant from stamp to stamp, each step is an arc:

    dpsi = (r_r d_r - r_l d_l) / b    ds = (r_r d_r + r_l d_l) / 2
    (dx, dy) = ds sinc(dpsi / 2) (cos, sin)(psi + dpsi / 2)
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, sin

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.small import inverse_cholesky
from icalib.motion.stamp_intervals import StampIntervals


@dataclass(frozen=True)
class RelativePoses:
    """n planar poses (yaw, x, y) [rad, m, m]: z (n, 3), its derivative J (n, 3, 3) by drive (left radius, right radius,
    baseline) [m] at `drive0` (3,), and W (n, 3, 3), which whitens its error."""

    z: np.ndarray
    J: np.ndarray
    W: np.ndarray
    drive0: np.ndarray


@njit(cache=True, nogil=True)
def _sinc(h):
    """sin(h) / h and its derivative."""
    if abs(h) < 1e-2:
        x = h * h
        return 1.0 - x / 6.0 * (1.0 - x / 20.0), -h / 3.0 * (1.0 - x / 10.0 * (1.0 - x / 28.0))
    s = sin(h) / h
    return s, (cos(h) - s) / h


@njit(cache=True, nogil=True)
def _arc(psi, turn, path, G):
    """Step (dx, dy) and its derivative: G (3, 2) of (yaw, x, y) by (turn, path)."""
    s, slope = _sinc(0.5 * turn)
    c, n = cos(psi + 0.5 * turn), sin(psi + 0.5 * turn)
    dx, dy = path * s * c, path * s * n
    G[0, 0], G[0, 1] = 1.0, 0.0
    G[1, 0], G[1, 1] = 0.5 * (path * slope * c - dy), s * c
    G[2, 0], G[2, 1] = 0.5 * (path * slope * n + dx), s * n
    return dx, dy


@njit(cache=True, nogil=True)
def _carry(dx, dy, rows):
    """rows (3, m) of an error of the pose before a step -> after it."""
    for j in range(rows.shape[1]):
        rows[1, j] -= dy * rows[0, j]
        rows[2, j] += dx * rows[0, j]


@njit(cache=True, nogil=True)
def _integrate(first, last, seconds, angles, drive, wheel_noise, slip_noise, z, J, P):
    """Fills z (3,), J (3, 3) and P (3, 3) from stamp `first` to `last`; noise as densities, rad/sqrt(s), m/sqrt(s)."""
    z[:], J[:], P[:] = 0.0, 0.0, 0.0
    G, by_drive, by_angle = np.empty((3, 2)), np.zeros((2, 3)), np.empty((2, 2))
    r_l, r_r, b = drive
    by_angle[0, 0], by_angle[0, 1], by_angle[1, 0], by_angle[1, 1] = -r_l / b, r_r / b, 0.5 * r_l, 0.5 * r_r
    for n in range(first, last):
        d_l, d_r, dt = angles[n + 1, 0] - angles[n, 0], angles[n + 1, 1] - angles[n, 1], seconds[n + 1] - seconds[n]
        turn, path = (r_r * d_r - r_l * d_l) / b, 0.5 * (r_r * d_r + r_l * d_l)
        by_drive[0, 0], by_drive[0, 1], by_drive[0, 2] = -d_l / b, d_r / b, -turn / b
        by_drive[1, 0], by_drive[1, 1] = 0.5 * d_l, 0.5 * d_r
        dx, dy = _arc(z[0], turn, path, G)
        slip = (0.0, -sin(z[0] + 0.5 * turn) * slip_noise, cos(z[0] + 0.5 * turn) * slip_noise)
        _carry(dx, dy, J)
        _carry(dx, dy, P)
        _carry(dx, dy, P.T)
        for i in range(3):
            by_l = (G[i, 0] * by_angle[0, 0] + G[i, 1] * by_angle[1, 0]) * wheel_noise
            by_r = (G[i, 0] * by_angle[0, 1] + G[i, 1] * by_angle[1, 1]) * wheel_noise
            for j in range(3):
                J[i, j] += G[i, 0] * by_drive[0, j] + G[i, 1] * by_drive[1, j]
                other_l = (G[j, 0] * by_angle[0, 0] + G[j, 1] * by_angle[1, 0]) * wheel_noise
                other_r = (G[j, 0] * by_angle[0, 1] + G[j, 1] * by_angle[1, 1]) * wheel_noise
                P[i, j] += (by_l * other_l + by_r * other_r + slip[i] * slip[j]) * dt
        z[0] += turn
        z[1] += dx
        z[2] += dy


@njit(cache=True, nogil=True)
def _integrate_all(first, last, seconds, angles, drive, wheel_noise, slip_noise, z, J, W):
    P = np.empty((3, 3))
    for i in range(len(first)):
        _integrate(first[i], last[i], seconds, angles, drive, wheel_noise, slip_noise, z[i], J[i], P)
        inverse_cholesky(P, W[i])


def preintegrated(
    seconds: np.ndarray,
    angles: np.ndarray,
    intervals: StampIntervals,
    drive: np.ndarray,
    wheel_noise: float,
    slip_noise: float,
) -> RelativePoses:
    """Poses from wheel angles (N, 2) rad at stamps seconds (N,), with the radii and baseline `drive` (3,) m.

    wheel_noise: density of each wheel's angle, rad/sqrt(s); slip_noise: of lateral slip, m/sqrt(s). Both above zero:
    without slip the covariance of a short interval is singular, and of a long one it claims what no vehicle does.
    """
    n = len(intervals.keyframe)
    z, J, W = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3, 3))
    drive0 = np.array(drive, dtype=np.float64)
    _integrate_all(intervals.first, intervals.last, seconds, angles, drive0, wheel_noise, slip_noise, z, J, W)
    return RelativePoses(z, J, W, drive0)


def between_given(poses: np.ndarray, intervals: StampIntervals, covariance: np.ndarray) -> RelativePoses:
    """From planar poses (N, 3), yaw, x, y in a frame that stands still, that a driver gives at its stamps.

    covariance (n, 3, 3) of each relative pose (yaw, x, y). They say nothing of radii and baseline.
    """
    a, b = poses[intervals.first], poses[intervals.last]
    turn = b[:, 0] - a[:, 0]
    c, s, d = np.cos(a[:, 0]), np.sin(a[:, 0]), b[:, 1:] - a[:, 1:]
    z = np.stack([np.arctan2(np.sin(turn), np.cos(turn)), c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]], axis=1)
    W = np.linalg.inv(np.linalg.cholesky(covariance))
    return RelativePoses(z, np.zeros((len(z), 3, 3)), np.ascontiguousarray(W), np.zeros(3))
