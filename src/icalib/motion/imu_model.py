"""Scale-misalignment model of IMU readings, in the axes of the gyroscope.

    gyro  = M_g w + A_g f + b_g + noise      w: angular rate, f: specific force, both in the IMU frame
    accel = M_a C f + b_a + noise            M: lower triangular, C = Exp(r): gyroscope to accelerometer axes

The IMU frame has its origin at the accelerometer and the axes of the gyroscope. Its x axis is the one that the
gyroscope's x axis measures, because M_g is lower triangular. Kalibr's frame has the axes of the accelerometer instead,
rotated by C.

Intrinsics are 24 numbers (`INTRINSICS_LABELS` of `sensors.imu.spec`), zero for an ideal IMU: M_a - I (xx yx yy zx zy
zz), M_g - I (same), r (3), A_g (row-major 9).
"""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.small import mul3, tmul3

_LOWER_ROW = np.array([0, 1, 1, 2, 2, 2])
_LOWER_COLUMN = np.array([0, 0, 1, 0, 1, 2])


@njit(cache=True, nogil=True)
def _lower_inverse(m):
    """Inverse (3, 3) of a lower triangular matrix (3, 3)."""
    inv = np.zeros((3, 3))
    for i in range(3):
        inv[i, i] = 1.0 / m[i, i]
    inv[1, 0] = -m[1, 0] * inv[0, 0] * inv[1, 1]
    inv[2, 1] = -m[2, 1] * inv[1, 1] * inv[2, 2]
    inv[2, 0] = -(m[2, 0] * inv[0, 0] + m[2, 1] * inv[1, 0]) * inv[2, 2]
    return inv


@njit(cache=True, nogil=True)
def correction_matrices(intrinsics):
    """Matrices F, G, H that invert the model: f = F (accel - b_a), w = G (gyro - b_g) + H (accel - b_a); and G A_g."""
    ma, mg = np.eye(3), np.eye(3)
    for n in range(6):
        ma[_LOWER_ROW[n], _LOWER_COLUMN[n]] += intrinsics[n]
        mg[_LOWER_ROW[n], _LOWER_COLUMN[n]] += intrinsics[6 + n]
    F, G = tmul3(so3.exp(intrinsics[12:15]), _lower_inverse(ma)), _lower_inverse(mg)
    GA = mul3(G, intrinsics[15:24].reshape((3, 3)))
    return F, G, -mul3(GA, F), GA
