"""Relative planar poses of a differential drive, preintegrated from its wheel angles: z_W of equation (27) of the
iCalib paper.

Poses are in the wheel frame at the first stamp of an interval. Rates are assumed constant from stamp to stamp, so that
each step is an arc. With d_l, d_r the angles that the wheels turn and psi the yaw before the step:

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
    """n relative planar poses (yaw, x, y) [rad, m, m].

    z (n, 3): poses at the parameters drive0 (3,): left radius, right radius, baseline [m]. J_drive (n, 3, 3):
    derivative of z by these parameters. W (n, 3, 3): whitens the error of z; W^T W is the inverse covariance.
    """

    z: np.ndarray
    J_drive: np.ndarray
    W: np.ndarray
    drive0: np.ndarray


@njit(cache=True, nogil=True)
def _sinc(h):
    """sin(h) / h and its derivative; Taylor series of both for small h."""
    if abs(h) < 1e-2:
        x = h * h
        return 1.0 - x / 6.0 * (1.0 - x / 20.0), -h / 3.0 * (1.0 - x / 10.0 * (1.0 - x / 28.0))
    s = sin(h) / h
    return s, (cos(h) - s) / h


@njit(cache=True, nogil=True)
def _arc(psi, turn, path, J_step):
    """Step (dx, dy) [m] of an arc with the yaw psi [rad] at its start, the yaw change `turn` [rad] and the length
    `path` [m]. Fills J_step (3, 2), the Jacobian of (yaw, x, y) by (turn, path)."""
    s, slope = _sinc(0.5 * turn)
    c, n = cos(psi + 0.5 * turn), sin(psi + 0.5 * turn)
    dx, dy = path * s * c, path * s * n
    J_step[0, 0], J_step[0, 1] = 1.0, 0.0
    J_step[1, 0], J_step[1, 1] = 0.5 * (path * slope * c - dy), s * c
    J_step[2, 0], J_step[2, 1] = 0.5 * (path * slope * n + dx), s * n
    return dx, dy


@njit(cache=True, nogil=True)
def _propagate(dx, dy, rows):
    """Propagates rows (3, m), derivatives of (yaw, x, y), over the step (dx, dy): an error of yaw moves the end
    point."""
    for j in range(rows.shape[1]):
        rows[1, j] -= dy * rows[0, j]
        rows[2, j] += dx * rows[0, j]


@njit(cache=True, nogil=True)
def _integrate(first, last, seconds, angles, drive, wheel_noise, slip_noise, z, J, P):
    """Fills the pose z (3,) from stamp `first` to `last`, its Jacobian J (3, 3) by the drive parameters and its
    covariance P (3, 3); noise densities in rad/sqrt(s) and m/sqrt(s)."""
    z[:], J[:], P[:] = 0.0, 0.0, 0.0
    J_step, J_drive, J_angle = np.empty((3, 2)), np.zeros((2, 3)), np.empty((2, 2))
    r_l, r_r, b = drive
    J_angle[0, 0], J_angle[0, 1], J_angle[1, 0], J_angle[1, 1] = -r_l / b, r_r / b, 0.5 * r_l, 0.5 * r_r
    for n in range(first, last):
        d_l, d_r, dt = angles[n + 1, 0] - angles[n, 0], angles[n + 1, 1] - angles[n, 1], seconds[n + 1] - seconds[n]
        turn, path = (r_r * d_r - r_l * d_l) / b, 0.5 * (r_r * d_r + r_l * d_l)
        J_drive[0, 0], J_drive[0, 1], J_drive[0, 2] = -d_l / b, d_r / b, -turn / b
        J_drive[1, 0], J_drive[1, 1] = 0.5 * d_l, 0.5 * d_r
        dx, dy = _arc(z[0], turn, path, J_step)
        slip = (0.0, -sin(z[0] + 0.5 * turn) * slip_noise, cos(z[0] + 0.5 * turn) * slip_noise)
        _propagate(dx, dy, J)
        _propagate(dx, dy, P)
        _propagate(dx, dy, P.T)
        for i in range(3):
            left_i = (J_step[i, 0] * J_angle[0, 0] + J_step[i, 1] * J_angle[1, 0]) * wheel_noise
            right_i = (J_step[i, 0] * J_angle[0, 1] + J_step[i, 1] * J_angle[1, 1]) * wheel_noise
            for j in range(3):
                J[i, j] += J_step[i, 0] * J_drive[0, j] + J_step[i, 1] * J_drive[1, j]
                left_j = (J_step[j, 0] * J_angle[0, 0] + J_step[j, 1] * J_angle[1, 0]) * wheel_noise
                right_j = (J_step[j, 0] * J_angle[0, 1] + J_step[j, 1] * J_angle[1, 1]) * wheel_noise
                P[i, j] += (left_i * left_j + right_i * right_j + slip[i] * slip[j]) * dt
        z[0] += turn
        z[1] += dx
        z[2] += dy


@njit(cache=True, nogil=True)
def _integrate_all(first, last, seconds, angles, drive, wheel_noise, slip_noise, z, J, W):
    """Fills z (n, 3), J (n, 3, 3) and W (n, 3, 3) of `RelativePoses` for n intervals."""
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
    """Relative poses over n intervals from wheel angles (N, 2) rad at stamps seconds (N,); drive (3,) m as in
    `RelativePoses`.

    wheel_noise: density of each wheel's angle [rad/sqrt(s)]; slip_noise: density of lateral slip [m/sqrt(s)]. Both must
    be above zero: without slip the covariance of a short interval is singular, and the lateral variance of a long one
    is too small.
    """
    n = len(intervals.keyframe)
    z, J, W = np.empty((n, 3)), np.empty((n, 3, 3)), np.empty((n, 3, 3))
    drive0 = np.array(drive, dtype=np.float64)
    _integrate_all(intervals.first, intervals.last, seconds, angles, drive0, wheel_noise, slip_noise, z, J, W)
    return RelativePoses(z, J, W, drive0)
