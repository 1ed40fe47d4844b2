"""Compiled: from a camera's pose to the nodes and calibration parameters that it hangs on, and sums of one image into
theirs."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3


@njit(cache=True, nogil=True)
def by_imu_pose(R_ic, p_ic, R_cw):
    """(6, 6) camera pose (right rotation, position in camera axes) by the IMU's (right rotation, position)."""
    A = np.zeros((6, 6))
    lever = so3.hat(p_ic)
    for i in range(3):
        for j in range(3):
            A[i, j] = R_ic[j, i]
            A[3 + i, 3 + j] = R_cw[i, j]
            for k in range(3):
                A[3 + i, j] -= R_ic[k, i] * lever[k, j]
    return A


@njit(cache=True, nogil=True)
def _product(A, J, out):
    """out = A J for A (6, 6): all of it, or the columns from 9 on where J has fewer, those of the IMU intrinsics."""
    o = 9 if out.shape[1] > J.shape[1] else 0
    for i in range(6):
        for j in range(J.shape[1]):
            s = 0.0
            for k in range(6):
                s += A[i, k] * J[k, j]
            out[i, o + j] = s


@njit(cache=True, nogil=True)
def pose_chain(i, motion, Tn, Tm, Tc):
    """Camera pose (right rotation, position in camera axes) by the nodes (Tn, Tm) and the chained parameters (Tc).

    Chained parameters: rotation 3, translation 3, time offset 1, tilt of the scene 2, IMU intrinsics 24 or 0, pose of
    the body 6 or 0."""
    R_ic, R_cw, p_wc = motion.R_imu_cam, motion.R_cam_world[i], motion.p_world_cam[i]
    A = by_imu_pose(R_ic, motion.p_imu_cam, R_cw)
    _product(A, motion.J_node[i], Tn)
    if len(motion.J_next):
        _product(A, motion.J_next[i], Tm)
    _product(A, motion.J_imu[i], Tc)
    for r in range(6):
        Tc[r, 6] = 0.0
        for k in range(3):
            Tc[r, 6] += A[r, k] * motion.rate[i, k] + A[r, 3 + k] * motion.velocity[i, k]
    for r in range(3):
        for j in range(3):
            Tc[r, j] = 1.0 if r == j else 0.0
            Tc[3 + r, j] = 0.0
            Tc[r, 3 + j] = 0.0
            Tc[3 + r, 3 + j] = R_ic[j, r]
        # Turning the board about world x (y) is turning the camera the other way about the board's origin.
        Tc[r, 7], Tc[r, 8] = -R_cw[r, 0], -R_cw[r, 1]
        Tc[3 + r, 7] = R_cw[r, 1] * p_wc[2] - R_cw[r, 2] * p_wc[1]
        Tc[3 + r, 8] = R_cw[r, 2] * p_wc[0] - R_cw[r, 0] * p_wc[2]
    if len(motion.R_world_body):
        _by_body(i, motion, Tc)


@njit(cache=True, nogil=True, inline="always")
def _by_body(i, motion, Tc):
    """The last 6 columns of Tc: moving the body is moving the camera the other way, turning about the body's origin."""
    R_cw, R_wb, o = motion.R_cam_world[i], motion.R_world_body[i], Tc.shape[1] - 6
    away = so3.hat(motion.p_world_cam[i] - motion.p_world_body[i])
    for r in range(3):
        for j in range(3):
            Tc[r, o + j], Tc[3 + r, o + j], Tc[r, o + 3 + j], Tc[3 + r, o + 3 + j] = 0.0, 0.0, 0.0, 0.0
            for k in range(3):
                Tc[r, o + j] -= R_cw[r, k] * R_wb[k, j]
                Tc[3 + r, o + 3 + j] -= R_cw[r, k] * motion.R_world_scene[k, j]
                for m in range(3):
                    Tc[3 + r, o + j] += R_cw[r, k] * away[k, m] * R_wb[m, j]


@njit(cache=True, nogil=True)
def _outer_add(Ti, G, Tj, out):
    """out += Ti^T G[:6, :6] Tj."""
    W = np.zeros((6, Tj.shape[1]))
    for i in range(6):
        for k in range(6):
            f = G[i, k]
            for j in range(Tj.shape[1]):
                W[i, j] += f * Tj[k, j]
    for k in range(6):
        for i in range(Ti.shape[1]):
            f = Ti[k, i]
            if f != 0.0:
                for j in range(Tj.shape[1]):
                    out[i, j] += f * W[k, j]


@njit(cache=True, nogil=True)
def _add_side(T, G, D, Tc, cols_c, cols_d, side):
    """Node (through T) with the calibration parameters and the gradient: side (15, B + 1)."""
    n_b = side.shape[1] - 1
    full = np.zeros((T.shape[1], Tc.shape[1]))
    _outer_add(T, G, Tc, full)
    for i in range(T.shape[1]):
        for j in range(len(cols_c)):
            if cols_c[j] >= 0:
                side[i, cols_c[j]] += full[i, j]
        for k in range(6):
            f = T[k, i]
            if f != 0.0:
                for j in range(len(cols_d)):
                    if cols_d[j] >= 0:
                        side[i, cols_d[j]] += f * G[k, 6 + j]
                side[i, n_b] += f * G[k, D]


@njit(cache=True, nogil=True, inline="always")
def _add_calib(G, D, Tc, cols_c, cols_d, calib):
    n_b = calib.shape[0] - 1
    nc, nd = len(cols_c), len(cols_d)
    full = np.zeros((nc, nc))
    _outer_add(Tc, G, Tc, full)
    for i in range(nc):
        a = cols_c[i]
        if a < 0:
            continue
        for j in range(nc):
            if cols_c[j] >= 0:
                calib[a, cols_c[j]] += full[i, j]
        for j in range(nd + 1):
            b = n_b if j == nd else cols_d[j]
            if b >= 0:
                s = 0.0
                for k in range(6):
                    s += Tc[k, i] * G[k, 6 + j]
                calib[a, b] += s
                calib[b, a] += s
    for i in range(nd):
        a = cols_d[i]
        if a < 0:
            continue
        for j in range(nd):
            if cols_d[j] >= 0:
                calib[a, cols_d[j]] += G[6 + i, 6 + j]
        calib[a, n_b] += G[6 + i, D]
        calib[n_b, a] += G[6 + i, D]


@njit(cache=True, nogil=True)
def add_image(k, G, Tn, Tm, Tc, chained, direct, sums):
    """One image's Gram matrix G into the sums of node k and, where its pose hangs on two, of the next."""
    D = len(G) - 1
    _outer_add(Tn, G, Tn, sums.diagonal[k])
    _add_side(Tn, G, D, Tc, chained, direct, sums.side[k])
    if Tm.shape[1]:
        _outer_add(Tn, G, Tm, sums.upper[k])
        _outer_add(Tm, G, Tm, sums.diagonal[k + 1])
        _add_side(Tm, G, D, Tc, chained, direct, sums.side[k + 1])
    _add_calib(G, D, Tc, chained, direct, sums.calib)


@njit(cache=True, nogil=True)
def add_clusters(k, G, column, Tn, Tm, Tc, chained, direct, sums):
    """One image's gradients G (D, clusters) through its pose into columns of node k, the next, and the calibration
    parameters."""
    for g in range(G.shape[1]):
        for d in range(6):
            f = G[d, g]
            for a in range(15):
                sums.side[k, a, column + g] += Tn[d, a] * f
            for a in range(Tm.shape[1]):
                sums.side[k + 1, a, column + g] += Tm[d, a] * f
            for a in range(len(chained)):
                if chained[a] >= 0:
                    sums.calib[chained[a], column + g] += Tc[d, a] * f
        for a in range(len(direct)):
            if direct[a] >= 0:
                sums.calib[direct[a], column + g] += G[6 + a, g]
