"""Compiled registration of a scan to a map of flat voxels, near where the scan before expects it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.small import mul3, solve_definite, tmul3
from icalib.sensors.lidar.initialize.voxel_map import UNKNOWNS, ScanPose, moved, sums

ROUNDS = 14
WIDE_ROUNDS = 4  # that look into voxels around
SCALE = 0.5  # of an edge: of the weights in the first round
SMALL = 1e-4  # rad, m: a step that ends the search
POINT_SIGMA_M = 0.1  # of a point against what is expected of the motion: points of one plane err together
# What a motion may do between scans: change its rates (rad/s^2, m/s^2), and depart from their means (rad, m).
ANGULAR_ACCELERATION, ACCELERATION = 6.0, 5.0
TURN_SIGMA, MOVE_SIGMA = 0.02, 0.02
# Where the gyroscope turns the points: its bias and the alignment may err by this much (rad/s, rad).
RATE_SIGMA, GYRO_SIGMA = 0.01, 0.004
KNOWN_SIGMA = 0.03  # m, of a known way between scans: what a lever arm that is not known makes of it


class Expected(NamedTuple):
    """What the scan before says of a pose: `before` it by `step` s; `turned` (3, 3) and `way` (3,) since, in the axes
    of the one before, where they are known."""

    before: ScanPose
    step: float
    knows_turn: bool
    turned: np.ndarray
    knows_way: bool
    way: np.ndarray

    @classmethod
    def of(cls, before: ScanPose, step: float, turned: np.ndarray | None, way: np.ndarray | None) -> Expected:
        """None: not known."""
        return cls(
            before,
            step,
            turned is not None,
            np.eye(3) if turned is None else np.ascontiguousarray(turned),
            way is not None,
            np.zeros(3) if way is None else np.ascontiguousarray(way),
        )


@njit(cache=True, nogil=True)
def _way(e):
    """(3,) m since the scan before, in the map."""
    way = np.empty(3)
    for i in range(3):
        R = e.before.rotation[i]
        known = R[0] * e.way[0] + R[1] * e.way[1] + R[2] * e.way[2]
        way[i] = known if e.knows_way else e.before.velocity[i] * e.step
    return way


@njit(cache=True, nogil=True)
def expected_pose(e):
    """Where the scan is looked for."""
    b, way = e.before, _way(e)
    turn, position, rate, velocity = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):  # in loops: array expressions take seconds to compile
        turn[i], rate[i] = b.rate[i] * e.step, b.rate[i]
        position[i], velocity[i] = b.position[i] + way[i], way[i] / e.step
    return ScanPose(mul3(b.rotation, e.turned if e.knows_turn else so3.exp(turn)), position, rate, velocity)


@njit(cache=True, nogil=True)
def _add_row(i, r, sigma, mean, H, g):
    """Row i of what is expected: unknown i, less `mean` of its rate, departs by r."""
    w, j = (POINT_SIGMA_M / sigma) ** 2, i + 6
    H[i, i] += w
    g[i] += w * r
    if mean != 0.0:
        H[i, j] -= w * mean
        H[j, i] -= w * mean
        H[j, j] += w * mean * mean
        g[j] -= w * mean * r


@njit(cache=True, nogil=True, inline="always")
def add_expected(e, pose, H, g):
    """Adds to the normal equations (12, 12), (12,) that rates change little, and poses by the mean of the rates around
    them, in units of POINT_SIGMA_M."""
    b, h, way = e.before, e.step, _way(e)
    turned = so3.log(tmul3(mul3(b.rotation, e.turned) if e.knows_turn else b.rotation, pose.rotation))
    for i in range(3):
        if e.knows_turn:
            _add_row(i, turned[i], GYRO_SIGMA, 0.0, H, g)
            _add_row(6 + i, pose.rate[i], RATE_SIGMA, 0.0, H, g)
        else:
            _add_row(i, turned[i] - 0.5 * h * (b.rate[i] + pose.rate[i]), TURN_SIGMA, 0.5 * h, H, g)
            _add_row(6 + i, pose.rate[i] - b.rate[i], ANGULAR_ACCELERATION * h, 0.0, H, g)
        moved = pose.position[i] - b.position[i]
        if e.knows_way:
            _add_row(3 + i, moved - way[i], KNOWN_SIGMA, 0.0, H, g)
            _add_row(9 + i, pose.velocity[i] - way[i] / h, ACCELERATION * h, 0.0, H, g)
        else:
            _add_row(3 + i, moved - 0.5 * h * (b.velocity[i] + pose.velocity[i]), MOVE_SIGMA, 0.5 * h, H, g)
            _add_row(9 + i, pose.velocity[i] - b.velocity[i], ACCELERATION * h, 0.0, H, g)


@njit(cache=True, nogil=True)
def register(voxels, xyz, tau, n_wide, e, last):
    """Pose of the scan of points xyz (n, 3) m at tau (n,) s from its middle, as `Expected` e, of which the first n_wide
    are looked for in voxels around, too; weights end at a scale of `last` edges. And how many points lie on the map's
    planes."""
    pose, H, g, near = expected_pose(e), np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS), 0
    for k in range(ROUNDS):
        share, wide = min(k / (WIDE_ROUNDS + 1.0), 1.0), k < WIDE_ROUNDS
        n = min(n_wide, len(xyz)) if wide else len(xyz)
        scale = voxels.edge_m * SCALE ** (1.0 - share) * last**share
        _, near = sums(voxels, pose, xyz[:n], tau[:n], int(wide), scale, H, g)
        add_expected(e, pose, H, g)
        if not solve_definite(H, g):
            break
        small = share == 1.0
        for i in range(UNKNOWNS):
            g[i] = -g[i]
            small = small and (i >= 6 or abs(g[i]) < SMALL)
        pose = moved(pose, g)
        if small:
            break
    return pose, near
