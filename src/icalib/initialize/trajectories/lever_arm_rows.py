"""Lever arm of a sensor with its own trajectory, and the part of its rotation that angular rates do not determine.

`map` is the world frame of the sensor's trajectory. If the IMU's trajectory (R, p) is known, with the sensor's
displacement u from instant i to j in sensor axes at i (hand-eye equation):

    (R_j - R_i) p_imu_sensor - R_i R_imu_sensor u = p_i - p_j

With the IMU's readings alone, and A[x] = (x_2 - x_1) / h_2 - (x_1 - x_0) / h_1 over three poses, which removes
velocities (symbols as in `lever_arm`, with `map` in place of the board frame):

    A[p_map_sensor] = A[R_map_imu] p_imu_sensor + A[D_f] - A[D_R] b_a + g (h_1 + h_2) / 2

Both are also linear in a small rotation d of R_imu_sensor Exp(d). If the sensor turned about one axis, rates do not
show d about this axis. The solution then starts from the candidate rotation about the axis that fits these equations
best.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.geometry import so3
from icalib.initialize.steps.lever_arm import Triples
from icalib.initialize.steps.rate_alignment import only_axis
from icalib.initialize.trajectories.imu_trajectory import SignalIntegrals
from icalib.motion.imu_data import ImuData, clear_of

LEVER_ARM_PRIOR_M = 0.5  # m: prior standard deviation; keeps unobservable components small
ACCEL_BIAS_PRIOR = 0.3  # m/s^2: prior standard deviation
UNKNOWN_SIGMA = 1e3  # prior standard deviation of unknowns without a prior, in their units
FIXED_SIGMA = 1e-6  # prior standard deviation of known values, in their units
DISPLACEMENT_SIGMA_M = 0.1  # m: standard deviation of a row of displacements
VELOCITY_CHANGE_SIGMA_M_S = 0.05  # m/s: standard deviation of a row of readings
SENSOR_RATE_SIGMA_RAD_S = 0.02  # rad/s: standard deviation of a rate of the sensor
DISPLACEMENT_SPANS_S = (0.5, 2.0)  # s between the two poses of a displacement
MIN_TRIPLE_STEP_S = 0.1  # s between the poses of a triple
MIN_LEVER_ARM_ROWS = 10  # equations of three components each
# Spread of rates along the second principal axis over that along the first: below, the second is noise
SINGLE_AXIS_RATE_RATIO = 0.1
AXIS_TURN_CANDIDATES = 24  # start rotations about a single axis, 15 degrees apart
LEVER_ARM_ITERATIONS = 5  # of Gauss-Newton on the rotation
# unexplained share above which axes are left-handed: it is 2 there without noise, at most 1 in right-handed axes
MIN_MIRRORED_SHARE = 1.4


class LeverArmRows(NamedTuple):
    """Linear system A x = b: A (n, 3, m), b (n, 3). The first six of x are d [rad] and p_imu_sensor [m]. motion (n, 3):
    the part of b that the sensor's trajectory contributes."""

    A: np.ndarray
    b: np.ndarray
    motion: np.ndarray


# Maps R_imu_sensor and p_imu_sensor to the rows linearised there
LeverArmSystem = Callable[[np.ndarray, np.ndarray], LeverArmRows]


@dataclass(frozen=True)
class GaussianPrior:
    """Prior of x (m,). mean: in the units of x; sigma: standard deviation over that of a row; information (3, 3): of d
    by angular rates, times the variance of a row."""

    mean: np.ndarray
    sigma: np.ndarray
    information: np.ndarray


def lever_arm_prior(
    sigmas: np.ndarray, rates: np.ndarray, row_sigma: float, rotation_known: bool, arm: np.ndarray | None
) -> GaussianPrior:
    """The prior of a system with unknowns of standard deviation `sigmas` (k,) after d and p. rates (n, 3) rad/s: of the
    sensor; row_sigma: of a row; rotation_known: whether d is fixed at zero; arm (3,) m: the lever arm if it is known.
    """
    d = FIXED_SIGMA if rotation_known else UNKNOWN_SIGMA
    arm_sigma = LEVER_ARM_PRIOR_M if arm is None else FIXED_SIGMA
    mean = np.concatenate([np.zeros(3), np.zeros(3) if arm is None else arm, np.zeros(len(sigmas))])
    w = rates - rates.mean(axis=0)
    information = (w**2).sum() * np.eye(3) - w.T @ w
    return GaussianPrior(
        mean,
        np.concatenate([[d] * 3, [arm_sigma] * 3, sigmas]) / row_sigma,
        information * (row_sigma / SENSOR_RATE_SIGMA_RAD_S) ** 2,
    )


def system_from_trajectory(
    R_imu: np.ndarray, p_imu: np.ndarray, seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray
) -> LeverArmSystem:
    """The system of a sensor with poses R_map_sensor, p_map_sensor at seconds (n,), at which the IMU has the poses
    R_imu (n, 3, 3), p_imu (n, 3) in any world."""
    i, j = _displacement_pairs(seconds)
    u = np.einsum("nji,nj->ni", rotation[i], position[j] - position[i])
    hat_u = so3.hat_many(u)

    def rows(R_is: np.ndarray, p_is: np.ndarray) -> LeverArmRows:
        """First (hand-eye) equation of the module, linearised at R_is; it is linear in p_imu_sensor."""
        del p_is
        R = R_imu[i] @ R_is
        A = np.concatenate([R @ hat_u, R_imu[j] - R_imu[i]], axis=2)
        displacement = np.einsum("nij,nj->ni", R, u)
        return LeverArmRows(A, displacement - (p_imu[j] - p_imu[i]), displacement)

    return rows


def system_from_readings(
    imu: ImuData,
    carry: Callable[[np.ndarray], np.ndarray],
    seconds: np.ndarray,
    rotation: np.ndarray,
    position: np.ndarray,
) -> LeverArmSystem:
    """The system of a sensor with poses R_map_sensor, p_map_sensor at seconds (n,) on the IMU's clock. carry: maps
    R_map_imu (n, 3, 3) at the poses to those at the IMU's stamps (N, 3, 3). The unknowns after p are gravity [m/s^2] in
    the map and the accelerometer's bias [m/s^2]."""
    triples = _pose_triples(seconds, imu.gaps)
    n, second = len(triples.i), triples.second
    velocity_changes = second(position)

    def rows(R_is: np.ndarray, p_is: np.ndarray) -> LeverArmRows:
        """Second equation of the module, A[p_map_sensor] = ..., linearised at R_is, p_is. Columns: d, p_imu_sensor,
        gravity, accelerometer bias."""
        R_at_poses = rotation @ R_is.T
        R = carry(R_at_poses)
        force = np.einsum("nij,nj->ni", R, imu.accel)
        # R_map_sensor is measured, so R_imu_sensor Exp(d) rotates the force by -d in the sensor's axes.
        J_force_d = so3.hat_many(force) @ R @ R_is
        x = np.concatenate([force, R.reshape(-1, 9), J_force_d.reshape(-1, 9)], axis=1)
        D = SignalIntegrals.of(imu, x).at(seconds)[1]  # double integrals: of force, of R_map_imu, of J_force_d
        A = np.zeros((n, 3, 12))
        A[:, :, :3] = second(rotation @ so3.hat_many((R_is.T @ p_is)[None])[0] + D[:, 12:].reshape(-1, 3, 3))
        A[:, :, 3:6] = second(R_at_poses)
        A[:, :, 6:9] = triples.half[:, None, None] * np.eye(3)
        A[:, :, 9:] = -second(D[:, 3:12].reshape(-1, 3, 3))
        return LeverArmRows(A, velocity_changes - second(D[:, :3]), velocity_changes)

    return rows


def solve_lever_arm(
    rows: LeverArmSystem, prior: GaussianPrior, R_is: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """R_imu_sensor and x (m,) that fit the system best, starting at the rotation R_is that fits the sensor's rates
    (n, 3). None if the system has too few rows."""
    start = prior.mean[3:6]
    if len(rows(R_is, start).b) < MIN_LEVER_ARM_ROWS:
        return None
    rotation_known = prior.sigma[0] < 1.0
    axis = only_axis(rates, SINGLE_AXIS_RATE_RATIO)
    if not rotation_known and axis is not None:
        angles = 2.0 * np.pi * np.arange(AXIS_TURN_CANDIDATES) / AXIS_TURN_CANDIDATES
        turns = so3.exp_many(angles[:, None] * axis)
        R_is = min((R_is @ turn for turn in turns), key=lambda R: _misfit_of_rotation(rows(R, start), prior))
    x = prior.mean
    for _ in range(LEVER_ARM_ITERATIONS):
        x = _robust_least_squares(rows(R_is, x[3:6]), prior, 0)[0]
        R_is = R_is @ so3.exp(x[:3].copy())
    return R_is, x


def unexplained_displacement(rows: LeverArmSystem, R_is: np.ndarray, x: np.ndarray) -> float:
    """Median residual of the solution R_is, x (m,) over the median motion of the IMU in the equations. The motion of
    the sensor is no measure: inverted poses of a robot that turns in place move far, and any lever arm explains it."""
    residual, _, of_imu = _median_sizes(rows, R_is, x)
    return residual / of_imu


def is_mirrored(rows: LeverArmSystem, R_is: np.ndarray, x: np.ndarray) -> bool:
    """Whether the sensor moved opposite to the solution R_is, x (m,). Rates in left-handed axes equal those in axes
    rotated by 180 deg, so such rates fit. Displacements then have the wrong sign, and the residual is about twice as
    large as the displacements, by IMU and by sensor."""
    residual, of_sensor, of_imu = _median_sizes(rows, R_is, x)
    return residual > MIN_MIRRORED_SHARE * max(of_sensor, of_imu)


def _median_sizes(rows: LeverArmSystem, R_is: np.ndarray, x: np.ndarray) -> tuple[float, float, float]:
    """Median sizes of the residuals of R_is, x (m,), and of the motion of sensor and IMU in the equations [m]."""
    A, b, motion = rows(R_is, x[3:6])
    inertial = motion - b + A[:, :, 6:] @ x[6:]  # without gravity and bias
    vectors = (b - A[:, :, 3:] @ x[3:], motion, inertial)
    residual, of_sensor, of_imu = (float(np.median(np.linalg.norm(v, axis=1))) for v in vectors)
    return residual, of_sensor, max(of_imu, 1e-30)


def _misfit_of_rotation(rows: LeverArmRows, prior: GaussianPrior) -> float:
    """RMS residual of the best fit with d = 0."""
    return _robust_least_squares(rows, prior, 3)[1]


def _robust_least_squares(rows: LeverArmRows, prior: GaussianPrior, without: int) -> tuple[np.ndarray, float]:
    """Least squares for x, without its first `without` components, with the prior. Repeated twice without outliers.
    Returns x (m,) and the RMS residual of the inliers."""
    A, free = rows.A[:, :, without:], slice(without, None)
    N0, mean = np.diag(prior.sigma[free] ** -2), prior.mean[free]
    weight, x, size = np.ones(len(A)), mean, np.zeros(len(A))
    r0 = N0 @ mean
    if not without:
        N0[:3, :3] += prior.information
    for _ in range(3):
        wA = A * weight[:, None, None]
        x = np.linalg.solve(N0 + np.einsum("nia,nib->ab", wA, A), r0 + np.einsum("nia,ni->a", wA, rows.b))
        size = np.linalg.norm(rows.b - A @ x, axis=1)
        weight = (size < 4.0 * np.median(size) + 1e-9).astype(float)
    return np.concatenate([np.zeros(without), x]), float(np.sqrt(np.mean(size[weight > 0.0] ** 2)))


def _displacement_pairs(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of instants (i, j) about DISPLACEMENT_SPANS_S apart."""
    i = np.tile(np.arange(len(t)), len(DISPLACEMENT_SPANS_S))
    span = np.repeat(DISPLACEMENT_SPANS_S, len(t))
    j = np.searchsorted(t, t[i] + span - 1e-3)
    good = (j < len(t)) & (t[np.minimum(j, len(t) - 1)] - t[i] < 2.0 * span)
    return i[good], j[good]


def _pose_triples(t: np.ndarray, gaps: tuple[tuple[float, float], ...]) -> Triples:
    """Triples of poses about MIN_TRIPLE_STEP_S apart, or of neighbours if these are further apart. None spans a gap of
    the IMU."""
    i = np.arange(len(t))
    step = max(MIN_TRIPLE_STEP_S, float(np.median(np.diff(t))))
    j = np.searchsorted(t, t + 0.99 * step - 1e-3)
    k = np.searchsorted(t, t + 1.98 * step - 1e-3)
    good = (k < len(t)) & (j < k) & (i < j)
    i, j, k = i[good], j[good], k[good]
    close = (t[j] - t[i] < 2.0 * step) & (t[k] - t[j] < 2.0 * step)
    close &= clear_of(gaps, t[i], t[k])
    return Triples.at(t, i[close], j[close], k[close])
