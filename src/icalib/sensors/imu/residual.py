"""The IMU factor: readings between neighbouring keyframes, preintegrated once per pass (equations (16)-(19) of the
iCalib paper).

Rows of an interval: rotation 3 [rad], velocity 3 [m/s], position 3 [m], change of gyroscope bias 3 [rad/s] and of
accelerometer bias 3 [m/s^2]; see `ImuFactor`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.small import inverse_cholesky, mul3, tmul3
from icalib.motion.factor import FactorKey, RowFactor, Whitened
from icalib.motion.imu_data import ImuData, reading_effect
from icalib.motion.integration import Increment, bias_of, integrate, integration_workspace, readings_of
from icalib.motion.integration_step import COVARIANCE_SIZE, correction
from icalib.motion.poses import gravity_of
from icalib.optim import memory
from icalib.optim.arrowhead import Piece, accumulate_bias_prior, in_parallel
from icalib.optim.rows import KEYFRAME_PAIR_DIM, add_product, whiten
from icalib.optim.state import KEYFRAME_DIM, Layout, State
from icalib.rig.scene import GRAVITY, WORLD
from icalib.sensors.imu.spec import EFFECTS, INTRINSICS, N_INTRINSICS

N_ROWS = 15  # of an interval
IS_LENGTH = np.array([False] * 3 + [True] * 6 + [False] * 3 + [True] * 3)  # (15,) rows in m, m/s and m/s^2
NONE = np.zeros(0, dtype=np.int64)
KINDS = {"gyroscope": slice(0, 3), "accelerometer": slice(3, 9), "bias walk": slice(9, N_ROWS)}


@njit(cache=True, nogil=True)
def _preintegrate(k0, k1, keyframes, first, readings, bias, intrinsics, dR, dv, dp, J, W):
    """Fills the fields of `Increments` of intervals k0 to k1 - 1; keyframes (K,) s; first (K - 1,): the reading at the
    start of each interval."""
    P, corrected, workspace = np.empty((N_ROWS, N_ROWS)), correction(intrinsics), integration_workspace(COVARIANCE_SIZE)
    for k in range(k0, k1):
        out = Increment(dR[k], dv[k], dp[k], J[k], P)
        integrate(keyframes[k], keyframes[k + 1], first[k], bias_of(bias, k), readings, corrected, workspace, out)
        inverse_cholesky(P, W[k])


class Chain(NamedTuple):
    """States of K keyframes: R_world_imu (K, 3, 3), p [m] and v [m/s] (K, 3) in the world, biases b (K, 6), seconds
    (K,); gravity [m/s^2]."""

    R: np.ndarray
    p: np.ndarray
    v: np.ndarray
    b: np.ndarray
    seconds: np.ndarray
    gravity: float


class Increments(NamedTuple):
    """K - 1 preintegrated intervals, in the axes of their first keyframe.

    dR (K - 1, 3, 3), dv [m/s], dp [m] (K - 1, 3), at the biases bias0 (K, 6); J (K - 1, 9, 6 + p): their Jacobians by
    biases and p free parameters, see `free_groups`; W (K - 1, 15, 15): inverse Cholesky factor of the covariance, which
    whitens the rows.
    """

    dR: np.ndarray
    dv: np.ndarray
    dp: np.ndarray
    J: np.ndarray
    W: np.ndarray
    bias0: np.ndarray


def preintegrated(
    imu: ImuData, seconds: np.ndarray, usable: np.ndarray, bias: np.ndarray, intrinsics: np.ndarray, n_intrinsics: int
) -> Increments:
    """The intervals between `seconds` (K,) on the IMU's clock, preintegrated at the biases (K, 6) and `intrinsics`
    (24,), with Jacobians by n_intrinsics of these. Those that are not `usable` (K - 1,) have W = 0, and no motion."""
    n = len(seconds) - 1
    J, W = memory.mmap_zeros((n, 9, 6 + n_intrinsics)), memory.mmap_zeros((n, N_ROWS, N_ROWS))
    arrays = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros((n, 3)), J, W
    first, readings = imu.interval(seconds[:-1]), readings_of(imu)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], usable, [False]]).astype(int)))
    runs = [(a, b) for a, b in edges.reshape(-1, 2).tolist()]
    halves = [(a, b) for begin, end in runs for a, b in ((begin, (begin + end) // 2), ((begin + end) // 2, end))]
    in_parallel(lambda k: _preintegrate(k[0], k[1], seconds, first, readings, bias, intrinsics, *arrays), halves)
    return Increments(*arrays, bias)


def free_groups(layout: Layout, imu: str) -> tuple[str, ...]:
    """Free groups of the parameters of an IMU, in the order of their columns."""
    groups = (spec.name for spec in (INTRINSICS, *EFFECTS))
    return tuple(g for g in groups if layout.has(imu, g) and layout.is_free(imu, g))


def free_columns(layout: Layout, imu: str) -> np.ndarray:
    """Calibration columns of `free_groups`."""
    groups = free_groups(layout, imu)
    return layout.columns(imu, *groups) if groups else NONE


def free_values(state: State, imu: str, groups: tuple[str, ...]) -> np.ndarray:
    """(p,) values of the free parameters of an IMU."""
    return np.concatenate([np.zeros(0), *(state.values[imu, group] for group in groups)])


def preintegrated_with_jacobians(
    imu: ImuData,
    seconds: np.ndarray,
    usable: np.ndarray,
    bias: np.ndarray,
    intrinsics: np.ndarray,
    groups: tuple[str, ...],
) -> Increments:
    """As `preintegrated`, with Jacobians by the parameters of the free `groups`. Effects change the readings, in which
    increments are linear; with g-sensitivity, to first order."""
    made = preintegrated(imu, seconds, usable, bias, intrinsics, N_INTRINSICS if INTRINSICS.name in groups else 0)
    columns = [made.J]
    for effect in (spec for spec in EFFECTS if spec.name in groups):
        J_reading, step = reading_effect(imu, effect, bias[:, :3].mean(axis=0)), effect.prior_sigma
        for k in range(J_reading.shape[2]):
            gyro, accel = imu.gyro - step * J_reading[:, :3, k], imu.accel - step * J_reading[:, 3:, k]
            moved = preintegrated(replace(imu, gyro=gyro, accel=accel), seconds, usable, bias, intrinsics, 0)
            turned = so3.log_many(np.ascontiguousarray(made.dR.transpose(0, 2, 1) @ moved.dR))
            change = np.concatenate([turned, moved.dv - made.dv, moved.dp - made.dp], axis=1)
            columns.append(change[:, :, None] / step)
    return made if len(columns) == 1 else made._replace(J=np.concatenate(columns, axis=2))


@njit(cache=True, nogil=True, inline="always")
def bias_correction(k, chain, increments, dx, change):
    """Fills change (9,), the first-order change of the increment of interval k since preintegration, from the changes
    of the biases and of the free parameters dx (p,)."""
    for i in range(9):
        change[i] = 0.0
        for j in range(6):
            change[i] += increments.J[k, i, j] * (chain.b[k, j] - increments.bias0[k, j])
        for j in range(len(dx)):
            change[i] += increments.J[k, i, 6 + j] * dx[j]


@njit(cache=True, nogil=True, inline="always")
def state_change(k, chain):
    """R_k^T R_k+1 (3, 3), and the changes of velocity [m/s] and position [m] (3,) over interval k, without initial
    velocity and gravity, in the axes of keyframe k."""
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
def fill_residual(k, chain, increments, change, R01, hv, hp, r):
    """Fills r (15,) = predicted - measured of interval k, not whitened."""
    error = so3.log(tmul3(so3.exp(change[:3]), tmul3(increments.dR[k], R01)))
    for i in range(3):
        r[i] = error[i]
        r[3 + i] = hv[i] - increments.dv[k, i] - change[3 + i]
        r[6 + i] = hp[i] - increments.dp[k, i] - change[6 + i]
    for i in range(6):
        r[9 + i] = chain.b[k + 1, i] - chain.b[k, i]


@njit(cache=True, nogil=True, inline="always")
def fill_jacobians(k, chain, increments, change, R01, hv, hp, r, J):
    """Fills J (15, 30 + p, and more) of r by keyframe k, keyframe k + 1 and free parameters. The caller has set the
    constant entries, zeros and the 1 and -1 of the biases."""
    Jr_inv, R0 = so3.right_jacobian_inverse(r[:3]), chain.R[k]
    J_first, J_v, J_p = mul3(Jr_inv, tmul3(chain.R[k + 1], R0)), so3.hat(hv), so3.hat(hp)
    for i in range(3):
        for j in range(3):
            J[i, j], J[3 + i, j], J[6 + i, j] = -J_first[i, j], J_v[i, j], J_p[i, j]
            J[3 + i, 6 + j], J[6 + i, 3 + j] = -R0[j, i], -R0[j, i]
            J[6 + i, 6 + j] = (chain.seconds[k] - chain.seconds[k + 1]) * R0[j, i]
            J[i, KEYFRAME_DIM + j], J[3 + i, KEYFRAME_DIM + 6 + j], J[6 + i, KEYFRAME_DIM + 3 + j] = (
                Jr_inv[i, j],
                R0[j, i],
                R0[j, i],
            )
    J_change = mul3(Jr_inv, tmul3(so3.exp(r[:3]), so3.right_jacobian(change[:3])))
    for i in range(3):
        for j in range(increments.J.shape[2]):
            J_rotation = 0.0
            for m in range(3):
                J_rotation -= J_change[i, m] * increments.J[k, m, j]
            c = 9 + j if j < 6 else KEYFRAME_PAIR_DIM + j - 6
            J[i, c] = J_rotation
            J[3 + i, c], J[6 + i, c] = -increments.J[k, 3 + i, j], -increments.J[k, 6 + i, j]


@njit(cache=True, nogil=True, inline="always")
def fill_last_column(k, chain, unit, r, J):
    """Fills the last column of J: by gravity where there is some; by the unit of length of an assumed motion, which has
    none."""
    dt, last = chain.seconds[k + 1] - chain.seconds[k], J.shape[1] - 1
    for i in range(3):
        up = chain.R[k, 2, i]
        if chain.gravity > 0.0:
            J[3 + i, last], J[6 + i, last] = up * dt, 0.5 * up * dt * dt
        else:
            J[3 + i, last], J[6 + i, last], J[12 + i, last] = -r[3 + i] / unit, -r[6 + i] / unit, -r[12 + i] / unit


@njit(cache=True, nogil=True)
def _accumulate(k1, chain, increments, dx, unit, columns, sums, out):
    """Adds intervals `sums.first` to k1 - 1 to the normal equations, and fills whitened residuals out (K - 1, 15).

    dx (p,): changes of the free parameters since preintegration. unit: see `ImuData`. columns: their calibration
    columns, then that of the unit or of gravity. Returns half the chi^2. Without sums (empty arrays) only the
    residuals are filled.
    """
    width, W = KEYFRAME_PAIR_DIM + len(columns), np.zeros((N_ROWS, N_ROWS))
    r, change, J, whitened = np.zeros(N_ROWS), np.zeros(9), np.zeros((N_ROWS, width)), np.empty((N_ROWS, width + 1))
    for i in range(9, N_ROWS):
        J[i, i], J[i, KEYFRAME_DIM + i] = -1.0, 1.0
    with_sums = len(sums.diagonal) > 0
    cost = 0.0
    for k in range(sums.first, k1):
        R01, hv, hp = state_change(k, chain)
        bias_correction(k, chain, increments, dx, change)
        fill_residual(k, chain, increments, change, R01, hv, hp, r)
        for i in range(N_ROWS):
            s = 0.0
            for m in range(i + 1):
                W[i, m] = increments.W[k, i, m] / unit if IS_LENGTH[m] else increments.W[k, i, m]
                s += W[i, m] * r[m]
            out[k, i] = whitened[i, width] = s
            cost += 0.5 * s * s
        if with_sums:
            fill_jacobians(k, chain, increments, change, R01, hv, hp, r, J)
            if len(columns) > len(dx):
                fill_last_column(k, chain, unit, r, J)
            whiten(W, J, whitened)
            add_product(k - sums.first, KEYFRAME_PAIR_DIM, width, whitened, whitened, columns, sums)
    return cost


@dataclass(frozen=True)
class ImuFactor(RowFactor):
    """All intervals of one IMU between neighbouring keyframes.

    The residual (15,) of interval k, whitened jointly, with db the change of the biases since preintegration:

        Log((dR Exp(J_R db))^T R_k^T R_k+1)
        R_k^T (v_k+1 - v_k - g dt) - dv - J_v db
        R_k^T (p_k+1 - p_k - v_k dt - g dt^2 / 2) - dp - J_p db
        b_k+1 - b_k

    All but rotation and gyroscope bias are divided by the unit of length, see `ImuData`. starts: first keyframe of each
    recording; the intervals before them carry no information.
    """

    imu: ImuData
    gravity: float  # [m/s^2], where the state has none
    layout: Layout
    groups: tuple[str, ...]  # free parameters, see `free_groups`
    columns: np.ndarray  # their calibration columns, and that of the unit of length if any
    gravity_column: np.ndarray  # (1,) that of the magnitude of gravity, or (0,)
    increments: Increments
    values0: np.ndarray  # of free parameters, at which the intervals were preintegrated
    starts: tuple[int, ...] = (0,)

    @property
    def name(self) -> str:
        return self.imu.name

    @property
    def key(self) -> FactorKey:
        return self.name, "readings"

    @property
    def kinds(self) -> dict[str, slice]:
        return KINDS

    @property
    def n_keyframes(self) -> int:
        return len(self.increments.dR) + 1

    def output(self) -> Whitened:
        """See `Factor`; K - 1 rows of 15."""
        return Whitened.without_loss(self.n_keyframes - 1, N_ROWS)

    def count(self, out: Whitened, kind: str) -> int:
        """See `RowFactor`; intervals between recordings do not count."""
        rows = out.residual[:, self.kinds[kind]]
        return rows.size - (len(self.starts) - 1) * rows.shape[1]

    def times(self, state: State) -> np.ndarray:
        """(K - 1,) time [s] of the keyframe at which each interval starts."""
        return state.seconds[:-1]

    def accumulate_bias_prior(self, state: State, piece: Piece, sums: bool = True) -> float:
        """Adds the broad prior on the biases of the first keyframe of each recording in `piece`. Its mean is the biases
        at the start of the pass. Returns half its chi^2."""
        keyframes = [k for k in self.starts if piece.first <= k < piece.last]
        return sum(accumulate_bias_prior(state, piece, sums, self.increments.bias0[k], k) for k in keyframes)

    @classmethod
    def build(cls, imu: ImuData, state: State, gravity: float, layout: Layout) -> ImuFactor:
        """Preintegrates all intervals at the biases and intrinsics of `state`."""
        bias0, intrinsics = state.bias.copy(), state.values[imu.name, "intrinsics"].copy()
        seams = np.array(state.starts[1:], dtype=np.int64) - 1
        groups, gravity_key = free_groups(layout, imu.name), (WORLD, GRAVITY.name)
        columns = np.concatenate([free_columns(layout, imu.name), imu.unit_columns(layout)])
        gravity_column = layout.columns(*gravity_key) if layout.has(*gravity_key) else NONE
        usable = ~np.isin(np.arange(len(state.seconds) - 1), seams)
        increments = preintegrated_with_jacobians(imu, state.seconds, usable, bias0, intrinsics, groups)
        # Zero residual between recordings: Log of an arbitrary rotation may have no derivative.
        increments.dR[seams] = state.rotation[seams].transpose(0, 2, 1) @ state.rotation[seams + 1]
        values = free_values(state, imu.name, groups)
        return cls(imu, gravity, layout, groups, columns, gravity_column, increments, values, state.starts)

    def with_imu(self, imu: ImuData, state: State) -> ImuFactor:
        return ImuFactor.build(imu, state, self.gravity, self.layout)

    def accumulate(self, state: State, piece: Piece, out: Whitened, sums: bool = True, curved: bool = False) -> float:
        """See `Factor`; `curved` has no effect, as there is no robust loss."""
        dx = free_values(state, self.imu.name, self.groups) - self.values0
        gravity = gravity_of(state, self.gravity)
        chain = Chain(state.rotation, state.position, state.velocity, state.bias, state.seconds, gravity)
        unit, columns = self.imu.unit_length(state), np.concatenate([self.columns, self.gravity_column])
        return _accumulate(piece.last, chain, self.increments, dx, unit, columns, piece.sums(sums), out.residual)
