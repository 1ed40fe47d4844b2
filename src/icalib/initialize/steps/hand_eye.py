"""Hand-eye calibration: how a pose sensor is mounted on a body, from poses of both at the same instants.

    T_world_body(i) T_body_sensor = T_world_frame T_frame_sensor(i)

The rotation starts from the turns between pairs of instants (Park and Martin, IEEE Trans. Robotics and Automation,
1994), and where these are all about one axis, or none, from translations, too. All twelve unknowns follow by robust
Gauss-Newton. Nothing is assumed of the motion between instants.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.geometry import so3
from icalib.motion.pose_rows import Extrinsics, Frame, absolute_residuals

MAX_HAND_EYE_PAIRS = 2000  # of instants between which turns are compared
SINGLE_AXIS_TURN_RATIO = 0.1  # of the turns about the main axis: below, those about a second axis may be noise
HAND_EYE_CANDIDATES = 24  # turns about a single axis
MAX_HAND_EYE_ITERATIONS = 40
HAND_EYE_STEP_TOLERANCE = 1e-10  # rad, m: of a step
MAX_HAND_EYE_STEP_RAD = 0.5  # rad, of a round: further away the linear rows do not hold
MOUNT_ROTATION_PRIOR_RAD, MOUNT_TRANSLATION_PRIOR_M = (
    3.0,
    0.5,
)  # rad, m: of the mount about where it starts, for what the poses do not show
MIN_RESIDUAL_SCALE = 1e-7  # rad, m: of residuals
NORM_MEDIAN = 1.538  # of three standard normal components
CAUCHY_WIDTH_SIGMAS = 3.0  # Cauchy's loss, in standard deviations
OUTLIER_SIGMAS = 6.0  # standard deviations, of a pair that is rejected
MAX_OUTLIER_SHARE = 0.3  # of all pairs
MAX_UNEXPLAINED_MOTION = 0.35  # of the motion between instants: poses of which so much is left do not belong together
MIN_COMPARED_TURN_RAD, MIN_COMPARED_DISPLACEMENT_M = (
    0.02,
    0.01,
)  # rad, m: between instants; residuals are compared with no less


@dataclass(frozen=True)
class PosePairs:
    """Poses of a body and of a sensor on it at the same n instants: R_world_body (n, 3, 3), p_world_body (n, 3) m,
    R_frame_sensor, p_frame_sensor likewise."""

    R_body: np.ndarray
    p_body: np.ndarray
    R_sensor: np.ndarray
    p_sensor: np.ndarray

    def some(self, which: np.ndarray) -> PosePairs:
        """Those at the indices or the mask `which`."""
        return PosePairs(self.R_body[which], self.p_body[which], self.R_sensor[which], self.p_sensor[which])


class HandEye(NamedTuple):
    """T_body_sensor and T_world_frame; residual (n, 6): rotation [rad] and position [m] of each pair."""

    extrinsics: Extrinsics
    frame: Frame
    residual: np.ndarray


class RelativeMotions(NamedTuple):
    """Between pairs of instants: rotation vectors (m, 3) rad in axes of the body and of the sensor, and how far each
    moved in its own axes (m, 3) m."""

    body: np.ndarray
    sensor: np.ndarray
    way_body: np.ndarray
    way_sensor: np.ndarray


def hand_eye(pairs: PosePairs, start: Extrinsics | None, held: tuple[bool, bool]) -> HandEye:
    """The mount and the frame that fit the pairs best, robustly. start: T_body_sensor where the poses leave it open;
    held: whether its rotation and its translation stay there. Needs at least three pairs."""
    turns = relative_motions(pairs)
    rotations = [start.R] if start is not None and held[0] else _start_rotations(turns)
    if start is not None and not held[0]:
        rotations.append(start.R)
    p = np.zeros(3) if start is None else start.p
    found = [_gauss_newton(pairs, Extrinsics(R, p), held) for R in rotations]
    return min(found, key=lambda f: _cost(f.residual))


def relative_motions(pairs: PosePairs) -> RelativeMotions:
    """Of all pairs of instants, or of MOST_PAIRS of them."""
    n = len(pairs.p_body)
    i, j = np.triu_indices(n, 1)
    if len(i) > MAX_HAND_EYE_PAIRS:
        some = np.random.default_rng(0).choice(len(i), MAX_HAND_EYE_PAIRS, replace=False)
        i, j = i[some], j[some]
    turns, ways = [], []
    for R, p in ((pairs.R_body, pairs.p_body), (pairs.R_sensor, pairs.p_sensor)):
        back = R[i].transpose(0, 2, 1)
        turns.append(so3.log_many(np.ascontiguousarray(back @ R[j])))
        ways.append(np.einsum("nij,nj->ni", back, p[j] - p[i]))
    return RelativeMotions(*turns, *ways)


def unexplained_motion(pairs: PosePairs, found: HandEye) -> float:
    """Medians of the residuals over those of the motion between instants, the larger of rotation and position."""
    turns = relative_motions(pairs)
    turned = max(_median_norm(turns.body), _median_norm(turns.sensor), MIN_COMPARED_TURN_RAD)
    moved = max(_median_norm(turns.way_body), _median_norm(turns.way_sensor), MIN_COMPARED_DISPLACEMENT_M)
    return max(_median_norm(found.residual[:, :3]) / turned, _median_norm(found.residual[:, 3:]) / moved)


def outlier_pairs(residual: np.ndarray) -> np.ndarray:
    """(n,) bool: pairs whose residual (n, 6) stands out; none where so many do that the rest proves nothing."""
    far = np.sqrt(_squared_lengths(residual, _scales(residual)).max(axis=1)) > OUTLIER_SIGMAS
    return far & (far.sum() <= MAX_OUTLIER_SHARE * len(far))


def _start_rotations(turns: RelativeMotions) -> list[np.ndarray]:
    """Rotations R_body_sensor to start from."""
    by_turns = _robust_kabsch(turns.body, turns.sensor)
    found = [by_turns, _robust_kabsch(turns.way_body, turns.way_sensor)]
    _, spread, axes = np.linalg.svd(turns.sensor, full_matrices=False)
    if spread[1] < SINGLE_AXIS_TURN_RATIO * spread[0]:
        angles = 2.0 * np.pi * np.arange(1, HAND_EYE_CANDIDATES) / HAND_EYE_CANDIDATES
        found += [by_turns @ turn for turn in so3.exp_many(angles[:, None] * axes[0])]
    return found


def _robust_kabsch(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """R with a = R b of vectors (m, 3), by Kabsch's method, in which those that are not equally long weigh less."""
    unlike = np.abs(np.linalg.norm(a, axis=1) - np.linalg.norm(b, axis=1))
    weight = 1.0 / (1.0 + (unlike / max(CAUCHY_WIDTH_SIGMAS * np.median(unlike), MIN_RESIDUAL_SCALE)) ** 2)
    return so3.closest_rotation((a * weight[:, None]).T @ b)


def _gauss_newton(pairs: PosePairs, start: Extrinsics, held: tuple[bool, bool]) -> HandEye:
    """By Gauss-Newton from a mount; the frame starts where it fits this one."""
    mount, frame = start, _mean_frame(pairs, start)
    free = np.repeat([not held[0], not held[1], True, True], 3)
    prior = np.repeat([1.0 / MOUNT_ROTATION_PRIOR_RAD, 1.0 / MOUNT_TRANSLATION_PRIOR_M], 3)
    residual = np.zeros((len(pairs.p_body), 6))
    for _ in range(MAX_HAND_EYE_ITERATIONS):
        R, p = pairs.R_body @ mount.R, pairs.p_body + pairs.R_body @ mount.p
        rows = absolute_residuals(R, p, frame, pairs.R_sensor, pairs.p_sensor)
        residual, scales = rows.residual, _scales(rows.residual)
        weight = 1.0 / (1.0 + _squared_lengths(residual, scales).sum(axis=1) / (2.0 * 3.0 * CAUCHY_WIDTH_SIGMAS**2))
        root = np.sqrt(weight)[:, None] / np.repeat(scales, 3)
        (J_pose,) = rows.J_pose
        J_arm = J_pose[:, :, 3:] @ mount.R.T
        J = np.concatenate([J_pose[:, :, :3], J_arm, rows.J_frame], axis=2) * root[:, :, None]
        away = np.concatenate([so3.log(np.ascontiguousarray(start.R.T @ mount.R)), mount.p - start.p])
        A = np.concatenate([J.reshape(-1, 12), np.eye(6, 12) * prior[:, None]])[:, free]
        b = np.concatenate([(residual * root).ravel(), prior * away])
        d = np.zeros(12)
        d[free] = -np.linalg.lstsq(A, b, rcond=None)[0]
        d *= min(1.0, MAX_HAND_EYE_STEP_RAD / max(np.linalg.norm(d[:3]), np.linalg.norm(d[6:9]), MIN_RESIDUAL_SCALE))
        mount = Extrinsics(mount.R @ so3.exp(d[:3].copy()), mount.p + d[3:6])
        frame = Frame(frame.R @ so3.exp(d[6:9].copy()), frame.p + d[9:])
        if np.abs(d).max() < HAND_EYE_STEP_TOLERANCE:
            break
    return HandEye(mount, frame, residual)


def _mean_frame(pairs: PosePairs, mount: Extrinsics) -> Frame:
    """The mean over the pairs."""
    R = so3.closest_rotation((pairs.R_body @ mount.R @ pairs.R_sensor.transpose(0, 2, 1)).sum(axis=0))
    return Frame(R, np.median(pairs.p_body + pairs.R_body @ mount.p - pairs.p_sensor @ R.T, axis=0))


def _scales(residual: np.ndarray) -> np.ndarray:
    """(2,) standard deviations of rotation and position components, from medians of residuals (n, 6); what the twelve
    unknowns take is given back."""
    n = len(residual)
    spent = np.sqrt(6.0 * n / max(6.0 * n - 12.0, 1.0))
    sizes = [_median_norm(residual[:, k : k + 3]) for k in (0, 3)]
    return np.maximum(spent * np.array(sizes) / NORM_MEDIAN, MIN_RESIDUAL_SCALE)


def _squared_lengths(residual: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """(n, 2) squared lengths of rotation and position residuals (n, 6) in standard deviations."""
    return (residual.reshape(-1, 2, 3) ** 2).sum(axis=2) / scales**2


def _cost(residual: np.ndarray) -> float:
    """Of rotation and position alike: the product of their scales."""
    return float(np.log(_scales(residual)).sum())


def _median_norm(vectors: np.ndarray) -> float:
    return float(np.median(np.linalg.norm(vectors, axis=1)))
