"""Rotation of a camera, gyroscope bias and the fine time offset from angular rates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialization.rates import CameraRates, GyroMeans

_STEPS = 15
_STEP_TOLERANCE = 1e-8  # rad, rad/s, s
_SINGLE_AXIS = 0.02  # of the largest singular value: where the second is below, all turns were about one axis
_AT_REST = 0.03  # rad/s RMS
_DEGREES = 180.0 / np.pi
_SCALE_TOLERANCE = 0.2
_MIN_RATES = 10


@dataclass(frozen=True)
class RateFit:
    """w_imu(t + offset) = R_imu_cam w_cam(t) + bias from `count` rates.

    axis (3,): where all turns were about one axis, this axis in the imu frame; the rotation about it is arbitrary.
    """

    R_imu_cam: np.ndarray
    gyro_bias: np.ndarray
    offset: float
    count: int
    axis: np.ndarray | None


def paired(rates: CameraRates, gyro: GyroMeans, offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Camera rates (n, 3), the gyroscope's (n, 3) over the same intervals, and which (N,) of the rates have both."""
    t0, t1 = rates.t0 + offset, rates.t1 + offset
    both = gyro.covered(t0, t1)
    return rates.rate[both], gyro.mean(t0[both], t1[both]), both


def vector_correlation(rates: CameraRates, gyro: GyroMeans, offset: float) -> float:
    """Correlation of the two rates as vectors under the best rotation between them, means removed; 1 at best."""
    camera, imu, _ = paired(rates, gyro, offset)
    if len(camera) < _MIN_RATES:
        return 0.0
    camera, imu = camera - camera.mean(axis=0), imu - imu.mean(axis=0)
    R, _ = _kabsch(camera, imu)
    return float(np.sum((camera @ R.T) * imu) / (np.linalg.norm(camera) * np.linalg.norm(imu) + 1e-300))


def check_motion(rates: CameraRates, gyro: GyroMeans, camera_name: str, imu_name: str) -> None:
    """Raises EstimationError where the camera gives too few rates, or where nothing turns."""
    if len(rates.rate) < _MIN_RATES:
        raise EstimationError(
            f"{camera_name} sees the target in hardly any two images in a row ({len(rates.rate)} usable pairs, "
            f"{_MIN_RATES} needed); record longer with the target in view, and check target and intrinsics in the rig."
        )
    edges = np.arange(0.0, gyro.duration, 0.05)
    imu = _spread(gyro.mean(edges[:-1], edges[1:]))
    if imu < _AT_REST:
        raise EstimationError(
            f"the recording is motionless: {imu_name} turns by {imu:.3f} rad/s RMS and {camera_name} by "
            f"{_spread(rates.rate):.3f} rad/s RMS; wave the sensors in front of the target, turning about all axes."
        )


def check_scale(rates: CameraRates, gyro: GyroMeans, offset: float, camera_name: str, imu_name: str) -> None:
    """Raises EstimationError where the gyroscope turns faster or slower than the camera: wrong unit or wrong sensor."""
    camera, imu, _ = paired(rates, gyro, offset)
    ratio = _spread(imu) / _spread(camera)
    if abs(ratio / _DEGREES - 1.0) < _SCALE_TOLERANCE:
        raise EstimationError(
            f"the gyroscope of {imu_name} looks like degrees per second (it turns {ratio:.1f} times as fast as "
            f"{camera_name}); convert it to rad/s."
        )
    if abs(ratio - 1.0) > _SCALE_TOLERANCE:
        raise EstimationError(
            f"the gyroscope of {imu_name} turns {ratio:.3g} times as fast as {camera_name}; the size of the target does "
            f"not matter here: check the gyroscope's unit (rad/s), the intrinsics of {camera_name}, and that both belong "
            "to the same rig."
        )


def fit_rates(
    rates: CameraRates, gyro: GyroMeans, offset: float, R_imu_cam: np.ndarray | None, refine_offset: bool
) -> RateFit:
    """Least squares over rotation, bias and offset, robust (Cauchy); the rotation is held where it is given."""
    camera, imu, _ = paired(rates, gyro, offset)
    R, singular = _kabsch(camera - camera.mean(axis=0), imu - imu.mean(axis=0))
    lone = R_imu_cam is None and singular[1] < _SINGLE_AXIS * singular[0]
    R = R if R_imu_cam is None else R_imu_cam
    bias = (imu - camera @ R.T).mean(axis=0)
    estimated = np.repeat([R_imu_cam is None, True, refine_offset], [3, 3, 1])
    for _ in range(_STEPS):
        step = np.zeros(7)
        step[estimated] = _gauss_newton_step(rates, gyro, offset, R, bias, estimated)
        R, bias, offset = R @ so3.exp(step[:3]), bias + step[3:6], offset + step[6]
        if np.abs(step).max() < _STEP_TOLERANCE:
            break
    return RateFit(R, bias, float(offset), len(camera), R @ _main_axis(camera) if lone else None)


def _gauss_newton_step(
    rates: CameraRates, gyro: GyroMeans, offset: float, R: np.ndarray, bias: np.ndarray, estimated: np.ndarray
) -> np.ndarray:
    camera, imu, both = paired(rates, gyro, offset)
    t0, t1 = rates.t0[both] + offset, rates.t1[both] + offset
    residual = camera @ R.T + bias - imu
    J = np.zeros((len(camera), 3, 7))
    J[:, :, :3] = np.cross(camera[:, None, :], R[None])  # rows of -R [w]x
    J[:, :, 3:6] = np.eye(3)
    J[:, :, 6] = -gyro.mean_slope(t0, t1)
    J = J[:, :, estimated]
    square = np.einsum("ni,ni->n", residual, residual)
    weight = 1.0 / (1.0 + square / (4.0 * np.median(square) + 1e-20))
    A = np.einsum("nip,n,niq->pq", J, weight, J, optimize=True)
    # Relative to its trace the damping only holds what the data leave open (a turn about the only axis).
    A += 1e-9 * np.trace(A) * np.eye(len(A))
    return -np.linalg.solve(A, np.einsum("nip,n,ni->p", J, weight, residual, optimize=True))


def _kabsch(camera: np.ndarray, imu: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R (3, 3) that minimises |imu - R camera|, and the singular values (Kabsch 1976)."""
    U, singular, Vt = np.linalg.svd(imu.T @ camera)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt, singular


def _main_axis(rate: np.ndarray) -> np.ndarray:
    return np.linalg.svd(rate - rate.mean(axis=0), full_matrices=False)[2][0]


def _spread(rate: np.ndarray) -> float:
    """RMS of the rate about its mean, rad/s."""
    return float(np.sqrt(np.sum(np.var(rate, axis=0))))
