"""Attitude, biases, lever arm and time offset from second differences of fixes, by Gauss-Newton over a window."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.geometry import so3
from icalib.initialize.steps.lever_arm import Triples
from icalib.motion.imu_data import ImuData
from icalib.sensors.position.initialize.triples import MARGIN_S, Carried

ROUNDS = 12
CONVERGED = 1e-5  # rad, rad/s, m/s^2, m, s: a change below which nothing that the estimator starts from matters
OUTLIER = 4.0  # median sizes of residuals, beyond which a triple counts no more
OFFSET_STEP_S = 0.005  # of the difference quotient by the time offset
FEWEST = 12  # triples in a window
# Standard deviations of what is assumed before the window is looked at.
GYRO_BIAS_SIGMA = 0.02  # rad/s, of consumer gyroscopes
ACCEL_BIAS_SIGMA = 0.3  # m/s^2
ARM_SIGMA = 2.0  # m, of a car's antenna
OFFSET_SIGMA = 0.3  # s, about a peak of the correlation
ROTATION_SIGMA = 10.0  # rad: nothing
ROW_SIGMA = 0.05  # m/s, least of a row: fixes of 2 cm


@dataclass(frozen=True)
class Fix:
    """Fixes of one recording: t (N,) s on the sensor's clock, position (N, 3) m in its frame."""

    t: np.ndarray
    position: np.ndarray


@dataclass(frozen=True)
class Unknowns:
    """R_wg (3, 3): the IMU at `reference` s on its clock, in the frame of the fixes; gyro_bias (3,) rad/s, accel_bias
    (3,) m/s^2, arm (3,) m, offset s from the sensor's clock to the IMU's."""

    reference: float
    R_wg: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    arm: np.ndarray
    offset: float

    def moved(self, step: np.ndarray) -> Unknowns:
        """By a step (13,) in the order of the fields; rotations in the axes of the world."""
        return replace(
            self,
            R_wg=so3.exp(step[:3]) @ self.R_wg,
            gyro_bias=self.gyro_bias + step[3:6],
            accel_bias=self.accel_bias + step[6:9],
            arm=self.arm + step[9:12],
            offset=self.offset + float(step[12]),
        )

    def minus(self, other: Unknowns) -> np.ndarray:
        """(13,) the step that leads from `other` here."""
        return np.concatenate(
            [
                so3.log(self.R_wg @ other.R_wg.T),
                self.gyro_bias - other.gyro_bias,
                self.accel_bias - other.accel_bias,
                self.arm - other.arm,
                [self.offset - other.offset],
            ]
        )


@dataclass(frozen=True)
class Fitted:
    """left: RMS of what the readings leave of the second differences of the fixes, over that of these; covariance (13,
    13) as the residuals show it."""

    at: Unknowns
    left: float
    covariance: np.ndarray


def sigmas(arm: float = ARM_SIGMA, offset: float = OFFSET_SIGMA) -> np.ndarray:
    """(13,) of a prior where nothing is known but the usual."""
    groups = (ROTATION_SIGMA, GYRO_BIAS_SIGMA, ACCEL_BIAS_SIGMA, arm)
    return np.append(np.repeat(groups, 3), offset)


def first_attitude(imu: ImuData, fix: Fix, own: Triples, reference: float, offset: float, gravity: float) -> np.ndarray:
    """R_wg by Kabsch from specific forces: the second differences of the fixes with gravity, and the readings'."""
    t = fix.t + offset
    carried = Carried.of(imu, span_of(t, own), reference, np.zeros(3), alone=True)
    seen = own.second(fix.position)
    seen[:, 2] += gravity * own.half
    felt = own.second(carried.doubles_at(t)[:, :3])
    return so3.closest_rotation(seen.T @ felt)


def fit(
    imu: ImuData, fix: Fix, own: Triples, start: Unknowns, prior: Unknowns, sigma: np.ndarray, gravity: float
) -> Fitted:
    """Gauss-Newton over the triples `own` from `start`, with a prior of standard deviations `sigma` (13,)."""
    x, row_sigma, information = start, ROW_SIGMA, np.eye(13)
    r, kept = np.zeros((0, 3)), np.zeros(0, dtype=bool)
    for _ in range(ROUNDS):
        r, J = _rows(imu, fix, own, x, gravity)
        size = np.linalg.norm(r, axis=1)
        kept = size <= OUTLIER * np.median(size)
        row_sigma = max(ROW_SIGMA, float(np.median(size)))
        A, b = J[kept].reshape(-1, 13) / row_sigma, r[kept].ravel() / row_sigma
        information = A.T @ A + np.diag(sigma**-2)
        step = np.linalg.solve(information, A.T @ b - x.minus(prior) / sigma**2)
        x = x.moved(step)
        if np.abs(step).max() < CONVERGED:
            break
    seen = own.second(fix.position)[kept]
    left = np.sqrt((r[kept] ** 2).sum() / max(float((seen**2).sum()), 1e-9))
    return Fitted(x, float(left), np.linalg.inv(information))


def _rows(imu: ImuData, fix: Fix, own: Triples, x: Unknowns, gravity: float) -> tuple[np.ndarray, np.ndarray]:
    """What is left of A[p_fix] (n, 3) m/s, and the derivatives (n, 3, 13) of what was predicted."""
    t = fix.t + x.offset
    carried = Carried.of(imu, span_of(t, own), x.reference, x.gyro_bias)
    predicted, J = _predicted(carried, t, own, x), np.zeros((len(own.i), 3, 13))
    R, doubles, turned = carried.rotation_at(t), carried.doubles_at(t), carried.turned_at(t)
    J[:, :, 0:3] = -so3.hat_many(np.ascontiguousarray(predicted))
    arm = so3.hat_many(np.ascontiguousarray(R @ x.arm)) @ turned
    J[:, :, 3:6] = x.R_wg @ (own.second(doubles[:, 12:]).reshape(-1, 3, 3) + own.second(arm))
    J[:, :, 6:9] = -x.R_wg @ own.second(doubles[:, 3:12]).reshape(-1, 3, 3)
    J[:, :, 9:12] = x.R_wg @ own.second(R)
    later, earlier = (_predicted(carried, t + d, own, x) for d in (OFFSET_STEP_S, -OFFSET_STEP_S))
    J[:, :, 12] = (later - earlier) / (2.0 * OFFSET_STEP_S)
    r = own.second(fix.position) - predicted
    r[:, 2] += gravity * own.half
    return r, J


def _predicted(carried: Carried, t: np.ndarray, own: Triples, x: Unknowns) -> np.ndarray:
    """(n, 3) A[p_fix] without gravity."""
    doubles = carried.doubles_at(t)
    felt = own.second(doubles[:, :3] - doubles[:, 3:12].reshape(-1, 3, 3) @ x.accel_bias)
    return (felt + own.second(carried.rotation_at(t) @ x.arm)) @ x.R_wg.T


def span_of(t: np.ndarray, own: Triples) -> tuple[float, float]:
    return float(t[own.i].min()) - MARGIN_S, float(t[own.k].max()) + MARGIN_S
