"""Compiled registration of a scan to a map of planar voxels, near the pose predicted from the previous scan."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.small import mul3, solve_definite, tmul3
from icalib.sensors.lidar.initialize.voxel_map import N_SCAN_UNKNOWNS, ScanPose, accumulate_scan, corrected_pose

MAX_REGISTRATION_ROUNDS = 14  # Gauss-Newton steps of a scan
NEIGHBOUR_ROUNDS = 4  # first steps, which also search the neighbours of a voxel
FIRST_SCALE = 0.5  # scale of the robust weights in the first step, in edges of a voxel
CONVERGED_STEP = 1e-4  # rad, m: a smaller step ends the registration
POINT_SIGMA_M = 0.1  # sigma of a point relative to the prediction; above its noise, as errors of points are correlated
# Without gyroscope, for a handheld LiDAR: standard deviations of accelerations (rad/s^2, m/s^2), and of the difference
# between a step and the mean of the rates before and after it (rad, m).
ANGULAR_ACCELERATION_SIGMA, ACCELERATION_SIGMA = 6.0, 5.0
STEP_ROTATION_SIGMA, STEP_POSITION_SIGMA = 0.02, 0.02
# With gyroscope: standard deviations of its bias (rad/s), and of its rotation between scans (rad).
GYRO_RATE_SIGMA, GYRO_ROTATION_SIGMA = 0.01, 0.004
KNOWN_TRANSLATION_SIGMA = 0.03  # m between scans: rotation times the lever arm, which is not yet known


class PosePrediction(NamedTuple):
    """Prediction of a pose from the pose `before`, `step` seconds earlier. rotation: R_before_scan (3, 3), if known;
    translation (3,): from the previous scan to this one, in axes of the previous one [m], if known."""

    before: ScanPose
    step: float
    knows_rotation: bool
    rotation: np.ndarray
    knows_translation: bool
    translation: np.ndarray

    @classmethod
    def of(
        cls, before: ScanPose, step: float, rotation: np.ndarray | None, translation: np.ndarray | None
    ) -> PosePrediction:
        """Prediction with rotation and translation, each None if unknown."""
        return cls(
            before,
            step,
            rotation is not None,
            np.eye(3) if rotation is None else np.ascontiguousarray(rotation),
            translation is not None,
            np.zeros(3) if translation is None else np.ascontiguousarray(translation),
        )


@njit(cache=True, nogil=True)
def _displacement(prediction):
    """(3,) predicted translation since the previous scan, in axes of the map [m]."""
    before, translation = prediction.before, prediction.translation
    out = np.empty(3)
    for i in range(3):
        R = before.rotation[i]
        known = R[0] * translation[0] + R[1] * translation[1] + R[2] * translation[2]
        out[i] = known if prediction.knows_translation else before.velocity[i] * prediction.step
    return out


@njit(cache=True, nogil=True)
def predicted_pose(prediction):
    """The predicted pose and twist. Rotation and translation that are not known follow from a constant twist."""
    b, h, d = prediction.before, prediction.step, _displacement(prediction)
    turn, position, rate, velocity = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):  # in loops: array expressions take seconds to compile
        turn[i], rate[i] = b.rate[i] * h, b.rate[i]
        position[i], velocity[i] = b.position[i] + d[i], d[i] / h
    R = prediction.rotation if prediction.knows_rotation else so3.exp(turn)
    return ScanPose(mul3(b.rotation, R), position, rate, velocity)


@njit(cache=True, nogil=True)
def _add_row(i, r, sigma, J_rate, H, g):
    """Adds a prediction of unknown i to the normal equations H (12, 12), g (12,). The residual r has the standard
    deviation sigma, the derivative 1 by unknown i, and -J_rate by the rate of it, unknown i + 6."""
    w, j = (POINT_SIGMA_M / sigma) ** 2, i + 6
    H[i, i] += w
    g[i] += w * r
    if J_rate != 0.0:
        H[i, j] -= w * J_rate
        H[j, i] -= w * J_rate
        H[j, j] += w * J_rate * J_rate
        g[j] -= w * J_rate * r


@njit(cache=True, nogil=True, inline="always")
def add_prediction(prediction, pose, H, g):
    """Adds the prediction of `pose` to the normal equations H (12, 12), g (12,), in units of POINT_SIGMA_M.

    Known rotations and translations are predicted directly. Unknown ones are predicted from the mean of the rates
    before and after; rates are predicted to be constant.
    """
    b, h, d = prediction.before, prediction.step, _displacement(prediction)
    R = mul3(b.rotation, prediction.rotation) if prediction.knows_rotation else b.rotation
    turn = so3.log(tmul3(R, pose.rotation))
    for i in range(3):
        if prediction.knows_rotation:
            _add_row(i, turn[i], GYRO_ROTATION_SIGMA, 0.0, H, g)
            _add_row(6 + i, pose.rate[i], GYRO_RATE_SIGMA, 0.0, H, g)
        else:
            _add_row(i, turn[i] - 0.5 * h * (b.rate[i] + pose.rate[i]), STEP_ROTATION_SIGMA, 0.5 * h, H, g)
            _add_row(6 + i, pose.rate[i] - b.rate[i], ANGULAR_ACCELERATION_SIGMA * h, 0.0, H, g)
        moved = pose.position[i] - b.position[i]
        if prediction.knows_translation:
            _add_row(3 + i, moved - d[i], KNOWN_TRANSLATION_SIGMA, 0.0, H, g)
            _add_row(9 + i, pose.velocity[i] - d[i] / h, ACCELERATION_SIGMA * h, 0.0, H, g)
        else:
            _add_row(3 + i, moved - 0.5 * h * (b.velocity[i] + pose.velocity[i]), STEP_POSITION_SIGMA, 0.5 * h, H, g)
            _add_row(9 + i, pose.velocity[i] - b.velocity[i], ACCELERATION_SIGMA * h, 0.0, H, g)


@njit(cache=True, nogil=True)
def register(voxels, xyz, tau, n_neighbour, prediction, final_scale):
    """Pose of a scan in the map (Gauss-Newton, point to plane), and its number of points near planes of the map.

    xyz (n, 3) [m] at tau (n,) [s] from the middle of the scan; steps that search neighbours use the first n_neighbour
    points only. The scale of the robust weights falls from FIRST_SCALE to final_scale, in edges of a voxel.
    """
    pose, near = predicted_pose(prediction), 0
    H, g = np.empty((N_SCAN_UNKNOWNS, N_SCAN_UNKNOWNS)), np.empty(N_SCAN_UNKNOWNS)
    for k in range(MAX_REGISTRATION_ROUNDS):
        share, wide = min(k / (NEIGHBOUR_ROUNDS + 1.0), 1.0), k < NEIGHBOUR_ROUNDS
        n = min(n_neighbour, len(xyz)) if wide else len(xyz)
        scale = voxels.edge_m * FIRST_SCALE ** (1.0 - share) * final_scale**share
        _, near = accumulate_scan(voxels, pose, xyz[:n], tau[:n], int(wide), scale, H, g)
        add_prediction(prediction, pose, H, g)
        if not solve_definite(H, g):
            break
        small = share == 1.0
        for i in range(N_SCAN_UNKNOWNS):
            g[i] = -g[i]
            small = small and (i >= 6 or abs(g[i]) < CONVERGED_STEP)
        pose = corrected_pose(pose, g)
        if small:
            break
    return pose, near
