"""A LiDAR's lever arm, and what rates leave open of its rotation: linear in its positions.

Against a known motion of the IMU, with u the LiDAR's own way from instant i to j in its axes at i (hand and eye):

    (R_j - R_i) p_imu_lidar - R_i R_imu_lidar u = p_i - p_j                                     R, p: of the IMU

Against the IMU's readings alone, with A[x] = (x_2 - x_1) / h_2 - (x_1 - x_0) / h_1 over three scans, in which
velocities have dropped out (as of a camera in `lever_arm`, whose board is the LiDAR's map here):

    A[p_map_lidar] = A[R_map_imu] p_imu_lidar + A[D_f] - A[D_R] b_a + g (h_1 + h_2) / 2

Both are linear in a turn R_imu_lidar Exp(d), too. Where a LiDAR turned about one axis, d about it is left to these rows
alone; then the turn that fits them best among all is where to start.
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

LEVER_ARM_PRIOR_M = 0.5  # m: what the motion leaves open stays small
ACCEL_BIAS_PRIOR = 0.3  # m/s^2
UNKNOWN_SIGMA = 1e3
FIXED_SIGMA = 1e-6
DISPLACEMENT_SIGMA_M, VELOCITY_CHANGE_SIGMA_M_S = 0.1, 0.05  # m, m/s: of a row
SENSOR_RATE_SIGMA_RAD_S = 0.02  # rad/s, of a rate of the LiDAR
DISPLACEMENT_SPANS_S = (0.5, 2.0)  # of ways
MIN_TRIPLE_STEP_S = 0.1  # between the scans of a triple, at least
MIN_LEVER_ARM_ROWS = 10
SINGLE_AXIS_RATE_RATIO = (
    0.1  # of the spread of rates about the first axis: below, turns about the second are lost in noise
)
AXIS_TURN_CANDIDATES = 24  # turns about that axis
LEVER_ARM_ITERATIONS = 5
MIN_MIRRORED_SHARE = 1.4  # times what was seen is left: 2 without noise, and 1 or less where axes are right-handed


class LeverArmRows(NamedTuple):
    """A x = b with A (n, 3, m), b (n, 3); the first six of x are d and p_imu_lidar. seen (n, 3): what the LiDAR's path
    has part in b."""

    A: np.ndarray
    b: np.ndarray
    seen: np.ndarray


LeverArmSystem = Callable[
    [np.ndarray, np.ndarray], LeverArmRows
]  # of R_imu_lidar, and p_imu_lidar for the derivative by d


@dataclass(frozen=True)
class GaussianPrior:
    """Of x (m,): mean and sigma, in the units of a row's sigma; information (3, 3) of d from rates, likewise."""

    mean: np.ndarray
    sigma: np.ndarray
    information: np.ndarray


def lever_arm_prior(
    others: np.ndarray, rates: np.ndarray, row_sigma: float, rotation_held: bool, held: np.ndarray | None
):
    """Of a system with unknowns of sigma `others` (k,) beside d and p, and rates (n, 3) of the LiDAR; held (3,): the
    lever arm where it is known."""
    d = FIXED_SIGMA if rotation_held else UNKNOWN_SIGMA
    arm = LEVER_ARM_PRIOR_M if held is None else FIXED_SIGMA
    mean = np.concatenate([np.zeros(3), np.zeros(3) if held is None else held, np.zeros(len(others))])
    w = rates - rates.mean(axis=0)
    information = (w**2).sum() * np.eye(3) - w.T @ w
    return GaussianPrior(
        mean,
        np.concatenate([[d] * 3, [arm] * 3, others]) / row_sigma,
        information * (row_sigma / SENSOR_RATE_SIGMA_RAD_S) ** 2,
    )


def system_from_trajectory(
    R_imu: np.ndarray, p_imu: np.ndarray, seconds: np.ndarray, rotation: np.ndarray, position: np.ndarray
) -> LeverArmSystem:
    """Of a LiDAR at seconds (n,), R_map_lidar and p_map_lidar, while the IMU was at R_imu, p_imu in any world."""
    i, j = _displacement_pairs(seconds)
    u = np.einsum("nji,nj->ni", rotation[i], position[j] - position[i])
    hat_u = so3.hat_many(u)

    def rows(R_il: np.ndarray, p_il: np.ndarray) -> LeverArmRows:
        del p_il
        R = R_imu[i] @ R_il
        A = np.concatenate([R @ hat_u, R_imu[j] - R_imu[i]], axis=2)
        way = np.einsum("nij,nj->ni", R, u)
        return LeverArmRows(A, way - (p_imu[j] - p_imu[i]), way)

    return rows


def system_from_readings(
    imu: ImuData,
    carry: Callable[[np.ndarray], np.ndarray],
    seconds: np.ndarray,
    rotation: np.ndarray,
    position: np.ndarray,
) -> LeverArmSystem:
    """Of a LiDAR at seconds (n,) on the imu clock; carry: R_map_imu (N, 3, 3) at the IMU's stamps from that (n, 3, 3)
    at the scans. The unknowns after p are gravity in the map and the accelerometer's bias."""
    triples = _pose_triples(seconds, imu.gaps)
    n, second = len(triples.i), triples.second
    bend = second(position)

    def rows(R_il: np.ndarray, p_il: np.ndarray) -> LeverArmRows:
        at_scans = rotation @ R_il.T
        R = carry(at_scans)
        felt = np.einsum("nij,nj->ni", R, imu.accel)
        # R_map_lidar is what is known: with R_imu_lidar Exp(d) what is felt turns by -d in the LiDAR's axes.
        by_turn = so3.hat_many(felt) @ R @ R_il
        x = np.concatenate([felt, R.reshape(-1, 9), by_turn.reshape(-1, 9)], axis=1)
        D = SignalIntegrals.of(imu, x).at(seconds)[1]
        A = np.zeros((n, 3, 12))
        A[:, :, :3] = second(rotation @ so3.hat_many((R_il.T @ p_il)[None])[0] + D[:, 12:].reshape(-1, 3, 3))
        A[:, :, 3:6] = second(at_scans)
        A[:, :, 6:9] = triples.half[:, None, None] * np.eye(3)
        A[:, :, 9:] = -second(D[:, 3:12].reshape(-1, 3, 3))
        return LeverArmRows(A, bend - second(D[:, :3]), bend)

    return rows


def solve_lever_arm(
    rows: LeverArmSystem, prior: GaussianPrior, R_il: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """R_imu_lidar and x (m,) that fit the rows best, from a rotation that fits rates (n, 3) of the LiDAR; None where
    rows are too few."""
    start = prior.mean[3:6]
    if len(rows(R_il, start).b) < MIN_LEVER_ARM_ROWS:
        return None
    held = prior.sigma[0] < 1.0
    axis = only_axis(rates, SINGLE_AXIS_RATE_RATIO)
    if not held and axis is not None:
        angles = 2.0 * np.pi * np.arange(AXIS_TURN_CANDIDATES) / AXIS_TURN_CANDIDATES
        turns = so3.exp_many(angles[:, None] * axis)
        R_il = min((R_il @ turn for turn in turns), key=lambda R: _misfit_of_rotation(rows(R, start), prior))
    x = prior.mean
    for _ in range(LEVER_ARM_ITERATIONS):
        x = _robust_least_squares(rows(R_il, x[3:6]), prior, 0)[0]
        R_il = R_il @ so3.exp(x[:3].copy())
    return R_il, x


def unexplained_displacement(rows: LeverArmSystem, R_il: np.ndarray, x: np.ndarray) -> float:
    """How much of what the path has part in the solution x (m,) and `R_il` leave: the ratio of the medians."""
    A, b, seen = rows(R_il, x[3:6])
    left = b - A[:, :, 3:] @ x[3:]
    return float(np.median(np.linalg.norm(left, axis=1)) / max(np.median(np.linalg.norm(seen, axis=1)), 1e-30))


def is_mirrored(rows: LeverArmSystem, R_il: np.ndarray, x: np.ndarray) -> bool:
    """Whether the LiDAR moved the other way than the solution x (m,) and `R_il` say. Rates of mirrored axes are those
    of axes turned by half a turn, and fit; of ways twice their length is left then."""
    return unexplained_displacement(rows, R_il, x) > MIN_MIRRORED_SHARE


def _misfit_of_rotation(rows: LeverArmRows, prior: GaussianPrior) -> float:
    """RMS of what rows lack with d = 0."""
    return _robust_least_squares(rows, prior, 3)[1]


def _robust_least_squares(rows: LeverArmRows, prior: GaussianPrior, without: int) -> tuple[np.ndarray, float]:
    """Least squares for x without its first `without`, twice more without rows that stand far off; RMS of the rest."""
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
    """Instants (i, j) about SPANS_S apart."""
    i = np.tile(np.arange(len(t)), len(DISPLACEMENT_SPANS_S))
    span = np.repeat(DISPLACEMENT_SPANS_S, len(t))
    j = np.searchsorted(t, t[i] + span - 1e-3)
    good = (j < len(t)) & (t[np.minimum(j, len(t) - 1)] - t[i] < 2.0 * span)
    return i[good], j[good]


def _pose_triples(t: np.ndarray, gaps: tuple[tuple[float, float], ...]) -> Triples:
    """Scans (i, j, k) about STEP_S apart, or next to each other, and no part of them in a gap of the IMU."""
    i = np.arange(len(t))
    step = max(MIN_TRIPLE_STEP_S, float(np.median(np.diff(t))))
    j = np.searchsorted(t, t + 0.99 * step - 1e-3)
    k = np.searchsorted(t, t + 1.98 * step - 1e-3)
    good = (k < len(t)) & (j < k) & (i < j)
    i, j, k = i[good], j[good], k[good]
    close = (t[j] - t[i] < 2.0 * step) & (t[k] - t[j] < 2.0 * step)
    close &= clear_of(gaps, t[i], t[k])
    return Triples.at(t, i[close], j[close], k[close])
