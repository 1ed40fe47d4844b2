"""Attitude, biases, lever arm and time offset from second differences of fixes, by Gauss-Newton over a window."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from icalib.geometry import so3
from icalib.initialize.steps.lever_arm import Triples
from icalib.motion.imu_data import ImuData
from icalib.sensors.position.initialize.triples import WINDOW_MARGIN_S, IntegratedReadings, triples_of
from icalib.sensors.position.read.outliers import steps

MAX_WINDOW_ROUNDS = 12
# rad, rad/s, m/s^2, m, s: of a Gauss-Newton step. Smaller changes of a start value do not change the estimate.
WINDOW_STEP_TOLERANCE = 1e-5
MAX_TRIPLE_MEDIANS = 4.0  # times the median residual; a triple with a larger one has no weight
OFFSET_DIFFERENCE_S = 0.005  # half a step of central differences by the time offset: one IMU reading at 200 Hz
MIN_WINDOW_TRIPLES = 12  # 36 rows for 13 unknowns
# Prior standard deviations of the unknowns of a window.
GYRO_BIAS_SIGMA_RAD_S = 0.02  # rad/s, of consumer gyroscopes
ACCEL_BIAS_SIGMA_M_S2 = 0.3  # m/s^2
ARM_SIGMA_M = 2.0  # m, of a car's antenna
OFFSET_SIGMA_S = 0.3  # s, about a peak of the correlation
ROTATION_SIGMA_RAD = 10.0  # rad: no prior
MIN_TRIPLE_SIGMA_M_S = 0.05  # m/s, of a second difference of fixes with 2 cm of noise, 1 s apart


@dataclass(frozen=True)
class Fix:
    """Fixes of one recording: t (N,) s on the sensor's clock, position (N, 3) m in its frame."""

    t: np.ndarray
    position: np.ndarray

    @cached_property
    def run(self) -> np.ndarray:
        """(N,) int: number of the run of each fix. A run ends where the solution steps, so that differences within a
        run contain no step."""
        at, _ = steps(self.t, self.position)
        return np.cumsum(np.bincount(at, minlength=len(self.t)))

    @property
    def triples(self) -> Triples:
        """Triples of fixes about a second apart, without a step of the solution between them."""
        triples = triples_of(self.t)
        return triples.some(self.run[triples.i] == self.run[triples.k])


@dataclass(frozen=True)
class WindowUnknowns:
    """Unknowns of a window of time. R_wg (3, 3): attitude of the IMU at `reference` s on its clock, in the frame of the
    fixes; gyro_bias (3,) rad/s; accel_bias (3,) m/s^2; arm (3,): lever arm p_imu_sensor [m]; offset: t_imu - t_sensor
    [s]."""

    reference: float
    R_wg: np.ndarray
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    arm: np.ndarray
    offset: float

    def moved(self, step: np.ndarray) -> WindowUnknowns:
        """The unknowns after a step (13,) in the order of the fields; the rotation is in world axes, on the left."""
        return replace(
            self,
            R_wg=so3.exp(step[:3]) @ self.R_wg,
            gyro_bias=self.gyro_bias + step[3:6],
            accel_bias=self.accel_bias + step[6:9],
            arm=self.arm + step[9:12],
            offset=self.offset + float(step[12]),
        )

    def minus(self, other: WindowUnknowns) -> np.ndarray:
        """(13,) the step from `other` to these unknowns: other.moved(step) is equal to them."""
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
class WindowPrior:
    """Gaussian prior of `WindowUnknowns`: mean, and standard deviations sigma (13,) of a step from it."""

    mean: WindowUnknowns
    sigma: np.ndarray


@dataclass(frozen=True)
class WindowFit:
    """Result of `fit_window`. misfit: RMS of the residuals over the RMS of the second differences of the fixes;
    covariance (13, 13) of the unknowns, scaled by the residuals."""

    at: WindowUnknowns
    misfit: float
    covariance: np.ndarray


def sigmas(arm: float = ARM_SIGMA_M, offset: float = OFFSET_SIGMA_S) -> np.ndarray:
    """(13,) prior standard deviations of `WindowUnknowns` for a usual IMU and antenna."""
    groups = (ROTATION_SIGMA_RAD, GYRO_BIAS_SIGMA_RAD_S, ACCEL_BIAS_SIGMA_M_S2, arm)
    return np.append(np.repeat(groups, 3), offset)


def first_attitude(
    imu: ImuData, fix: Fix, triples: Triples, reference: float, offset: float, gravity: float
) -> np.ndarray:
    """R_wg (3, 3) by Kabsch: rotates the double integrals of specific force onto the second differences of the fixes
    plus gravity."""
    t = fix.t + offset
    integrated = IntegratedReadings.of(imu, span_of(t, triples), reference, np.zeros(3), forces_only=True)
    differences = triples.second(fix.position)
    differences[:, 2] += gravity * triples.half
    felt = triples.second(integrated.doubles_at(t)[:, :3])
    return so3.closest_rotation(differences.T @ felt)


def fit_window(
    imu: ImuData,
    fix: Fix,
    triples: Triples,
    start: WindowUnknowns,
    prior: WindowPrior,
    gravity: float,
) -> WindowFit:
    """Robust Gauss-Newton on the second differences over `triples` (see module `triples`) from `start`. gravity
    [m/s^2]."""
    x, row_sigma, information = start, MIN_TRIPLE_SIGMA_M_S, np.eye(13)
    r, kept = np.zeros((0, 3)), np.zeros(0, dtype=bool)
    for _ in range(MAX_WINDOW_ROUNDS):
        r, J = _rows(imu, fix, triples, x, gravity)
        size = np.linalg.norm(r, axis=1)
        kept = size <= MAX_TRIPLE_MEDIANS * np.median(size)
        row_sigma = max(MIN_TRIPLE_SIGMA_M_S, float(np.median(size)))
        A, b = J[kept].reshape(-1, 13) / row_sigma, r[kept].ravel() / row_sigma
        information = A.T @ A + np.diag(prior.sigma**-2)
        step = np.linalg.solve(information, A.T @ b - x.minus(prior.mean) / prior.sigma**2)
        x = x.moved(step)
        if np.abs(step).max() < WINDOW_STEP_TOLERANCE:
            break
    differences = triples.second(fix.position)[kept]
    misfit = np.sqrt((r[kept] ** 2).sum() / max(float((differences**2).sum()), 1e-9))
    return WindowFit(x, float(misfit), np.linalg.inv(information))


def _rows(imu: ImuData, fix: Fix, triples: Triples, x: WindowUnknowns, gravity: float) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of A[p_fix] (n, 3) m/s, and derivatives (n, 3, 13) of the prediction by `WindowUnknowns`."""
    t = fix.t + x.offset
    integrated = IntegratedReadings.of(imu, span_of(t, triples), x.reference, x.gyro_bias)
    predicted, J = _predicted(integrated, t, triples, x), np.zeros((len(triples.i), 3, 13))
    R, doubles = integrated.rotation_at(t), integrated.doubles_at(t)
    J[:, :, 0:3] = -so3.hat_many(np.ascontiguousarray(predicted))
    J_arm_bias = so3.hat_many(np.ascontiguousarray(R @ x.arm)) @ integrated.rotation_integral_at(t)
    J[:, :, 3:6] = x.R_wg @ (triples.second(doubles[:, 12:]).reshape(-1, 3, 3) + triples.second(J_arm_bias))
    J[:, :, 6:9] = -x.R_wg @ triples.second(doubles[:, 3:12]).reshape(-1, 3, 3)
    J[:, :, 9:12] = x.R_wg @ triples.second(R)
    later, earlier = (_predicted(integrated, t + d, triples, x) for d in (OFFSET_DIFFERENCE_S, -OFFSET_DIFFERENCE_S))
    J[:, :, 12] = (later - earlier) / (2.0 * OFFSET_DIFFERENCE_S)
    r = triples.second(fix.position) - predicted
    r[:, 2] += gravity * triples.half
    return r, J


def _predicted(integrated: IntegratedReadings, t: np.ndarray, triples: Triples, x: WindowUnknowns) -> np.ndarray:
    """(n, 3) m/s, the prediction of A[p_fix] without its gravity term."""
    doubles = integrated.doubles_at(t)
    felt = triples.second(doubles[:, :3] - doubles[:, 3:12].reshape(-1, 3, 3) @ x.accel_bias)
    return (felt + triples.second(integrated.rotation_at(t) @ x.arm)) @ x.R_wg.T


def span_of(t: np.ndarray, triples: Triples) -> tuple[float, float]:
    """First and last instant [s] of the readings that `triples` of fixes at t (N,) s on the IMU's clock need."""
    return float(t[triples.i].min()) - WINDOW_MARGIN_S, float(t[triples.k].max()) + WINDOW_MARGIN_S
