"""Gravity, lever arms and accelerometer bias, linear in the cameras' positions and the IMU's integrals.

Over three images i < j < k the velocity cancels in the change of mean velocity,

    (p_k - p_j) / (t_k - t_j) - (p_j - p_i) / (t_j - t_i) = g h + R_board_start (N_a - N_Q b_a),   h = (t_k - t_i) / 2,

p the IMU's position on the board, N the same change of the second integrals of [Q a | Q], and R_board_start taken from
the image j. With p = p_board_cam - R_board_imu p_imu_cam it is linear in gravity g (board frame), lever arm and bias.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.initialization.dead_reckoning import DeadReckoning
from icalib.initialization.guess import BoardPoses

_SPACING_S = 0.15  # between the images of a triple: shorter and position noise wins, longer and integration drifts
_LONGEST_S = 0.6  # for slow cameras
_BIAS_SIGMA = 0.2  # m/s^2, what an accelerometer's bias may be; it trades with gravity where the IMU hardly turns
_LEVER_SIGMA = 1.0  # m
_ROUNDS = 4
_TOLERANCE = 0.1  # of gravity and of the board's scale
_MIN_TRIPLES = 10
_SIGNIFICANT = 4.0  # standard deviations, and triples overlap


@dataclass(frozen=True)
class Triples:
    """One camera's rows: change (n, 3) = g span + force - bias_force b_a + arm lever; see the module."""

    change: np.ndarray  # (n, 3) of p_board_cam
    arm: np.ndarray  # (n, 3, 3) the same of R_board_imu
    span: np.ndarray  # (n,) h
    force: np.ndarray  # (n, 3) R N_a
    bias_force: np.ndarray  # (n, 3, 3) R N_Q
    lever: np.ndarray | None  # (3,) where it is given


@dataclass(frozen=True)
class GravityFit:
    """gravity (3,) m/s^2 in the board frame; levers (3,) m by camera; accel_bias (3,)."""

    gravity: np.ndarray
    levers: list[np.ndarray]
    accel_bias: np.ndarray
    cost: float  # robust mean of the squared residuals, m^2/s^2


def camera_triples(
    seconds: np.ndarray,
    poses: BoardPoses,
    R_imu_cam: np.ndarray,
    lever: np.ndarray | None,
    reckoning: DeadReckoning,
    name: str,
) -> Triples:
    """Rows of all triples of good images that the IMU covers without a gap. seconds (M,): images on the imu clock.

    Raises EstimationError where there are hardly any.
    """
    usable = np.flatnonzero(poses.ok & (seconds >= 0.0) & (seconds <= reckoning.seconds[-1]))
    t = seconds[usable]
    after = np.searchsorted(t, t + _SPACING_S - 1e-3)
    before = np.searchsorted(t, t - _SPACING_S + 1e-3, side="right") - 1
    has = np.flatnonzero((after < len(t)) & (before >= 0))
    has = has[(t[after[has]] - t[has] < _LONGEST_S) & (t[has] - t[before[has]] < _LONGEST_S)]
    has = has[reckoning.unbroken(t[before[has]], t[after[has]])]
    if len(has) < _MIN_TRIPLES:
        raise EstimationError(
            f"{name} hardly ever sees the target in three images within a second while the IMU is running "
            f"({len(has)} times, {_MIN_TRIPLES} needed); record longer with the target in view."
        )
    i, j, k = before[has], has, after[has]
    Q, _, second = reckoning.at(t)
    R_board_imu = poses.R_board_cam[usable] @ R_imu_cam.T

    def change(x: np.ndarray) -> np.ndarray:
        shape = (-1,) + (1,) * (x.ndim - 1)
        return (x[k] - x[j]) / (t[k] - t[j]).reshape(shape) - (x[j] - x[i]) / (t[j] - t[i]).reshape(shape)

    N = (R_board_imu[j] @ Q[j].transpose(0, 2, 1)) @ change(second)
    p = poses.p_board_cam[usable]
    return Triples(change(p), change(R_board_imu), 0.5 * (t[k] - t[i]), N[:, :, 0], N[:, :, 1:], lever)


def fit_gravity(all_triples: list[Triples]) -> GravityFit:
    """Robust linear least squares over gravity, bias and the lever arms that are not given."""
    design, target = _stack(all_triples)
    x, _, cost = _solve(design[:, :, 1:], target, _prior(design.shape[2] - 1))
    levers, column = [], 6
    for triples in all_triples:
        levers.append(x[column : column + 3] if triples.lever is None else triples.lever)
        column += 3 if triples.lever is None else 0
    return GravityFit(x[:3], levers, x[3:6], cost)


def check_accelerometer(all_triples: list[Triples], gravity: float, imu_name: str) -> None:
    """Raises EstimationError where gravity or the accelerations do not fit the board: wrong unit or wrong tag size.

    The readings get a scale of their own: scale = unit of the board / unit of the accelerometer. Both cameras and
    gravity shrink with the board, so |g| / scale shows the accelerometer's unit and |g| the board's.
    """
    plain = float(np.linalg.norm(fit_gravity(all_triples).gravity)) / gravity
    if abs(plain - 1.0) > _TOLERANCE:
        if abs(plain * gravity - 1.0) < _TOLERANCE:
            raise EstimationError(
                f"the accelerometer of {imu_name} looks like multiples of g (gravity comes out as {plain * gravity:.2f} "
                f"m/s^2); convert it to m/s^2."
            )
        raise EstimationError(
            f"gravity comes out as {plain * gravity:.2f} m/s^2 instead of {gravity:.2f}; check the unit of the "
            f"accelerometer of {imu_name} (m/s^2), tag_size, and gravity in the rig file."
        )
    design, target = _stack(all_triples)
    x, sigma, _ = _solve(design, target + design[:, :, 0], _prior(design.shape[2]))
    excess = x[0] - 1.0
    if abs(excess) > _TOLERANCE and abs(excess) > _SIGNIFICANT * sigma[0]:
        raise EstimationError(
            f"the cameras move {x[0]:.2f} times as far as {imu_name} says; tag_size (or tag_spacing) in the rig file is "
            f"wrong by about this factor, or the accelerometer is not in m/s^2."
        )


def world_from_gravity(gravity_board: np.ndarray) -> np.ndarray:
    """R_world_board with z up; world x is the board's x (its y, where x is vertical) made horizontal."""
    z = -gravity_board / np.linalg.norm(gravity_board)
    along = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = along - z * (along @ z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def _stack(all_triples: list[Triples]) -> tuple[np.ndarray, np.ndarray]:
    """Design (n, 3, 7 + 3 per free lever arm), columns scale of the readings, gravity, bias, lever arms; target (n, 3).

    The target is what is left with a scale of 1.
    """
    free = sum(t.lever is None for t in all_triples)
    rows, targets, column = [], [], 7
    for t in all_triples:
        A = np.zeros((len(t.span), 3, 7 + 3 * free))
        A[:, :, 0] = t.force
        A[:, :, 1:4] = t.span[:, None, None] * np.eye(3)
        A[:, :, 4:7] = -t.bias_force
        target = t.change - t.force
        if t.lever is None:
            A[:, :, column : column + 3] = t.arm
            column += 3
        else:
            target = target - t.arm @ t.lever
        rows.append(A)
        targets.append(target)
    return np.concatenate(rows), np.concatenate(targets)


def _prior(size: int) -> np.ndarray:
    """Standard deviations of the last `size` columns of the design: bias and lever arms are bounded, the rest is not."""
    sigma = np.full(7 + max(size - 7, 0) + 1, np.inf)[:size]
    head = size % 3  # 1 with the scale in front, 0 without
    sigma[head + 3 : head + 6] = _BIAS_SIGMA
    sigma[head + 6 :] = _LEVER_SIGMA
    return sigma


def _solve(design: np.ndarray, target: np.ndarray, prior: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Solution, its standard deviations and the mean squared residual, reweighted (Cauchy); priors about zero."""
    weight = np.ones(len(design))
    x, sigma, variance = np.zeros(len(prior)), np.zeros(len(prior)), 1.0
    for _ in range(_ROUNDS):
        rows = design * weight[:, None, None]
        A = np.einsum("nip,niq->pq", rows, design, optimize=True)
        A += np.diag(variance / prior**2)
        covariance = np.linalg.pinv(A, rcond=1e-12, hermitian=True)
        x = covariance @ np.einsum("nip,ni->p", rows, target)
        square = np.sum((target - design @ x) ** 2, axis=1)
        variance = float(np.median(square)) / 2.37 + 1e-20  # the median of chi^2 with three degrees of freedom
        weight = 1.0 / (1.0 + square / (8.0 * variance))
        sigma = np.sqrt(variance * np.diag(covariance))
    return x, sigma, float(np.mean(weight * square) / np.mean(weight))
