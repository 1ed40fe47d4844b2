"""Poses whose positions and rotations are in different frames, for example with z up and with y up.

With C from the frame of positions to that of rotations, the lever arm rows are linear in M = C^T:

    y = M a + M S p + g    y: from positions, a: from the IMU, S: factor of the lever arm p, g: gravity

M is estimated by linear regression of y on a, S and g, with M, M p and g as independent unknowns. C is the orthogonal
factor of its polar decomposition. It is a candidate: the caller rotates the positions by it and tests the fit.
"""

from __future__ import annotations

from itertools import permutations, product

import numpy as np

from icalib.initialize.trajectories.lever_arm_rows import LeverArmRows

MAX_AXES_ERROR = 0.35  # largest entry of the difference from an exchange of axes: within 20 deg, C is replaced by it
MIN_POLAR_RATIO = 0.5  # least ratio of smallest to largest singular value of M; 1 for a rotation
MIN_FRAME_ROWS = 40  # least number of measurements, three times the 13 regressors
IDENTITY = np.eye(3)


def rotation_of_positions(rows: LeverArmRows, R_world_frame: np.ndarray = IDENTITY) -> np.ndarray | None:
    """Estimated rotation C (3, 3) from the frame of positions to that of rotations. None if it is the identity, if the
    regression does not give a rotation, or if there are few rows. R_world_frame (3, 3): rotation from the frame of
    rotations to the axes of the rows."""
    from_imu, n = rows.motion - rows.b, len(rows.b)
    X = np.concatenate([from_imu, rows.A[:, :, 3:6].reshape(n, 9), rows.A[:, 0, 6:7]], axis=1)
    if n < MIN_FRAME_ROWS:
        return None
    weight, M = np.ones(n), np.eye(3)
    for _ in range(3):
        x = np.linalg.lstsq(X * weight[:, None], rows.motion * weight[:, None], rcond=None)[0]
        size = np.linalg.norm(rows.motion - X @ x, axis=1)
        weight, M = (size < 4.0 * np.median(size) + 1e-9).astype(float), x[:3].T
    U, singular, Vt = np.linalg.svd(M)
    if singular[2] < MIN_POLAR_RATIO * singular[0] or np.linalg.det(U @ Vt) < 0.0:
        return None
    C = nearest_axes(R_world_frame.T @ (U @ Vt).T @ R_world_frame)
    return None if np.allclose(C, np.eye(3)) else C


def nearest_axes(C: np.ndarray) -> np.ndarray:
    """The nearest of the 24 rotations that exchange axes, if C (3, 3) is close to one; otherwise C."""
    cube = [
        np.diag(signs)[list(order)]
        for order in permutations(range(3))
        for signs in product((1.0, -1.0), repeat=3)
        if np.linalg.det(np.diag(signs)[list(order)]) > 0.0
    ]
    best = max(cube, key=lambda P: float(np.sum(P * C)))
    return best if np.abs(C - best).max() < MAX_AXES_ERROR else C


def axes_text(C: np.ndarray) -> str | None:
    """C (3, 3) as `position_axes` in the rig file; None if it is not an exchange of axes."""
    if not np.allclose(np.abs(C).max(axis=1), 1.0):
        return None
    entries = [("-" if row.min() < -0.5 else "") + "xyz"[int(np.argmax(np.abs(row)))] for row in C]
    return f"[{', '.join(entries)}]"
