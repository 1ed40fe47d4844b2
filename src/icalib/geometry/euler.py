"""Roll, pitch and yaw of a rotation matrix R = Rz(yaw) Ry(pitch) Rx(roll), as in URDF, with standard deviations."""

from __future__ import annotations

from math import atan2, cos, hypot, sin

import numpy as np

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
