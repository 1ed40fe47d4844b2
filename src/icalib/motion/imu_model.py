"""From raw IMU readings to body rates: Kalibr's scale-misalignment model.

    gyro  = M_g C w + A_g f + b_g + noise        f: specific force, w: angular rate, both in the imu frame
    accel = M_a f + b_a + noise                  M: lower triangular, C = Exp(r): accelerometer to gyroscope axes

Intrinsics are 24 numbers (`rig.imu_classes.INTRINSICS_LABELS`), zero for an ideal IMU:
M_a - I (xx yx yy zx zy zz), M_g - I (same), r (3), A_g (row-major 9).
"""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.small import mul3, tmul3

_ROW = np.array([0, 1, 1, 2, 2, 2])
_COL = np.array([0, 0, 1, 0, 1, 2])


@njit(cache=True, nogil=True)
def _lower_inverse(m):
    """Inverse of a lower triangular 3x3 matrix."""
    inv = np.zeros((3, 3))
    for i in range(3):
        inv[i, i] = 1.0 / m[i, i]
    inv[1, 0] = -m[1, 0] * inv[0, 0] * inv[1, 1]
    inv[2, 1] = -m[2, 1] * inv[1, 1] * inv[2, 2]
    inv[2, 0] = -(m[2, 0] * inv[0, 0] + m[2, 1] * inv[1, 0]) * inv[2, 2]
    return inv


@njit(cache=True, nogil=True)
def sensitivity(intrinsics):
    """A_g (3, 3)."""
    out = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            out[i, j] = intrinsics[15 + 3 * i + j]
    return out


@njit(cache=True, nogil=True)
def correction_matrices(intrinsics):
    """Matrices that undo the model: f = F (accel - b_a), w = G (gyro - b_g) + H (accel - b_a); returns F, G, H."""
    ma, mg = np.eye(3), np.eye(3)
    for n in range(6):
        ma[_ROW[n], _COL[n]] += intrinsics[n]
        mg[_ROW[n], _COL[n]] += intrinsics[6 + n]
    F = _lower_inverse(ma)
    C = so3.exp(intrinsics[12:15])
    G = tmul3(C, _lower_inverse(mg))
    H = mul3(mul3(G, sensitivity(intrinsics)), F)
    for i in range(3):
        for j in range(3):
            H[i, j] = -H[i, j]
    return F, G, H


@njit(cache=True, nogil=True)
def intrinsics_jacobians(intrinsics, F, G, force, rate, d_rate, d_force):
    """Fills d rate / d intrinsics and d force / d intrinsics, both (3, 24), at corrected `force` and `rate`."""
    C, u = so3.exp(intrinsics[12:15]), np.empty(3)
    for i in range(3):
        u[i] = C[i, 0] * rate[0] + C[i, 1] * rate[1] + C[i, 2] * rate[2]
    GA = mul3(G, sensitivity(intrinsics))
    for n in range(6):
        for i in range(3):
            d_force[i, n] = -F[i, _ROW[n]] * force[_COL[n]]
            d_rate[i, 6 + n] = -G[i, _ROW[n]] * u[_COL[n]]
    for n in range(6):
        for i in range(3):
            d_rate[i, n] = -(GA[i, 0] * d_force[0, n] + GA[i, 1] * d_force[1, n] + GA[i, 2] * d_force[2, n])
    turn = mul3(so3.hat(rate), so3.right_jacobian(intrinsics[12:15]))
    for i in range(3):
        for j in range(3):
            d_rate[i, 12 + j] = turn[i, j]
            for k in range(3):
                d_rate[i, 15 + 3 * j + k] = -G[i, j] * force[k]
