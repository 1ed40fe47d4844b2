"""A second calibration of the EuRoC cameras, from other images, another detector's corners, and by other code.

52 stereo stills of the same board (`aprilgrid_images`): Kannala-Brandt lenses, one pose a still, cam1's pose in cam0,
and the board's shape, by Gauss-Newton with differences for derivatives. Shares no code with the estimator.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

TAG_M, PITCH_M, TAGS = 0.088, 0.1144, 6
STEP = 1e-6
ROUNDS = 12
SHAPE = 11  # z: x^2, xy, y^2; in the plane: stretch, shear and the two components of x^2, xy, y^2
SHAPE_SIGMA_M = np.array([3e-3] * 3 + [1e-3] * 8)


@dataclass(frozen=True)
class Corners:
    frame: np.ndarray  # (N,)
    camera: np.ndarray  # (N,) 0 or 1
    point: np.ndarray  # (N,) 4 * tag + corner
    uv: np.ndarray  # (N, 2)


def read_corners(folder: Path) -> Corners:
    rows = []
    for entry in json.loads((folder / "images" / "detected_corners.json").read_text())["value0"]:
        frame, camera = entry["key"]["first"], entry["key"]["second"]
        for corner, p in zip(entry["value"]["value1"], entry["value"]["value0"], strict=True):
            rows.append((frame, camera, corner, p["value0"], p["value1"]))
    table = np.array(rows)
    frame = np.unique(table[:, 0], return_inverse=True)[1]
    return Corners(frame, table[:, 1].astype(int), table[:, 2].astype(int), table[:, 3:])


def board() -> np.ndarray:
    """(144, 3) points as drawn."""
    square = TAG_M * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    xy = np.concatenate([square + PITCH_M * np.array([t % TAGS, t // TAGS]) for t in range(TAGS * TAGS)])
    return np.column_stack([xy, np.zeros(len(xy))])


def bent(points: np.ndarray, s: np.ndarray) -> np.ndarray:
    half = points[:, :2].max(axis=0) / 2.0
    x, y = ((points[:, :2] - half) / half).T
    squares = np.stack([x * x, x * y, y * y])
    dx = s[3] * x + s[4] * y + s[[5, 7, 9]] @ squares
    dy = -s[3] * y + s[4] * x + s[[6, 8, 10]] @ squares
    return points + np.column_stack([dx, dy, s[:3] @ squares])


def project(lens: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Kannala and Brandt: fx, fy, cx, cy, k1 to k4."""
    r = np.hypot(X[:, 0], X[:, 1])
    theta = np.arctan2(r, X[:, 2])
    scale = theta * (1.0 + sum(k * theta ** (2 * n + 2) for n, k in enumerate(lens[4:]))) / r
    return lens[:2] * scale[:, None] * X[:, :2] + lens[2:4]


def start_pose(lens: np.ndarray, points: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(6,) rotation vector and position of the board in the camera, from the homography of its undistorted image."""
    image = (uv - lens[2:4]) / lens[:2]
    theta = np.linalg.norm(image, axis=1)  # nearly: the four coefficients are small
    image *= (np.tan(theta) / theta)[:, None]
    one, zero = np.ones(len(uv)), np.zeros((len(uv), 3))
    p = np.column_stack([points[:, :2], one])
    A = np.block([[p, zero, -image[:, :1] * p], [zero, p, -image[:, 1:] * p]])
    H = np.linalg.svd(A)[2][-1].reshape(3, 3)
    H /= np.sqrt(np.linalg.norm(H[:, 0]) * np.linalg.norm(H[:, 1])) * np.sign(H[2, 2])
    U, _, Vt = np.linalg.svd(np.column_stack([H[:, 0], H[:, 1], np.cross(H[:, 0], H[:, 1])]))
    return np.concatenate([Rotation.from_matrix(U @ Vt).as_rotvec(), H[:, 2]])


class Adjustment:
    """x: 6 a still, 6 cam0 to cam1, 8 a lens, then the shape."""

    def __init__(self, corners: Corners) -> None:
        self.c, self.points = corners, board()
        self.n = int(corners.frame.max()) + 1

    def start(self, lens: np.ndarray) -> np.ndarray:
        poses = []
        for k in range(self.n):
            own = [(self.c.frame == k) & (self.c.camera == camera) for camera in (0, 1)]
            best = int(own[1].sum() > own[0].sum())
            rows = own[best]
            pose = start_pose(lens, self.points[self.c.point[rows]], self.c.uv[rows])
            pose[3] += 0.11 * best  # metres between the cameras
            poses.append(pose)
        return np.concatenate([*poses, np.zeros(3), [-0.11, 0.0, 0.0], lens, lens, np.zeros(SHAPE)])

    def residuals(self, x: np.ndarray) -> np.ndarray:
        """(N, 2) px."""
        c, poses, rest = self.c, x[: 6 * self.n].reshape(-1, 6), x[6 * self.n :]
        X = bent(self.points, rest[-SHAPE:])[c.point]
        X = np.einsum("nij,nj->ni", Rotation.from_rotvec(poses[:, :3]).as_matrix()[c.frame], X) + poses[c.frame, 3:]
        second = c.camera == 1
        X[second] = Rotation.from_rotvec(rest[:3]).apply(X[second]) + rest[3:6]
        out = np.empty_like(c.uv)
        for rows, lens in ((~second, rest[6:14]), (second, rest[14:22])):
            out[rows] = project(lens, X[rows]) - c.uv[rows]
        return out

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        J = np.zeros((len(self.c.uv), 2, len(x)))
        rows = np.arange(len(self.c.uv))
        for k in range(6):  # of all stills at once: each corner sees one
            step = np.zeros(len(x))
            step[k : 6 * self.n : 6] = STEP
            J[rows, :, 6 * self.c.frame + k] = (self.residuals(x + step) - self.residuals(x - step)) / (2 * STEP)
        for k in range(6 * self.n, len(x)):
            step = np.zeros(len(x))
            step[k] = STEP
            J[:, :, k] = (self.residuals(x + step) - self.residuals(x - step)) / (2 * STEP)
        return J

    def solve(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        """x, its standard deviations, and the median-based size of a residual's component [px]."""
        sigma, H = np.nan, np.zeros((len(x), len(x)))
        for turn in range(ROUNDS):
            r, J = self.residuals(x), self.jacobian(x)
            size = np.linalg.norm(r, axis=1)
            sigma = float(np.median(size) / 1.1774)
            w = np.minimum(1.0, 2.5 * sigma / np.maximum(size, 1e-12)) * ((size < 6.0 * sigma) | (turn < 4))
            H = np.einsum("nki,n,nkj->ij", J, w, J, optimize=True)
            g = np.einsum("nki,n,nk->i", J, w, r)
            prior = (sigma / SHAPE_SIGMA_M) ** 2
            H[range(-SHAPE, 0), range(-SHAPE, 0)] += prior
            g[-SHAPE:] += prior * x[-SHAPE:]
            x = x - np.linalg.solve(H, g)
        return x, sigma * np.sqrt(np.diag(np.linalg.inv(H))), sigma


def calibrate_stills(folder: Path) -> dict:
    """Lenses (2, 8) and their deviations, shape (11,) m, distance between the cameras [m], residual size [px]."""
    adjustment = Adjustment(read_corners(folder))
    x, std, sigma = adjustment.solve(adjustment.start(np.array([460.0, 460.0, 370.0, 250.0, 0.0, 0.0, 0.0, 0.0])))
    rest, spread = x[6 * adjustment.n :], std[6 * adjustment.n :]
    return {
        "lenses": rest[6:22].reshape(2, 8),
        "std": spread[6:22].reshape(2, 8),
        "shape": rest[-SHAPE:],
        "baseline": float(np.linalg.norm(rest[3:6])),
        "sigma": sigma,
    }
