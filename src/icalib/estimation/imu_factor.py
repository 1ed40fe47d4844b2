"""The IMU factor: readings between neighbouring nodes, preintegrated once (paper (16)-(19))."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from icalib.estimation.arrowhead import Piece, in_parallel
from icalib.estimation.imu_data import ImuData
from icalib.estimation.integration import integrate
from icalib.estimation.state import State
from icalib.geometry import so3
from icalib.geometry.small import mul3, tmul3

ROWS = 15  # rotation, velocity, position, gyro bias, accelerometer bias


@njit(cache=True, nogil=True)
def _preintegrate(k0, k1, nodes, first, t, gyro, accel, bias, intrinsics, variance, walk, linear, dR, dv, dp, J, W):
    """Increments, bias (and intrinsics) Jacobians and inverse Cholesky factor W of the covariance, intervals k0..k1."""
    P = np.empty((ROWS, ROWS))
    for k in range(k0, k1):
        integrate(
            nodes[k], nodes[k + 1], first[k], t, gyro, accel, bias[k], intrinsics, variance, walk, linear,
            dR[k], dv[k], dp[k], J[k], P,
        )  # fmt: skip
        _inverse_cholesky(P, W[k])


@njit(cache=True, nogil=True)
def _inverse_cholesky(P, W):
    """W = L^-1 with P = L L^T, so that W r is white."""
    n = P.shape[0]
    for j in range(n):
        for i in range(j, n):
            s = P[i, j]
            for k in range(j):
                s -= P[i, k] * P[j, k]
            P[i, j] = np.sqrt(s) if i == j else s / P[j, j]
    W[:] = 0.0
    for j in range(n):
        W[j, j] = 1.0 / P[j, j]
        for i in range(j + 1, n):
            s = 0.0
            for k in range(j, i):
                s -= P[i, k] * W[k, j]
            W[i, j] = s / P[i, i]


@njit(cache=True, nogil=True)
def _put(J, row, col, sign, M):
    for i in range(3):
        for j in range(3):
            J[row + i, col + j] = sign * M[i, j]


@njit(cache=True, nogil=True)
def _residual(R0, p0, v0, b0, R1, p1, v1, b1, dt, g, dR, dv, dp, Jb, db, Jx, dx, r, J0, J1, Jc):
    """Residual (15,) = predicted - measured, and Jacobians (15, 15) of both nodes, (15, 24 or 0) of the intrinsics.

    db: bias of node 0 less the one preintegrated with; dx the same of the intrinsics; Jb, Jx: increments by them.
    """
    turn = np.zeros(3)
    for i in range(3):
        for j in range(6):
            turn[i] += Jb[i, j] * db[j]
        for j in range(len(dx)):
            turn[i] += Jx[i, j] * dx[j]
    R01 = tmul3(R0, R1)
    error = so3.log(tmul3(so3.exp(turn), tmul3(dR, R01)))
    Jr_inv = so3.right_jacobian_inverse(error)
    mv, mp = np.empty(3), np.empty(3)
    for i in range(3):
        mv[i] = v1[i] - v0[i]
        mp[i] = p1[i] - p0[i] - v0[i] * dt
    mv[2] += g * dt
    mp[2] += 0.5 * g * dt * dt
    hv, hp = np.zeros(3), np.zeros(3)
    for i in range(3):
        for j in range(3):
            hv[i] += R0[j, i] * mv[j]
            hp[i] += R0[j, i] * mp[j]
    for i in range(3):
        r[i] = error[i]
        r[3 + i] = hv[i] - dv[i]
        r[6 + i] = hp[i] - dp[i]
        for j in range(6):
            r[3 + i] -= Jb[3 + i, j] * db[j]
            r[6 + i] -= Jb[6 + i, j] * db[j]
        for j in range(len(dx)):
            r[3 + i] -= Jx[3 + i, j] * dx[j]
            r[6 + i] -= Jx[6 + i, j] * dx[j]
    for i in range(6):
        r[9 + i] = b1[i] - b0[i]
    R0t = np.ascontiguousarray(R0.T)
    _put(J0, 0, 0, -1.0, mul3(Jr_inv, tmul3(R1, R0)))
    _put(J1, 0, 0, 1.0, Jr_inv)
    _put(J0, 3, 0, 1.0, so3.hat(hv))
    _put(J0, 3, 6, -1.0, R0t)
    _put(J1, 3, 6, 1.0, R0t)
    _put(J0, 6, 0, 1.0, so3.hat(hp))
    _put(J0, 6, 3, -1.0, R0t)
    _put(J0, 6, 6, -dt, R0t)
    _put(J1, 6, 3, 1.0, R0t)
    by_turn = mul3(Jr_inv, mul3(so3.exp(-error), so3.right_jacobian(turn)))
    for i in range(3):
        for j in range(6):
            s = 0.0
            for k in range(3):
                s -= by_turn[i, k] * Jb[k, j]
            J0[i, 9 + j] = s
            J0[3 + i, 9 + j] = -Jb[3 + i, j]
            J0[6 + i, 9 + j] = -Jb[6 + i, j]
        for j in range(Jc.shape[1]):
            s = 0.0
            for k in range(3):
                s -= by_turn[i, k] * Jx[k, j]
            Jc[i, j] = s
            Jc[3 + i, j] = -Jx[3 + i, j]
            Jc[6 + i, j] = -Jx[6 + i, j]
    for i in range(6):
        J0[9 + i, 9 + i] = -1.0
        J1[9 + i, 9 + i] = 1.0


@njit(cache=True, nogil=True)
def _whiten(W, M, out):
    """out = W M for lower triangular W."""
    out[:] = 0.0
    for i in range(W.shape[0]):
        for k in range(i + 1):
            f = W[i, k]
            if f != 0.0:
                for j in range(M.shape[1]):
                    out[i, j] += f * M[k, j]


@njit(cache=True, nogil=True)
def _add_gram(A, B, out):
    """out += A^T B."""
    for k in range(A.shape[0]):
        for i in range(A.shape[1]):
            f = A[k, i]
            if f != 0.0:
                for j in range(B.shape[1]):
                    out[i, j] += f * B[k, j]


@njit(cache=True, nogil=True)
def _accumulate(
    k0, k1, R, p, v, b, nodes, g, dR, dv, dp, J, W, bias0, dx, cols, noise, given, diagonal, upper, side, border, out
):  # fmt: skip
    """Adds intervals k0..k1 to the normal equations of a piece that starts at node k0; whitened residuals into out.

    cols (24 or 0,): border columns of the intrinsics. given: use `noise` (n, 15) in place of the whitened residuals.
    Returns half the chi^2.
    """
    n_x = len(cols)
    n_b = side.shape[2] - 1
    r, J0, J1 = np.zeros(ROWS), np.zeros((ROWS, ROWS)), np.zeros((ROWS, ROWS))
    Jc = np.zeros((ROWS, n_x))
    A0, A1, Ac = np.empty((ROWS, ROWS)), np.empty((ROWS, ROWS)), np.empty((ROWS, n_x + 1))
    Jcr = np.zeros((ROWS, n_x + 1))
    cost = 0.0
    for k in range(k0, k1):
        db = b[k] - bias0[k]
        dt = nodes[k + 1] - nodes[k]
        _residual(
            R[k], p[k], v[k], b[k], R[k + 1], p[k + 1], v[k + 1], b[k + 1], dt, g,
            dR[k], dv[k], dp[k], J[k, :, :6], db, J[k, :, 6:], dx, r, J0, J1, Jc,
        )  # fmt: skip
        for i in range(ROWS):
            for j in range(n_x):
                Jcr[i, j] = Jc[i, j]
            Jcr[i, n_x] = r[i]
        _whiten(W[k], Jcr, Ac)
        for i in range(ROWS):
            if given:
                Ac[i, n_x] = noise[k, i]
            out[k, i] = Ac[i, n_x]
            cost += 0.5 * Ac[i, n_x] * Ac[i, n_x]
        if diagonal.shape[0] == 0:
            continue
        _whiten(W[k], J0, A0)
        _whiten(W[k], J1, A1)
        i = k - k0
        _add_gram(A0, A0, diagonal[i])
        _add_gram(A0, A1, upper[i])
        _add_gram(A1, A1, diagonal[i + 1])
        _scatter(A0, Ac, cols, n_b, side[i])
        _scatter(A1, Ac, cols, n_b, side[i + 1])
        if n_x:
            _scatter_border(Ac, cols, n_b, border)
    return cost


@njit(cache=True, nogil=True)
def _scatter(A, Ac, cols, n_b, side):
    """side[:, cols] += A^T Ac, its last column (the gradient) into column n_b."""
    for k in range(A.shape[0]):
        for i in range(A.shape[1]):
            f = A[k, i]
            if f != 0.0:
                for j in range(len(cols)):
                    side[i, cols[j]] += f * Ac[k, j]
                side[i, n_b] += f * Ac[k, len(cols)]


@njit(cache=True, nogil=True)
def _scatter_border(Ac, cols, n_b, border):
    for k in range(Ac.shape[0]):
        for i in range(len(cols)):
            f = Ac[k, i]
            for j in range(len(cols)):
                border[cols[i], cols[j]] += f * Ac[k, j]
            border[cols[i], n_b] += f * Ac[k, len(cols)]
            border[n_b, cols[i]] += f * Ac[k, len(cols)]


@dataclass(frozen=True)
class ImuFactor:
    """All intervals of one IMU between neighbouring nodes.

    residual (15,) of interval k: Log((dR Exp(J_R db))^T R_k^T R_k+1); R_k^T (v_k+1 - v_k - g dt) - dv - J_v db;
    R_k^T (p_k+1 - p_k - v_k dt - g dt^2 / 2) - dp - J_p db; b_k+1 - b_k, whitened jointly.
    """

    imu: ImuData
    gravity: float
    columns: np.ndarray  # (24,) border columns of the intrinsics, or (0,) where they are fixed
    dR: np.ndarray
    dv: np.ndarray
    dp: np.ndarray
    J: np.ndarray
    W: np.ndarray
    bias0: np.ndarray
    intrinsics0: np.ndarray

    @classmethod
    def build(cls, imu: ImuData, state: State, gravity: float, columns: np.ndarray) -> ImuFactor:
        """Preintegrates all intervals at the biases and intrinsics of `state`."""
        n = len(state.seconds) - 1
        width = 6 + len(columns)
        arrays = (
            np.empty((n, 3, 3)),
            np.empty((n, 3)),
            np.empty((n, 3)),
            np.empty((n, 9, width)),
            np.empty((n, ROWS, ROWS)),
        )
        bias0 = state.bias.copy()
        intrinsics = state.values[imu.name, "intrinsics"].copy()
        first = imu.interval(state.seconds[:-1])
        half = n // 2
        in_parallel(
            lambda ks: _preintegrate(
                ks[0], ks[1], state.seconds, first, imu.seconds, imu.gyro, imu.accel, bias0, intrinsics,
                imu.variance, imu.walk, False, *arrays,
            ),
            [(0, half), (half, n)],
        )  # fmt: skip
        return cls(imu, gravity, columns, *arrays, bias0, intrinsics)

    def accumulate(
        self, state: State, piece: Piece, out: np.ndarray, sums: bool = True, noise: np.ndarray | None = None
    ) -> float:
        """Fills whitened residuals `out` (K - 1, 15) for the intervals in `piece`, and adds them to its sums.

        `noise` (K - 1, 15) stands in for the whitened residuals where given. Returns half the chi^2.
        """
        dx = state.values[self.imu.name, "intrinsics"] - self.intrinsics0 if len(self.columns) else np.zeros(0)
        return _accumulate(
            piece.first, piece.last, state.rotation, state.position, state.velocity, state.bias, state.seconds,
            self.gravity, self.dR, self.dv, self.dp, self.J, self.W, self.bias0, dx, self.columns,
            out if noise is None else noise, noise is not None, *piece.sums(sums), out,
        )  # fmt: skip
