"""Poses whose positions and rotations are in different frames, as of motion capture with z up here and y up there.

With C from the frame of positions to that of rotations the rows of `lidar_arm` are linear in M = C^T:

    seen = M felt + M S p + g    seen: what positions have part in, felt: the IMU, S: of the lever arm p, g: gravity

M is found by regression on felt, S and gravity, M and the products with p and g each for itself; its polar part is the
turn. It is a proposal only: the caller turns the positions by it and looks whether they fit.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from icalib.initialize.trajectories.lever_arm_rows import LeverArmRows

SQUARE = 0.35  # cosine with the next axes: turns within 20 degrees of these are meant to be about right angles
EVEN = 0.5  # the least over the largest stretch of M: a turn has 1
FEWEST = 40  # rows
UNTURNED = np.eye(3)


def turn_of_positions(rows: LeverArmRows, R_world_frame: np.ndarray = UNTURNED) -> np.ndarray | None:
    """Estimated rotation C (3, 3) from the frame of positions to that of rotations; None if it is the identity, not a
    rotation, or rows are few. R_world_frame (3, 3): rotation from the frame of rotations to the axes of the rows."""
    felt, n = rows.seen - rows.b, len(rows.b)
    X = np.concatenate([felt, rows.A[:, :, 3:6].reshape(n, 9), rows.A[:, 0, 6:7]], axis=1)
    if n < FEWEST:
        return None
    weight, M = np.ones(n), np.eye(3)
    for _ in range(3):
        x = np.linalg.lstsq(X * weight[:, None], rows.seen * weight[:, None], rcond=None)[0]
        size = np.linalg.norm(rows.seen - X @ x, axis=1)
        weight, M = (size < 4.0 * np.median(size) + 1e-9).astype(float), x[:3].T
    U, stretch, Vt = np.linalg.svd(M)
    if stretch[2] < EVEN * stretch[0] or np.linalg.det(U @ Vt) < 0.0:
        return None
    C = nearest_axes(R_world_frame.T @ (U @ Vt).T @ R_world_frame)
    return None if np.allclose(C, np.eye(3)) else C


def nearest_axes(C: np.ndarray) -> np.ndarray:
    """The turn by right angles that a turn is nearly; else the turn as it is."""
    cube = [
        np.diag(signs)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
        if np.linalg.det(np.diag(signs)[list(order)]) > 0.0
    ]
    best = max(cube, key=lambda P: float(np.sum(P * C)))
    return best if np.abs(C - best).max() < SQUARE else C


def words_for(C: np.ndarray) -> str | None:
    """C as `position_axes` of the rig file has it, None where it is not one of right angles."""
    if not np.allclose(np.abs(C).max(axis=1), 1.0):
        return None
    entries = [("-" if row.min() < -0.5 else "") + "xyz"[int(np.argmax(np.abs(row)))] for row in C]
    return f"[{', '.join(entries)}]"
