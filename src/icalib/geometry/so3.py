"""SO(3): exponential, logarithm and their Jacobians, compiled, accurate at every angle.

Rotations are perturbed on the right, R <- R Exp(phi). Formulas: Sola et al., "A micro Lie theory", appendix B. Taylor
series are used where the closed forms lose digits.
"""

from __future__ import annotations

from math import atan2, cos, hypot, sin, sqrt

import numpy as np

from icalib.base.compiled import njit

# rad^2; below this squared angle, series in theta^2 are used. They have a relative error below 1e-16 at the limit,
# where (theta - sin theta) / theta^3 still has 13 digits in closed form.
SERIES_BELOW = 0.01
_1_6, _1_12, _1_20, _1_24, _1_30, _1_42, _1_56 = (1.0 / n for n in (6.0, 12.0, 20.0, 24.0, 30.0, 42.0, 56.0))
_1_72, _1_90, _1_110, _1_132, _1_156, _1_182 = (1.0 / n for n in (72.0, 90.0, 110.0, 132.0, 156.0, 182.0))


@njit(cache=True, nogil=True)
def hat(v):
    """(3, 3) skew-symmetric matrix of v (3,), with hat(v) w = v x w."""
    m = np.zeros((3, 3))
    m[0, 1], m[0, 2] = -v[2], v[1]
    m[1, 0], m[1, 2] = v[2], -v[0]
    m[2, 0], m[2, 1] = -v[1], v[0]
    return m


@njit(cache=True, nogil=True)
def jacobian_coefficients(x):
    """With theta = sqrt(x) [rad]: sin(theta) / theta, (1 - cos(theta)) / theta^2, (theta - sin(theta)) / theta^3,
    (theta^2 / 2 - 1 + cos(theta)) / theta^4."""
    if x < SERIES_BELOW:  # products with precomputed reciprocals, as divisions take ten times as long
        s0 = 1.0 - x * _1_6 * (1.0 - x * _1_20 * (1.0 - x * _1_42 * (1.0 - x * _1_72 * (1.0 - x * _1_110))))
        s1 = 0.5 * (1.0 - x * _1_12 * (1.0 - x * _1_30 * (1.0 - x * _1_56 * (1.0 - x * _1_90 * (1.0 - x * _1_132)))))
        s2 = _1_6 * (1.0 - x * _1_20 * (1.0 - x * _1_42 * (1.0 - x * _1_72 * (1.0 - x * _1_110 * (1.0 - x * _1_156)))))
        s3 = _1_24 * (1.0 - x * _1_30 * (1.0 - x * _1_56 * (1.0 - x * _1_90 * (1.0 - x * _1_132 * (1.0 - x * _1_182)))))
        return s0, s1, s2, s3
    theta = sqrt(x)
    half = sin(0.5 * theta)
    s0 = sin(theta) / theta
    s1 = 2.0 * half * half / x
    s2 = (1.0 - s0) / x
    s3 = (0.5 - s1) / x
    return s0, s1, s2, s3


@njit(cache=True, nogil=True)
def _polynomial(v, a, b):
    """I + a hat(v) + b hat(v)^2."""
    x, y, z = v[0], v[1], v[2]
    m = np.empty((3, 3))
    m[0, 0] = 1.0 - b * (y * y + z * z)
    m[1, 1] = 1.0 - b * (x * x + z * z)
    m[2, 2] = 1.0 - b * (x * x + y * y)
    m[0, 1] = -a * z + b * x * y
    m[1, 0] = a * z + b * x * y
    m[0, 2] = a * y + b * x * z
    m[2, 0] = -a * y + b * x * z
    m[1, 2] = -a * x + b * y * z
    m[2, 1] = a * x + b * y * z
    return m


@njit(cache=True, nogil=True)
def exp(phi):
    """Rotation matrix (3, 3) of a rotation vector (3,) [rad]."""
    s0, s1, _, _ = jacobian_coefficients(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
    return _polynomial(phi, s0, s1)


@njit(cache=True, nogil=True, inline="always")
def _quaternion(R):
    """Unit quaternion (w, x, y, z), w >= 0, of a rotation matrix, by its largest component (Shepperd)."""
    q = np.empty(4)
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    i = 0 if R[0, 0] > R[1, 1] else 1
    if R[2, 2] > R[i, i]:
        i = 2
    if trace > R[i, i]:
        q[0] = 1.0 + trace
        q[1], q[2], q[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[0] = R[k, j] - R[j, k]
        q[1 + i] = 1.0 + R[i, i] - R[j, j] - R[k, k]
        q[1 + j] = R[j, i] + R[i, j]
        q[1 + k] = R[k, i] + R[i, k]
    norm = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[0] < 0.0:
        norm = -norm
    for n in range(4):
        q[n] /= norm
    return q


@njit(cache=True, nogil=True)
def log(R):
    """Rotation vector (3,) [rad] of a rotation matrix (3, 3), with an angle in [0, pi]."""
    q = _quaternion(R)
    s = sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    # 2 atan(s / w) / s; its limit as s -> 0 is 2, up to rounding.
    scale = 2.0 * atan2(s, q[0]) / s if s > 1e-20 else 2.0
    phi = np.empty(3)
    for n in range(3):
        phi[n] = scale * q[1 + n]
    return phi


@njit(cache=True, nogil=True)
def right_jacobian(phi):
    """(3, 3) J_r with Exp(phi + d) = Exp(phi) Exp(J_r d) to first order."""
    _, s1, s2, _ = jacobian_coefficients(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2])
    return _polynomial(phi, -s1, s2)


@njit(cache=True, nogil=True)
def _inverse_coefficient(x):
    """(1 - theta / 2 cot(theta / 2)) / theta^2 with theta = sqrt(x) [rad]."""
    if x < SERIES_BELOW:
        return (1.0 + x / 60.0 * (1.0 + x / 42.0 * (1.0 + x / 40.0))) / 12.0
    half = 0.5 * sqrt(x)
    return (1.0 - half * cos(half) / sin(half)) / x


@njit(cache=True, nogil=True)
def left_jacobian_inverse(phi):
    """(3, 3) J_l^-1 with Exp(phi + d) = Exp(J_l d) Exp(phi) to first order, for angles up to pi."""
    return _polynomial(phi, -0.5, _inverse_coefficient(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]))


@njit(cache=True, nogil=True)
def right_jacobian_inverse(phi):
    """Inverse of `right_jacobian`, for angles up to pi."""
    return _polynomial(phi, 0.5, _inverse_coefficient(phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]))


def hat_many(v: np.ndarray) -> np.ndarray:
    """(..., 3, 3) skew-symmetric matrices of v (..., 3), with hat(v) w = v x w."""
    m = np.zeros((*v.shape, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return m - np.swapaxes(m, -1, -2)


@njit(cache=True, nogil=True)
def exp_many(phi):
    """(N, 3, 3) rotation matrices of rotation vectors (N, 3) [rad]."""
    R = np.empty((len(phi), 3, 3))
    for i in range(len(phi)):
        one = exp(phi[i])
        for j in range(3):
            for k in range(3):
                R[i, j, k] = one[j, k]
    return R


@njit(cache=True, nogil=True)
def log_many(R):
    """(N, 3) rotation vectors [rad] of rotation matrices (N, 3, 3)."""
    phi = np.empty((len(R), 3))
    for i in range(len(R)):
        one = log(R[i])
        for j in range(3):
            phi[i, j] = one[j]
    return phi


@njit(cache=True, nogil=True)
def chain(steps, out):
    """Fill out (N + 1, 3, 3) with products of rotations: out[i + 1] = out[i] steps[i]. out[0] is given."""
    for n in range(len(steps)):
        for i in range(3):
            for j in range(3):
                s = 0.0
                for k in range(3):
                    s += out[n, i, k] * steps[n, k, j]
                out[n + 1, i, j] = s


def closest_rotation(matrix: np.ndarray) -> np.ndarray:
    """Rotation R (3, 3) closest to `matrix` (3, 3) in the Frobenius norm. If matrix is the sum of a b^T, it is the
    least-squares solution of a = R b (Kabsch 1976)."""
    U, _, Vt = np.linalg.svd(matrix)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def value_change(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """(n,) change between two values of a parameter, in the form of its standard deviations: the rotation vector in the
    sensor's axes [rad] for rotations (3, 3), the difference for vectors (n,)."""
    return log(np.ascontiguousarray(before.T @ after)) if after.ndim == 2 else after - before


# Roll, pitch and yaw of a rotation matrix R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF, with standard deviations.

# Distance from gimbal lock, in standard deviations, below which roll, pitch and yaw have none: at 5, those to first
# order are 6 % too small, at half of it 20 %.
LEAST_SIGMAS = 5.0


def rpy(R: np.ndarray) -> np.ndarray:
    """(3,) roll, pitch, yaw [rad] of R (3, 3). They reproduce R at a pitch of +-90 deg, too, because the roll is
    computed from R after the yaw."""
    yaw = atan2(R[1, 0], R[0, 0])
    s, k = sin(yaw), cos(yaw)
    roll = atan2(s * R[0, 2] - k * R[1, 2], k * R[1, 1] - s * R[0, 1])
    return np.array([roll, atan2(-R[2, 0], hypot(R[0, 0], R[1, 0])), yaw])


def rpy_jacobian(R: np.ndarray) -> np.ndarray:
    """(3, 3) derivative of `rpy` by d for R Exp(d). It is the inverse of the relation between body rates and Euler
    rates (Diebel, Representing Attitude, 2006), and infinite at gimbal lock, a pitch of +-90 deg."""
    length = hypot(R[2, 1], R[2, 2])  # cos(pitch)
    s, k, tangent = np.array([R[2, 1], R[2, 2], -R[2, 0]]) / length
    return np.array([[1.0, tangent * s, tangent * k], [0.0, k, -s], [0.0, s / length, k / length]])


def rpy_std(R: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(3,) standard deviations of roll, pitch and yaw [rad], to first order. covariance (3, 3): of d in R Exp(d).

    NaN within `LEAST_SIGMAS` of gimbal lock, where roll and yaw are one and the first order is wrong. The x axis is at
    cos(pitch) from there, which only turns about y and z change. Zeros for a fixed rotation.
    """
    if not covariance.any():
        return np.zeros(3)
    largest = np.sqrt(np.linalg.eigvalsh(covariance[1:, 1:])[-1]) if np.isfinite(covariance).all() else np.inf
    if not hypot(R[2, 1], R[2, 2]) > LEAST_SIGMAS * largest:
        return np.full(3, np.nan)
    J = rpy_jacobian(R)
    return np.sqrt(np.einsum("ij,jk,ik->i", J, covariance, J))
