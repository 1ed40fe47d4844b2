"""Rows of measurements in the normal equations: whitened, weighted, and added to the sums of a piece."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.optim.state import KEYFRAME_DIM

KEYFRAME_PAIR_DIM = 2 * KEYFRAME_DIM  # columns of a row by two neighbouring keyframes
UInt = np.uint64


class Rows(NamedTuple):
    """n measurements of m rows. residual (n, m): predicted - measured. J (n, m, 30 + c): by keyframe, next keyframe and
    c calibration parameters; of length 0 if Jacobians are not wanted."""

    residual: np.ndarray
    J: np.ndarray

    @classmethod
    def empty(cls, n: int, m: int, n_columns: int, jacobians: bool) -> Rows:
        """Uninitialised residuals, and zero Jacobians by `n_columns` calibration parameters."""
        return cls(np.empty((n, m)), np.zeros((n if jacobians else 0, m, KEYFRAME_PAIR_DIM + n_columns)))

    @property
    def J_keyframe(self) -> np.ndarray:
        """(n, m, 15) by the keyframe."""
        return self.J[:, :, :KEYFRAME_DIM]

    @property
    def J_next(self) -> np.ndarray:
        """(n, m, 15) by the next keyframe."""
        return self.J[:, :, KEYFRAME_DIM:KEYFRAME_PAIR_DIM]

    @property
    def J_calib(self) -> np.ndarray:
        """(n, m, c) by calibration parameters."""
        return self.J[:, :, KEYFRAME_PAIR_DIM:]

    def on_intervals(self, keyframe: np.ndarray, n_keyframes: int) -> np.ndarray:
        """Interval (n,) between keyframes to which each measurement at `keyframe` (n,) is added. Measurements at the
        last keyframe go to the last interval: their Jacobians move to the columns of the next keyframe."""
        interval = np.minimum(keyframe, n_keyframes - 2)
        if len(self.J):
            last = keyframe > interval
            self.J_next[last] = self.J_keyframe[last]
            self.J_keyframe[last] = 0.0
        return interval


@njit(cache=True, nogil=True)
def add_product(k, n_chain, width, A, B, columns, sums):
    """Adds A^T B to the sums of keyframe k of the piece, of the next one, and of the calibration parameters.

    The first `width` columns of A are by keyframe k, by the next one unless n_chain is 15, then by calibration
    parameters. n_chain is 30, or twice the dimensions of a keyframe; other rows do not depend on any but the first 15.
    B (m, n_chain + c + 1) has the same columns, possibly more calibration parameters, and the residual. columns (c,):
    calibration columns of B, -1 where fixed, all different.

    Indices are unsigned. A signed index may be negative, and the wrap-around check would keep the compiler from
    vectorising.
    """
    diagonal, upper, side = sums.diagonal, sums.upper, sums.side
    n, end, n_b = UInt(n_chain), UInt(len(columns)), UInt(sums.calib.shape[0] - 1)
    block = n if n_chain == KEYFRAME_DIM else UInt(n_chain // 2)
    row, calib_row = np.empty(2 * block), np.empty(len(columns) + 1)
    for i in range(n):
        is_next = i >= block
        keyframe, r, column = (UInt(k + 1), i - block, block) if is_next else (UInt(k), i, UInt(0))
        has_next = n > block and not is_next
        for j in range(block):
            row[j] = diagonal[keyframe, r, j]
            if has_next:
                row[block + j] = upper[keyframe, r, j]
        for j in range(end):
            calib_row[j] = side[keyframe, r, UInt(columns[j])] if columns[j] >= 0 else 0.0
        calib_row[end] = side[keyframe, r, n_b]
        _add_to_row(i, n, end, column, has_next, A, B, row, calib_row)
        for j in range(block):
            diagonal[keyframe, r, j] = row[j]
            if has_next:
                upper[keyframe, r, j] = row[block + j]
        for j in range(end):
            if columns[j] >= 0:
                side[keyframe, r, UInt(columns[j])] = calib_row[j]
        side[keyframe, r, n_b] = calib_row[end]
    for i in range(n, UInt(width)):
        if columns[i - n] >= 0:
            _add_calib(i, n, UInt(width), A, B, columns, sums.calib, calib_row)


@njit(cache=True, nogil=True, inline="always")
def _add_to_row(i, n, end, column, has_next, A, B, row, calib_row):
    """Adds row i of A^T B to `row`, of two keyframes: the columns of B from `column` on, and those of the next keyframe
    if `has_next`; and to `calib_row` (end + 1,): the columns of B from n on."""
    block = UInt(len(row) // 2)
    for q in range(UInt(len(A))):
        f = A[q, i]
        if f == 0.0:
            continue
        for j in range(block):
            row[j] += f * B[q, column + j]
        if has_next:
            for j in range(block):
                row[block + j] += f * B[q, block + j]
        for j in range(end + UInt(1)):
            calib_row[j] += f * B[q, n + j]


@njit(cache=True, nogil=True)
def _add_calib(i, n, width, A, B, columns, calib, row):
    """Adds row i of A^T B, of a calibration parameter. Columns that A lacks are also added below the diagonal."""
    a, end, n_b = UInt(columns[i - n]), UInt(len(columns)), UInt(calib.shape[0] - 1)
    for j in range(end):
        row[j] = calib[a, UInt(columns[j])] if columns[j] >= 0 else 0.0
    row[end] = calib[a, n_b]
    for q in range(UInt(len(A))):
        f = A[q, i]
        if f != 0.0:
            for j in range(end + UInt(1)):
                row[j] += f * B[q, n + j]
    for j in range(end):
        if columns[j] >= 0:
            calib[a, UInt(columns[j])] = row[j]
            if n + j >= width:
                calib[UInt(columns[j]), a] = row[j]
    calib[a, n_b] = calib[n_b, a] = row[end]


@njit(cache=True, nogil=True)
def add_gram(k, n_chain, G, T, columns, F, sums):
    """Adds measurements that depend on one pose, or on several by one keyframe, from the Gram matrix of their rows.

    G (p + d + 1, p + d + 1): Gram matrix of the Jacobians by the poses, p = 6 for one, and by d further calibration
    parameters, and of the residual; the first p rows suffice if d is 0. T (p, n_chain + c): Jacobian of the poses by
    keyframes and c calibration parameters. columns (c + d,): see `add_product`. F (p, n_chain + c + d + 1): workspace.
    """
    calib, width, p = sums.calib, T.shape[1], len(T)
    n_d = G.shape[1] - p - 1
    n_c, n_b = width - n_chain, calib.shape[0] - 1
    for i in range(p):
        for j in range(width):
            F[i, j] = 0.0
        for q in range(p):
            g = G[i, q]
            for j in range(width):
                F[i, j] += g * T[q, j]
        for j in range(n_d + 1):
            F[i, width + j] = G[i, p + j]
    add_product(k, n_chain, width, T, F, columns, sums)
    for i in range(n_d):
        a = columns[n_c + i]
        if a < 0:
            continue
        for j in range(n_d):
            if columns[n_c + j] >= 0:
                calib[a, columns[n_c + j]] += G[p + i, p + j]
        calib[a, n_b] += G[p + i, p + n_d]
        calib[n_b, a] += G[p + i, p + n_d]


@njit(cache=True, nogil=True)
def add_gradients(k, n_chain, G, T, columns, first, sums):
    """Adds m gradients G (p + d, m), by poses and d calibration parameters, to the columns from `first` on; other
    arguments as in `add_gram`."""
    side, calib, n_c = sums.side, sums.calib, T.shape[1] - n_chain
    for g in range(G.shape[1]):
        for d in range(len(T)):
            f = G[d, g]
            for i in range(n_chain):
                side[k + i // KEYFRAME_DIM, i % KEYFRAME_DIM, first + g] += T[d, i] * f
            for i in range(n_c):
                if columns[i] >= 0:
                    calib[columns[i], first + g] += T[d, n_chain + i] * f
        for i in range(n_c, len(columns)):
            if columns[i] >= 0:
                calib[columns[i], first + g] += G[len(T) + i - n_c, g]


@njit(cache=True, nogil=True)
def _weigh(r, loss, scaled, root):
    """Fills root (m,), square roots of the weights of whitened residuals r (m,), and scaled (2, m), the factors of
    Jacobian rows and residuals. With `loss.curved` the factors include Triggs' correction. Returns half the robust
    chi^2."""
    cost = 0.0
    for q in range(len(r)):
        w, c, curvature = weight(loss.kind, loss.scale, r[q] * r[q])
        bend = np.sqrt(curvature) if loss.curved else 1.0
        root[q] = np.sqrt(w)
        scaled[0, q], scaled[1, q] = root[q] * bend, root[q] / bend
        cost += c
    return cost


@njit(cache=True, nogil=True)
def whiten(W, M, out):
    """Fills the first columns of out (m, .) with W M; W (m, m) lower triangular, M (m, w)."""
    for q in range(len(W)):
        for j in range(M.shape[1]):
            out[q, j] = 0.0
        for k in range(q + 1):
            f = W[q, k]
            if f != 0.0:
                for j in range(M.shape[1]):
                    out[q, j] += f * M[k, j]


@njit(cache=True, nogil=True)
def accumulate_rows(rows, keyframe, W, loss, columns, sums, residual, root):
    """Whitens rows by W (n, m, m), weights them, and adds each to the interval that begins at its `keyframe` (n,).
    Empty sums stay empty.

    columns (c,): calibration columns of rows.J, -1 where fixed. Fills residual and root (n, m): whitened residuals and
    square roots of their weights. Returns half the robust chi^2.
    """
    m, width = W.shape[1], rows.J.shape[2]
    whitened, scaled = np.empty((m, width + 1)), np.empty((2, m))
    cost = 0.0
    for i in range(len(W)):
        for q in range(m):
            residual[i, q] = 0.0
            for k in range(q + 1):
                residual[i, q] += W[i, q, k] * rows.residual[i, k]
        cost += _weigh(residual[i], loss, scaled, root[i])
        if len(sums.diagonal) == 0:
            continue
        whiten(W[i], rows.J[i], whitened)
        for q in range(m):
            for j in range(width):
                whitened[q, j] *= scaled[0, q]
            whitened[q, width] = scaled[1, q] * residual[i, q]
        add_product(keyframe[i] - sums.first, width - len(columns), width, whitened, whitened, columns, sums)
    return cost


# Robust weights of the corners of one image, and their common error, which all corners share and which is
# marginalised.

MIN_CURVATURE_RATIO = 1e-3  # floor of the curvature along a residual over its weight: keeps J^T J positive definite
LOSSES = {"none": 0, "huber": 1, "cauchy": 2}  # numbers of the setting's values in kernels


class Loss(NamedTuple):
    """Robust loss of whitened rows: kind (a number of LOSSES), scale in standard deviations, and whether the normal
    equations use its true curvature."""

    kind: int
    scale: float
    curved: bool


@njit(cache=True, nogil=True)
def weight(loss, scale, s):
    """Weight rho'(s), robust cost rho(s) / 2, and relative curvature 1 + 2 s rho'' / rho' along the residual (Triggs
    1999), at least MIN_CURVATURE_RATIO; s: squared norm of the whitened residual."""
    if loss == 0:
        return 1.0, 0.5 * s, 1.0
    if loss == 1:
        r = np.sqrt(s)
        if r <= scale:
            return 1.0, 0.5 * s, 1.0
        return scale / r, scale * r - 0.5 * scale * scale, MIN_CURVATURE_RATIO
    k = scale * scale
    return 1.0 / (1.0 + s / k), 0.5 * k * np.log1p(s / k), max((k - s) / (k + s), MIN_CURVATURE_RATIO)


@njit(cache=True, nogil=True)
def _invert_small(M, out):
    """Inverse of a small symmetric positive definite matrix by Gauss-Jordan."""
    n = M.shape[0]
    for i in range(n):
        for j in range(n):
            out[i, j] = 1.0 if i == j else 0.0
    for i in range(n):
        f = 1.0 / M[i, i]
        for j in range(n):
            M[i, j] *= f
            out[i, j] *= f
        for k in range(n):
            if k != i:
                f = M[k, i]
                for j in range(n):
                    M[k, j] -= f * M[i, j]
                    out[k, j] -= f * out[i, j]


@njit(cache=True, nogil=True, inline="always")
def robust_weights(res, keep, f, precision, sigma, loss, scale, root, shared):
    """Weights of the n corners of one image, and their common error. Fills root (n,): square roots of the weights over
    sigma (n,) px, 0 unless `keep`. Fills shared (m,): coefficients of the common error. Returns half the robust chi^2.

    res (n, 2) px; f (n, 2, m): change of each corner per unit of each coefficient; precision (m,): prior information of
    the coefficients. Weights and common error depend on each other, so a few rounds of reweighting minimise the cost
    over the common error.
    """
    n, m = len(keep), f.shape[2]
    for k in range(m):
        shared[k] = 0.0
    M, inv, rhs = np.empty((m, m)), np.empty((m, m)), np.empty(m)
    rounds = 1 if m == 0 else (2, 8, 24)[loss]
    cost = 0.0
    for turn in range(rounds):
        cost = 0.0
        for i in range(n):
            if not keep[i]:
                root[i] = 0.0
                continue
            u, v = res[i, 0], res[i, 1]
            for k in range(m):
                u += shared[k] * f[i, 0, k]
                v += shared[k] * f[i, 1, k]
            w, c, _ = weight(loss, scale, (u * u + v * v) / (sigma[i] * sigma[i]))
            root[i] = np.sqrt(w) / sigma[i]
            cost += c
        for k in range(m):
            cost += 0.5 * precision[k] * shared[k] ** 2
        if turn == rounds - 1:
            return cost
        _common_error(res, root, f, precision, M, inv, rhs, shared)
    return cost


@njit(cache=True, nogil=True, inline="always")
def _common_error(res, root, f, precision, M, inv, rhs, shared):
    """Coefficients (m,) of the common error at given weights: ridge regression of -res on the functions f."""
    m = f.shape[2]
    for a in range(m):
        rhs[a] = 0.0
        for b in range(m):
            M[a, b] = precision[a] if a == b else 0.0
    for i in range(len(root)):
        for axis in range(2):
            for a in range(m):
                wf = root[i] * root[i] * f[i, axis, a]
                for b in range(m):
                    M[a, b] += wf * f[i, axis, b]
                rhs[a] += wf * res[i, axis]
    _invert_small(M, inv)
    for a in range(m):
        shared[a] = 0.0
        for b in range(m):
            shared[a] -= inv[a, b] * rhs[b]


@njit(cache=True, nogil=True)
def add_common_error(res, f, shared, error):
    """Fills error (n, 2): residuals with the image's common error added."""
    for i in range(len(res)):
        for axis in range(2):
            error[i, axis] = res[i, axis]
            for k in range(f.shape[2]):
                error[i, axis] += shared[k] * f[i, axis, k]


@njit(cache=True, nogil=True)
def correct_curvature(A, D, i, n, r, factor):
    """Triggs' correction of corner i: scales its Jacobian rows along the residual r by `factor`, and the residual by
    its inverse. A (D + 1, 2 n): D Jacobian columns and the residual as rows; components u of all n corners, then v."""
    size = np.sqrt(r[0] * r[0] + r[1] * r[1])
    u, v = r[0] / size, r[1] / size
    for k in range(D + 1):
        along = u * A[k, i] + v * A[k, n + i]
        change = along * ((factor if k < D else 1.0 / factor) - 1.0)
        A[k, i] += change * u
        A[k, n + i] += change * v


@njit(cache=True, nogil=True)
def _elimination(A, D, n, F, precision, C, K):
    """Fills C (m, D): information of the common error of an image with the D parameters, and K (m, D): that times the
    covariance of the common error. Other arguments as in `marginalise_shared`."""
    m = len(precision)
    M, inv = np.empty((m, m)), np.empty((m, m))
    for a in range(m):
        for b in range(m):
            M[a, b] = precision[a] if a == b else 0.0
            for i in range(2 * n):
                M[a, b] += F[a, i] * F[b, i]
        for k in range(D):
            C[a, k], K[a, k] = 0.0, 0.0
            for i in range(2 * n):
                C[a, k] += F[a, i] * A[k, i]
    _invert_small(M, inv)
    for a in range(m):
        for b in range(m):
            for k in range(D):
                K[a, k] += inv[a, b] * C[b, k]


@njit(cache=True, nogil=True)
def marginalise_shared(A, D, n, F, precision, G):
    """Subtracts the Schur complement of the image's common error from the Gram matrix G (D + 1, D + 1). A (D + 1, 2 n):
    as in `correct_curvature`; F (m + 1, 2 n): the same with the columns of the common error.

    The gradient by the common error is zero, because the cost is minimal over it.
    """
    m = len(precision)
    C, K = np.empty((m, D)), np.empty((m, D))
    _elimination(A, D, n, F, precision, C, K)
    for a in range(m):
        for k in range(D):
            for c in range(D):
                G[k, c] -= K[a, k] * C[a, c]


@njit(cache=True, nogil=True)
def marginalise_gradients(A, D, n, F, precision, cluster, G):
    """Subtracts from gradients G (D, clusters) what each cluster of corners pulls the image's common error by. cluster
    (n,): index of each corner's cluster; other arguments as in `marginalise_shared`."""
    m = len(precision)
    C, K = np.empty((m, D)), np.empty((m, D))
    _elimination(A, D, n, F, precision, C, K)
    for a in range(m):
        for i in range(n):
            pull = F[a, i] * F[m, i] + F[a, n + i] * F[m, n + i]
            for k in range(D):
                G[k, cluster[i]] -= K[a, k] * pull


# Noise sizes from medians and other quantiles, which outliers hardly affect.

MEDIAN_CHI2_2DOF = 2.0 * np.log(2.0)  # median of chi^2 with 2 degrees of freedom


def median_variance(square: np.ndarray) -> float:
    """Variance of one component of isotropic normal errors in the plane, from the median of their squared lengths (n,),
    n > 0."""
    return float(np.median(square) / MEDIAN_CHI2_2DOF)


def largest_normal(deviations: float, share: float) -> float:
    """Largest plausible length of isotropic normal errors in the plane (Rayleigh distribution): `deviations` standard
    deviations above the mean length. The unit is the length that a `share` of the errors does not exceed."""
    mean, deviation = np.sqrt(np.pi / 2.0), np.sqrt(2.0 - np.pi / 2.0)
    return float((mean + deviations * deviation) / np.sqrt(-2.0 * np.log1p(-share)))


def grouped_quantiles(x: np.ndarray, group: np.ndarray, count: int, share: float) -> np.ndarray:
    """Quantiles (count,) at `share` of x (n,) within each `group` (n,) of 0..count - 1; inf for an empty group."""
    out = np.full(count, np.inf)
    ends = np.cumsum(np.bincount(group, minlength=count))
    for k, members in enumerate(np.split(x[np.argsort(group, kind="stable")], ends[:-1])):
        if len(members):
            at = int(share * (len(members) - 1))
            out[k] = np.partition(members, at)[at]
    return out
