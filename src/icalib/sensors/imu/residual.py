"""The IMU factor: readings between neighbouring keyframes, preintegrated once (paper (16)-(19))."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.small import inverse_cholesky, mul3, tmul3
from icalib.motion.factor import FactorKey, RowFactor, Whitened
from icalib.motion.imu_data import ImuData
from icalib.motion.integration import Increment, bias_of, integrate, integration_room, readings_of
from icalib.motion.integration_step import COVARIANCE_SIZE, correction
from icalib.optim import memory
from icalib.optim.arrowhead import Piece, in_parallel
from icalib.optim.prior_factor import accumulate_bias_prior
from icalib.optim.rows import KEYFRAME_PAIR_DIM, add_product, whiten
from icalib.optim.state import KEYFRAME_DIM, State

ROWS = 15  # rotation, velocity, position, gyro bias, accelerometer bias
KINDS = {"gyroscope": slice(0, 3), "accelerometer": slice(3, 9), "bias walk": slice(9, ROWS)}


@njit(cache=True, nogil=True)
def _preintegrate(k0, k1, keyframes, first, readings, bias, intrinsics, dR, dv, dp, J, W):
    """Increments, bias (and intrinsics) Jacobians and inverse Cholesky factor W of the covariance, intervals k0..k1."""
    P, by, room = np.empty((ROWS, ROWS)), correction(intrinsics), integration_room(COVARIANCE_SIZE)
    for k in range(k0, k1):
        out = Increment(dR[k], dv[k], dp[k], J[k], P)
        integrate(keyframes[k], keyframes[k + 1], first[k], bias_of(bias, k), readings, by, room, out)
        inverse_cholesky(P, W[k])


class Chain(NamedTuple):
    """The keyframes: R_world_imu (K, 3, 3), p, v (K, 3), biases (K, 6), seconds (K,); gravity m/s^2."""

    R: np.ndarray
    p: np.ndarray
    v: np.ndarray
    b: np.ndarray
    seconds: np.ndarray
    gravity: float


class Increments(NamedTuple):
    """Preintegrated intervals (K - 1, ...): rotation, velocity, position; their Jacobians J (9, 6 or 30) by biases and
    intrinsics, the inverse Cholesky factor W (15, 15), the biases that they were made with."""

    dR: np.ndarray
    dv: np.ndarray
    dp: np.ndarray
    J: np.ndarray
    W: np.ndarray
    bias0: np.ndarray


@njit(cache=True, nogil=True, inline="always")
def _correction(k, chain, made, dx, change):
    """change (9,): the increments' by biases and intrinsics `dx` other than those that they were made with."""
    for i in range(9):
        change[i] = 0.0
        for j in range(6):
            change[i] += made.J[k, i, j] * (chain.b[k, j] - made.bias0[k, j])
        for j in range(len(dx)):
            change[i] += made.J[k, i, 6 + j] * dx[j]


@njit(cache=True, nogil=True, inline="always")
def _motion(k, chain):
    """R_k^T R_k+1, and velocity and position gained without gravity, in the axes of keyframe k."""
    R0, dt, g = chain.R[k], chain.seconds[k + 1] - chain.seconds[k], chain.gravity
    mv, mp, hv, hp = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        mv[i] = chain.v[k + 1, i] - chain.v[k, i]
        mp[i] = chain.p[k + 1, i] - chain.p[k, i] - chain.v[k, i] * dt
    mv[2] += g * dt
    mp[2] += 0.5 * g * dt * dt
    for i in range(3):
        hv[i] = R0[0, i] * mv[0] + R0[1, i] * mv[1] + R0[2, i] * mv[2]
        hp[i] = R0[0, i] * mp[0] + R0[1, i] * mp[1] + R0[2, i] * mp[2]
    return tmul3(R0, chain.R[k + 1]), hv, hp


@njit(cache=True, nogil=True, inline="always")
def _residual(k, chain, made, change, R01, hv, hp, r):
    """r (15,) = predicted - measured of interval k, not whitened."""
    error = so3.log(tmul3(so3.exp(change[:3]), tmul3(made.dR[k], R01)))
    for i in range(3):
        r[i] = error[i]
        r[3 + i] = hv[i] - made.dv[k, i] - change[3 + i]
        r[6 + i] = hp[i] - made.dp[k, i] - change[6 + i]
    for i in range(6):
        r[9 + i] = chain.b[k + 1, i] - chain.b[k, i]


@njit(cache=True, nogil=True, inline="always")
def _jacobians(k, chain, made, change, R01, hv, hp, r, J):
    """J (15, 30 + 24 or 0): d r / d keyframe k, d r / d keyframe k + 1, d r / d intrinsics. What no interval changes is
    there already: 1 and -1 of the biases, zeros."""
    Jr_inv, R0 = so3.right_jacobian_inverse(r[:3]), chain.R[k]
    turned, J_v, J_p = mul3(Jr_inv, tmul3(chain.R[k + 1], R0)), so3.hat(hv), so3.hat(hp)
    for i in range(3):
        for j in range(3):
            J[i, j], J[3 + i, j], J[6 + i, j] = -turned[i, j], J_v[i, j], J_p[i, j]
            J[3 + i, 6 + j], J[6 + i, 3 + j] = -R0[j, i], -R0[j, i]
            J[6 + i, 6 + j] = (chain.seconds[k] - chain.seconds[k + 1]) * R0[j, i]
            J[i, KEYFRAME_DIM + j], J[3 + i, KEYFRAME_DIM + 6 + j], J[6 + i, KEYFRAME_DIM + 3 + j] = (
                Jr_inv[i, j],
                R0[j, i],
                R0[j, i],
            )
    J_turn = mul3(Jr_inv, tmul3(so3.exp(r[:3]), so3.right_jacobian(change[:3])))
    for i in range(3):
        for j in range(6 + J.shape[1] - KEYFRAME_PAIR_DIM):
            turn = 0.0
            for m in range(3):
                turn -= J_turn[i, m] * made.J[k, m, j]
            c = 9 + j if j < 6 else KEYFRAME_PAIR_DIM + j - 6
            J[i, c] = turn
            J[3 + i, c], J[6 + i, c] = -made.J[k, 3 + i, j], -made.J[k, 6 + i, j]


@njit(cache=True, nogil=True)
def _accumulate(k1, chain, made, dx, columns, sums, out):
    """Adds intervals from `sums.first` to k1 to the normal equations; whitened residuals into out (K - 1, 15).

    dx, columns (24 or 0,): change and calibration columns of the intrinsics. Returns half the chi^2.
    """
    width = KEYFRAME_PAIR_DIM + len(columns)
    r, change, J, whitened = np.zeros(ROWS), np.zeros(9), np.zeros((ROWS, width)), np.empty((ROWS, width + 1))
    for i in range(9, ROWS):
        J[i, i], J[i, KEYFRAME_DIM + i] = -1.0, 1.0
    wanted = len(sums.diagonal) > 0
    cost = 0.0
    for k in range(sums.first, k1):
        R01, hv, hp = _motion(k, chain)
        _correction(k, chain, made, dx, change)
        _residual(k, chain, made, change, R01, hv, hp, r)
        for i in range(ROWS):
            s = 0.0
            for m in range(i + 1):
                s += made.W[k, i, m] * r[m]
            out[k, i] = whitened[i, width] = s
            cost += 0.5 * s * s
        if wanted:
            _jacobians(k, chain, made, change, R01, hv, hp, r, J)
            whiten(made.W[k], J, whitened)
            add_product(k - sums.first, KEYFRAME_PAIR_DIM, width, whitened, whitened, columns, sums)
    return cost


@dataclass(frozen=True)
class ImuFactor(RowFactor):
    """All intervals of one IMU between neighbouring keyframes.

    residual (15,) of interval k: Log((dR Exp(J_R db))^T R_k^T R_k+1); R_k^T (v_k+1 - v_k - g dt) - dv - J_v db;
    R_k^T (p_k+1 - p_k - v_k dt - g dt^2 / 2) - dp - J_p db; b_k+1 - b_k, whitened jointly. The interval before each of
    `starts`, recordings' first keyframes, carries no information.
    """

    imu: ImuData
    gravity: float
    columns: np.ndarray  # (24,) calibration columns of the intrinsics, or (0,) where they are fixed
    made: Increments
    intrinsics0: np.ndarray
    starts: tuple[int, ...] = (0,)

    @property
    def name(self) -> str:
        return self.imu.name

    @property
    def key(self) -> FactorKey:
        return self.name, "readings"

    @property
    def kinds(self) -> dict[str, slice]:
        """See `RowFactor`."""
        return KINDS

    @property
    def n_keyframes(self) -> int:
        return len(self.made.dR) + 1

    def output(self) -> Whitened:
        """Empty rows (K - 1, 15) for `accumulate` to fill."""
        return Whitened.without_loss(self.n_keyframes - 1, ROWS)

    def count(self, out: Whitened, kind: str) -> int:
        """Rows of a kind, without those of intervals between recordings."""
        rows = out.residual[:, self.kinds[kind]]
        return rows.size - (len(self.starts) - 1) * rows.shape[1]

    def times(self, state: State) -> np.ndarray:
        """(K - 1,) the keyframe at which each interval starts."""
        return state.seconds[:-1]

    def accumulate_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """The broad prior on the biases of the recordings' first keyframes in `piece`, about those of the pass's start.
        Returns half its chi^2."""
        own = [k for k in self.starts if piece.first <= k < piece.last]
        return sum(accumulate_bias_prior(state, piece, sums, self.made.bias0[k], k) for k in own)

    @classmethod
    def build(cls, imu: ImuData, state: State, gravity: float, columns: np.ndarray) -> ImuFactor:
        """Preintegrates all intervals at the biases and intrinsics of `state`."""
        n = len(state.seconds) - 1
        width = 6 + len(columns)
        arrays = (
            np.empty((n, 3, 3)),
            np.empty((n, 3)),
            np.empty((n, 3)),
            memory.mmap_zeros((n, 9, width)),
            memory.mmap_zeros((n, ROWS, ROWS)),
        )
        bias0 = state.bias.copy()
        intrinsics = state.values[imu.name, "intrinsics"].copy()
        first = imu.interval(state.seconds[:-1])
        half = n // 2
        in_parallel(
            lambda ks: _preintegrate(
                ks[0], ks[1], state.seconds, first, readings_of(imu, False), bias0, intrinsics, *arrays
            ),
            [(0, half), (half, n)],
        )  # fmt: skip
        seams = np.array(state.starts[1:], dtype=np.int64) - 1
        dR, _, _, _, W = arrays
        W[seams] = 0.0
        # As if met: the logarithm of a rotation that means nothing could lie where it has no derivative.
        dR[seams] = state.rotation[seams].transpose(0, 2, 1) @ state.rotation[seams + 1]
        return cls(imu, gravity, columns, Increments(*arrays, bias0), intrinsics, state.starts)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`. There is no robust loss, so `curved` changes nothing."""
        del curved
        dx = state.values[self.imu.name, "intrinsics"] - self.intrinsics0 if len(self.columns) else np.zeros(0)
        chain = Chain(state.rotation, state.position, state.velocity, state.bias, state.seconds, self.gravity)
        return _accumulate(piece.last, chain, self.made, dx, self.columns, piece.sums(sums), out.residual)
