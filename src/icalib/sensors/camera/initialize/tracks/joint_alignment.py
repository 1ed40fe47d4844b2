"""Time offsets, rotations and gyroscope bias together, from the turns of all cameras and the gyroscope's own.

Over half a second or more the gyroscope's turn, seen from camera c, is R_c2_c1 = R_i_c^T R_i2_i1 R_i_c; the epipolar
geometry of the points in both images says what left turn d it lacks (`rotation_information`), and to first order

    d = (R_c2_c1 - 1) theta_i_c + R_i_c^T (R_i2_i1 w_1 - w_2) dt + R_i_c^T (int R_i2_i dt) b_g
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.initialize.steps.epipolar_rotation import pairs_with_shared_points, rotation_information_of_pairs
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.rate_alignment import MIN_SECOND_AXIS_RATIO, RateAlignment, only_axis
from icalib.optim.calib_block import complement

STEPS_S = (0.5, 1.0)
MOST_PAIRS = 400  # of images of a camera and a step
ROUNDS = 6


@dataclass(frozen=True)
class SharedRays:
    """Two images of camera `camera` at t1, t2 on its clock, rays f and h (n, 3) of the points they share."""

    camera: int
    t1: float
    t2: float
    f: np.ndarray
    h: np.ndarray


def shared_rays(camera: int, stream: TrackStream, model: CameraModel, params: np.ndarray) -> list[SharedRays]:
    rays, valid = model.unproject(params, stream.uv)
    t = stream.seconds
    return [
        SharedRays(camera, float(t[i]), float(t[j]), rays[p], rays[q])
        for i, j, p, q in pairs_with_shared_points(stream, valid, STEPS_S, MOST_PAIRS)
    ]


def align_jointly(
    gyro: GyroRotation, pairs: list[SharedRays], start: list[RateAlignment], fixed: list[tuple[bool, bool]]
) -> list[RateAlignment]:
    """The alignments improved, the bias that of `gyro` and more, the same for all; fixed: whether the rotation and the
    time offset of each camera are known."""
    imu, n, bias = gyro.imu, 4 * len(start), np.mean([a.gyro_bias for a in start], axis=0)
    held = np.array([x for r, t in fixed for x in (r, r, r, t)] + [False] * 3)
    for _ in range(ROUNDS):
        gyro = GyroRotation.integrate(imu, bias)
        offset = np.array([start[p.camera].offset for p in pairs])
        t1, t2 = np.array([p.t1 for p in pairs]) + offset, np.array([p.t2 for p in pairs]) + offset
        own, D, swept, turned = gyro_turns(gyro, t1, t2)
        if not len(own):
            return start
        N, r = _normal([pairs[i] for i in own], start, D, swept, turned)
        x = _solve(N, r, held, _open(start, so3.log_many(D)))
        bias = bias + x[n:]
        start = [
            replace(a, offset=a.offset + x[4 * k + 3], rotation=a.rotation @ so3.exp(x[4 * k : 4 * k + 3].copy()))
            for k, a in enumerate(start)
        ]
    return [replace(a, gyro_bias=bias) for a in start]


def _open(start: list[RateAlignment], turns: np.ndarray) -> np.ndarray:
    """(4 C + 3, C or 0) what turns (m, 3) of the gyroscope about one axis leave open: each camera's turn about it."""
    axis = only_axis(turns, MIN_SECOND_AXIS_RATIO)
    if axis is None:
        return np.zeros((4 * len(start) + 3, 0))
    out = np.zeros((4 * len(start) + 3, len(start)))
    for k, a in enumerate(start):
        out[4 * k : 4 * k + 3, k] = a.rotation.T @ axis
    return out


def _solve(N: np.ndarray, r: np.ndarray, held: np.ndarray, still: np.ndarray) -> np.ndarray:
    """The x of N x = r without what is `held` (n,), and at right angles to the columns of `still` (n, m)."""
    bound = np.concatenate([np.eye(len(r))[:, held], still], axis=1)
    free = complement(np.linalg.qr(bound)[0], len(r))
    M = free.T @ N @ free
    return free @ np.linalg.solve(M + 1e-12 * np.diag(M.diagonal()), free.T @ r)


def _normal(
    pairs: list[SharedRays], start: list[RateAlignment], D: np.ndarray, swept: np.ndarray, turned: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix and right-hand side of all alignments and the bias; see `gyro_turns`."""
    n, m, camera = 4 * len(start), len(pairs), np.array([p.camera for p in pairs], dtype=np.int64)
    R_ci = np.array([a.rotation.T for a in start])[camera]
    R = np.ascontiguousarray(R_ci @ D @ R_ci.transpose(0, 2, 1))
    H, g, J = np.empty((m, 3, 3)), np.empty((m, 3)), np.zeros((m, 3, n + 3))
    begin, empty = np.cumsum([0] + [len(p.f) for p in pairs]), [np.zeros((0, 3))]
    f, h = (np.concatenate([getattr(p, side) for p in pairs] or empty) for side in ("f", "h"))
    stiff = np.zeros((len(f), 0, 3))
    rotation_information_of_pairs(f, h, stiff, stiff, begin, R, H, g, np.empty(m))
    for c in range(len(start)):
        own = camera == c
        J[own, :, 4 * c : 4 * c + 3] = R[own] - np.eye(3)
        J[own, :, 4 * c + 3] = np.einsum("nij,nj->ni", R_ci[own], swept[own])
    J[:, :, n:] = R_ci @ turned
    flat = J.reshape(3 * m, n + 3)
    return flat.T @ (H @ J).reshape(3 * m, n + 3), flat.T @ g.ravel()


def gyro_turns(
    gyro: GyroRotation, t1: np.ndarray, t2: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Which intervals t1 to t2 (n,) [s, imu clock] the gyroscope covers, indices (m,); of each R_i2_i1 (m, 3, 3),
    R_i2_i1 w_1 - w_2 (m, 3), and the integral of R_i2_i in between (m, 3, 3)."""
    imu = gyro.imu
    h = np.diff(imu.seconds)[:, None]
    flat = gyro.rotation.reshape(-1, 9)
    whole = np.concatenate([np.zeros((1, 9)), np.cumsum(0.5 * h * (flat[1:] + flat[:-1]), axis=0)])

    def at(x: np.ndarray, t: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(t, imu.seconds, x[:, k]) for k in range(x.shape[1])], axis=1)

    R1, R2 = gyro.at(t1), gyro.at(t2)
    w1, w2 = at(imu.gyro, t1), at(imu.gyro, t2)
    turned = R2.transpose(0, 2, 1) @ (at(whole, t2) - at(whole, t1)).reshape(-1, 3, 3)
    D = R2.transpose(0, 2, 1) @ R1
    inside = (t1 > imu.seconds[0]) & (t2 < imu.seconds[-1])
    bias = gyro_bias_of(gyro)
    swept = np.einsum("nij,nj->ni", D, w1 - bias) - (w2 - bias)
    return np.flatnonzero(inside), D[inside], swept[inside], turned[inside]


def gyro_bias_of(gyro: GyroRotation) -> np.ndarray:
    """(3,) the bias that `gyro` was integrated with."""
    return 0.5 * (gyro.imu.gyro[0] + gyro.imu.gyro[1]) - gyro.rate[0]
