"""Closed-form alignment of two motions: hand-eye rotation, lever arm, and regression of rates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.geometry import so3
from icalib.geometry.small import MEDIAN_NORM
from icalib.motion.factor import Extrinsics, Frame, absolute_residuals

# Hand-eye calibration: extrinsics of a pose sensor on a body, from poses of both at the same instants.
#
#     T_world_body(i) T_body_sensor = T_world_frame T_frame_sensor(i)
#
# The rotation starts from relative rotations between pairs of instants (Park and Martin, IEEE Trans. Robotics and
# Automation, 1994). If these are all about one axis, or there are none, it starts from relative translations as well.
# All twelve unknowns follow by robust Gauss-Newton. Nothing is assumed about the motion between instants.

MAX_HAND_EYE_PAIRS = 2000  # pairs of instants between which motions are compared; bounds the time
# Singular values of the rotation vectors, second over first: below, the second axis may be noise
SINGLE_AXIS_TURN_RATIO = 0.1
HAND_EYE_CANDIDATES = 24  # start rotations about a single axis, 15 degrees apart
MAX_HAND_EYE_ITERATIONS = 40  # at most; a smaller step than HAND_EYE_STEP_TOLERANCE ends it
HAND_EYE_STEP_TOLERANCE = 1e-10  # rad, m: largest component of the last step
MAX_HAND_EYE_STEP_RAD = 0.5  # rad: largest rotation of a step; the linearisation does not hold beyond
# Prior standard deviations of the extrinsics about their start value: unobservable components stay there.
EXTRINSICS_PRIOR_RAD = 3.0
EXTRINSICS_PRIOR_M = 0.5
MIN_RESIDUAL_SCALE = 1e-7  # rad, m: keeps weights finite for poses without noise
CAUCHY_WIDTH_SIGMAS = 3.0  # standard deviations: width of Cauchy's loss
OUTLIER_SIGMAS = 6.0  # standard deviations: pairs with a larger residual are rejected
MAX_OUTLIER_SHARE = 0.3  # of all pairs
MAX_UNEXPLAINED_MOTION = 0.35  # unexplained share of the motion: above, the poses do not belong to one rigid body
# Floors of the relative motion that residuals are compared with: a body at rest has none.
MIN_COMPARED_TURN_RAD = 0.02  # rad
MIN_COMPARED_DISPLACEMENT_M = 0.01  # m


@dataclass(frozen=True)
class PosePairs:
    """Poses of a body and of a sensor on it at the same n instants: R_world_body (n, 3, 3), p_world_body (n, 3) m;
    R_frame_sensor, p_frame_sensor likewise."""

    R_body: np.ndarray
    p_body: np.ndarray
    R_sensor: np.ndarray
    p_sensor: np.ndarray

    def some(self, which: np.ndarray) -> PosePairs:
        """The pairs selected by `which`, indices or a mask."""
        return PosePairs(self.R_body[which], self.p_body[which], self.R_sensor[which], self.p_sensor[which])


class HandEye(NamedTuple):
    """extrinsics: T_body_sensor; frame: T_world_frame; residual (n, 6): rotation [rad] and position [m] of each
    pair."""

    extrinsics: Extrinsics
    frame: Frame
    residual: np.ndarray


class RelativeMotions(NamedTuple):
    """Relative poses between m pairs of instants: rotation vectors (m, 3) rad of body and sensor, and their
    displacements (m, 3) m, each in its own axes at the first instant."""

    turn_body: np.ndarray
    turn_sensor: np.ndarray
    displacement_body: np.ndarray
    displacement_sensor: np.ndarray


def hand_eye(pairs: PosePairs, start: Extrinsics | None, fixed: tuple[bool, bool]) -> HandEye:
    """The extrinsics and the frame that fit the pairs best, robustly. start: T_body_sensor, used for components that
    the poses do not show. fixed: whether rotation and translation of `start` are kept. Needs at least three pairs."""
    motions = relative_motions(pairs)
    rotations = [start.R] if start is not None and fixed[0] else _start_rotations(motions)
    if start is not None and not fixed[0]:
        rotations.append(start.R)
    p = np.zeros(3) if start is None else start.p
    fits = [_gauss_newton(pairs, Extrinsics(R, p), fixed) for R in rotations]
    return min(fits, key=lambda f: _cost(f.residual))


def relative_motions(pairs: PosePairs) -> RelativeMotions:
    """Relative motions between all pairs of instants, or between MAX_HAND_EYE_PAIRS random ones."""
    n = len(pairs.p_body)
    i, j = np.triu_indices(n, 1)
    if len(i) > MAX_HAND_EYE_PAIRS:
        some = np.random.default_rng(0).choice(len(i), MAX_HAND_EYE_PAIRS, replace=False)
        i, j = i[some], j[some]
    turns, displacements = [], []
    for R, p in ((pairs.R_body, pairs.p_body), (pairs.R_sensor, pairs.p_sensor)):
        R_back = R[i].transpose(0, 2, 1)
        turns.append(so3.log_many(np.ascontiguousarray(R_back @ R[j])))
        displacements.append(np.einsum("nij,nj->ni", R_back, p[j] - p[i]))
    return RelativeMotions(*turns, *displacements)


def unexplained_motion(pairs: PosePairs, fit: HandEye) -> float:
    """Median residual over the median relative motion, the larger ratio of rotation and position."""
    motions = relative_motions(pairs)
    angle = max(_median_norm(motions.turn_body), _median_norm(motions.turn_sensor), MIN_COMPARED_TURN_RAD)
    distance = max(
        _median_norm(motions.displacement_body), _median_norm(motions.displacement_sensor), MIN_COMPARED_DISPLACEMENT_M
    )
    return max(_median_norm(fit.residual[:, :3]) / angle, _median_norm(fit.residual[:, 3:]) / distance)


def outlier_pairs(residual: np.ndarray) -> np.ndarray:
    """(n,) bool: pairs whose residual (n, 6) exceeds OUTLIER_SIGMAS robust standard deviations. None if there are more
    than MAX_OUTLIER_SHARE, as the robust scale is unreliable then."""
    far = np.sqrt(_squared_lengths(residual, _scales(residual)).max(axis=1)) > OUTLIER_SIGMAS
    return far & (far.sum() <= MAX_OUTLIER_SHARE * len(far))


def _start_rotations(motions: RelativeMotions) -> list[np.ndarray]:
    """Candidates of R_body_sensor, from which Gauss-Newton starts."""
    by_turns = _robust_kabsch(motions.turn_body, motions.turn_sensor)
    candidates = [by_turns, _robust_kabsch(motions.displacement_body, motions.displacement_sensor)]
    _, spread, axes = np.linalg.svd(motions.turn_sensor, full_matrices=False)
    if spread[1] < SINGLE_AXIS_TURN_RATIO * spread[0]:
        angles = 2.0 * np.pi * np.arange(1, HAND_EYE_CANDIDATES) / HAND_EYE_CANDIDATES
        candidates += [by_turns @ turn for turn in so3.exp_many(angles[:, None] * axes[0])]
    return candidates


def _robust_kabsch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """R (3, 3) with a = R b for vectors a, b (m, 3), by Kabsch's method. Pairs of different lengths get Cauchy's
    weights."""
    unlike = np.abs(np.linalg.norm(a, axis=1) - np.linalg.norm(b, axis=1))
    weight = 1.0 / (1.0 + (unlike / max(CAUCHY_WIDTH_SIGMAS * np.median(unlike), MIN_RESIDUAL_SCALE)) ** 2)
    return so3.closest_rotation((a * weight[:, None]).T @ b)


def _gauss_newton(pairs: PosePairs, start: Extrinsics, fixed: tuple[bool, bool]) -> HandEye:
    """Robust Gauss-Newton from `start`. The frame starts at the value that fits it."""
    extrinsics, frame = start, _mean_frame(pairs, start)
    free = np.repeat([not fixed[0], not fixed[1], True, True], 3)
    prior = np.repeat([1.0 / EXTRINSICS_PRIOR_RAD, 1.0 / EXTRINSICS_PRIOR_M], 3)
    residual = np.zeros((len(pairs.p_body), 6))
    for _ in range(MAX_HAND_EYE_ITERATIONS):
        R, p = pairs.R_body @ extrinsics.R, pairs.p_body + pairs.R_body @ extrinsics.p
        rows = absolute_residuals(R, p, frame, pairs.R_sensor, pairs.p_sensor)
        residual, scales = rows.residual, _scales(rows.residual)
        weight = 1.0 / (1.0 + _squared_lengths(residual, scales).sum(axis=1) / (2.0 * 3.0 * CAUCHY_WIDTH_SIGMAS**2))
        root = np.sqrt(weight)[:, None] / np.repeat(scales, 3)
        (J_pose,) = rows.J_pose
        J_arm = J_pose[:, :, 3:] @ extrinsics.R.T
        J = np.concatenate([J_pose[:, :, :3], J_arm, rows.J_frame], axis=2) * root[:, :, None]
        away = np.concatenate([so3.log(np.ascontiguousarray(start.R.T @ extrinsics.R)), extrinsics.p - start.p])
        A = np.concatenate([J.reshape(-1, 12), np.eye(6, 12) * prior[:, None]])[:, free]
        b = np.concatenate([(residual * root).ravel(), prior * away])
        d = np.zeros(12)
        d[free] = -np.linalg.lstsq(A, b, rcond=None)[0]
        d *= min(1.0, MAX_HAND_EYE_STEP_RAD / max(np.linalg.norm(d[:3]), np.linalg.norm(d[6:9]), MIN_RESIDUAL_SCALE))
        extrinsics = Extrinsics(extrinsics.R @ so3.exp(d[:3].copy()), extrinsics.p + d[3:6])
        frame = Frame(frame.R @ so3.exp(d[6:9].copy()), frame.p + d[9:])
        if np.abs(d).max() < HAND_EYE_STEP_TOLERANCE:
            break
    return HandEye(extrinsics, frame, residual)


def _mean_frame(pairs: PosePairs, extrinsics: Extrinsics) -> Frame:
    """T_world_frame by the extrinsics: mean rotation and median translation over the pairs."""
    R = so3.closest_rotation((pairs.R_body @ extrinsics.R @ pairs.R_sensor.transpose(0, 2, 1)).sum(axis=0))
    return Frame(R, np.median(pairs.p_body + pairs.R_body @ extrinsics.p - pairs.p_sensor @ R.T, axis=0))


def _scales(residual: np.ndarray) -> np.ndarray:
    """(2,) robust standard deviations of a component of rotation [rad] and position [m], from medians of residuals
    (n, 6), corrected for the twelve estimated parameters."""
    n = len(residual)
    spent = np.sqrt(6.0 * n / max(6.0 * n - 12.0, 1.0))
    sizes = [_median_norm(residual[:, k : k + 3]) for k in (0, 3)]
    return np.maximum(spent * np.array(sizes) / MEDIAN_NORM, MIN_RESIDUAL_SCALE)


def _squared_lengths(residual: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """(n, 2) squared lengths of rotation and position residuals (n, 6), over the variances `scales` squared."""
    return (residual.reshape(-1, 2, 3) ** 2).sum(axis=2) / scales**2


def _cost(residual: np.ndarray) -> float:
    """The logarithm of the product of both scales: rotation and position count alike, whatever their units."""
    return float(np.log(_scales(residual)).sum())


def _median_norm(vectors: np.ndarray) -> float:
    """Median length of vectors (n, 3)."""
    return float(np.median(np.linalg.norm(vectors, axis=1)))
