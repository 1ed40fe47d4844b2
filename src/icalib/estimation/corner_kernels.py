"""Compiled sums of the corner factor: from residuals and model Jacobians to the normal equations of a piece."""

from __future__ import annotations

import numpy as np
from numba import njit

from icalib.geometry import so3

LEAST_CURVATURE = 1e-3


@njit(cache=True, nogil=True)
def camera_points(i0, i1, start, point, R_cw, p_wc, world_points, X):
    """X (n, 3): the points of images i0..i1 in their camera's frame."""
    o = start[i0]
    for i in range(i0, i1):
        for n in range(start[i], start[i + 1]):
            q = point[n]
            a = world_points[q, 0] - p_wc[i, 0]
            b = world_points[q, 1] - p_wc[i, 1]
            c = world_points[q, 2] - p_wc[i, 2]
            for r in range(3):
                X[n - o, r] = R_cw[i, r, 0] * a + R_cw[i, r, 1] * b + R_cw[i, r, 2] * c


@njit(cache=True, nogil=True)
def _weight(loss, scale, s):
    """Weight rho' and robust cost (half rho) of a squared whitened norm s, and the curvature along the residual over
    the weight, 1 + 2 s rho'' / rho' (Triggs 1999), kept positive."""
    if loss == 0:
        return 1.0, 0.5 * s, 1.0
    if loss == 1:
        r = np.sqrt(s)
        if r <= scale:
            return 1.0, 0.5 * s, 1.0
        return scale / r, scale * r - 0.5 * scale * scale, LEAST_CURVATURE
    k = scale * scale
    return 1.0 / (1.0 + s / k), 0.5 * k * np.log1p(s / k), max((k - s) / (k + s), LEAST_CURVATURE)


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


@njit(cache=True, nogil=True)
def _robust_weights(res, keep, f, precision, sigma, loss, scale, root, shared):
    """root (n,): square roots of the weights over sigma; shared (2, m): the image's common error. Returns the cost.

    Weights and common error depend on each other; a few rounds settle them, so that the cost is the least one over it.
    """
    n, m = len(keep), f.shape[1]
    for k in range(m):
        shared[0, k], shared[1, k] = 0.0, 0.0
    M, inv, rhs = np.empty((m, m)), np.empty((m, m)), np.empty((2, m))
    rounds = 1 if m == 0 else (2 if loss == 0 else 8)
    cost = 0.0
    for turn in range(rounds):
        cost = 0.0
        for i in range(n):
            if not keep[i]:
                root[i] = 0.0
                continue
            u, v = res[i, 0], res[i, 1]
            for k in range(m):
                u += shared[0, k] * f[i, k]
                v += shared[1, k] * f[i, k]
            w, c, _ = _weight(loss, scale, (u * u + v * v) / (sigma * sigma))
            root[i] = np.sqrt(w) / sigma
            cost += c
        for k in range(m):
            cost += 0.5 * precision[k] * (shared[0, k] ** 2 + shared[1, k] ** 2)
        if turn == rounds - 1:
            return cost
        _common_error(res, root, f, precision, M, inv, rhs, shared)
    return cost


@njit(cache=True, nogil=True)
def _common_error(res, root, f, precision, M, inv, rhs, shared):
    """The image's common error (2, m) at given weights: ridge regression of -res on its functions."""
    m = f.shape[1]
    for a in range(m):
        rhs[0, a], rhs[1, a] = 0.0, 0.0
        for b in range(m):
            M[a, b] = precision[a] if a == b else 0.0
    for i in range(len(root)):
        w = root[i] * root[i]
        for a in range(m):
            for b in range(m):
                M[a, b] += w * f[i, a] * f[i, b]
            rhs[0, a] += w * f[i, a] * res[i, 0]
            rhs[1, a] += w * f[i, a] * res[i, 1]
    _invert_small(M, inv)
    for a in range(m):
        shared[0, a], shared[1, a] = 0.0, 0.0
        for b in range(m):
            shared[0, a] -= inv[a, b] * rhs[0, b]
            shared[1, a] -= inv[a, b] * rhs[1, b]


@njit(cache=True, nogil=True)
def _whole_error(res, f, shared, error):
    """error (n, 2): residuals with the image's common error in them."""
    for i in range(len(res)):
        for axis in range(2):
            error[i, axis] = res[i, axis]
            for k in range(f.shape[1]):
                error[i, axis] += shared[axis, k] * f[i, k]


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def _gram(A, D, n, out):
    """out (D, D) = A[:D, :n] A[:D, :n]^T, upper triangle mirrored. Sums may be reordered: they are vectorised."""
    for i in range(D):
        for j in range(i, D):
            s = 0.0
            for k in range(n):
                s += A[i, k] * A[j, k]
            out[i, j] = s
            out[j, i] = s


@njit(cache=True, nogil=True)
def _fill_rows(
    o, n0, n1, res, root, sigma, loss, scale, curved, X, Jp, Jpar, pars, has_bloom, direction, basis, point, R_cw, A
):  # fmt: skip
    """Weighted Jacobian of one image, transposed: A (D + 1, 2 n), u rows first; the last row the residual. Returns D.

    With `curved`, where the loss bends the rows are scaled so that A^T A is the true curvature, A^T r the true
    gradient.
    """
    n = n1 - n0
    ns = basis.shape[1]
    D = 6 + len(pars) + has_bloom + ns
    q0, q1, q2 = np.empty(ns), np.empty(ns), np.empty(ns)
    for i in range(n0, n1):
        x, y, z = X[i - o, 0], X[i - o, 1], X[i - o, 2]
        for s in range(ns):
            b = basis[point[i], s]
            q0[s] = R_cw[0, 0] * b[0] + R_cw[0, 1] * b[1] + R_cw[0, 2] * b[2]
            q1[s] = R_cw[1, 0] * b[0] + R_cw[1, 1] * b[1] + R_cw[1, 2] * b[2]
            q2[s] = R_cw[2, 0] * b[0] + R_cw[2, 1] * b[1] + R_cw[2, 2] * b[2]
        w = root[i - n0]
        for r in range(2):
            c = r * n + i - n0
            a0, a1, a2 = w * Jp[i - o, r, 0], w * Jp[i - o, r, 1], w * Jp[i - o, r, 2]
            A[0, c] = a1 * z - a2 * y
            A[1, c] = a2 * x - a0 * z
            A[2, c] = a0 * y - a1 * x
            A[3, c], A[4, c], A[5, c] = -a0, -a1, -a2
            for k in range(len(pars)):
                A[6 + k, c] = w * Jpar[i - o, r, pars[k]]
            d = 6 + len(pars)
            if has_bloom:
                A[d, c] = w * direction[i, r]
                d += 1
            for s in range(ns):
                A[d + s, c] = a0 * q0[s] + a1 * q1[s] + a2 * q2[s]
            A[D, c] = w * res[i - n0, r]
        if curved and loss > 0 and w > 0.0:
            square = (res[i - n0, 0] ** 2 + res[i - n0, 1] ** 2) / (sigma * sigma)
            _, _, curvature = _weight(loss, scale, square)
            if curvature < 1.0:
                _bend(A, D, i - n0, n, res[i - n0], np.sqrt(curvature))
    return D


@njit(cache=True, nogil=True)
def _bend(A, D, i, n, r, factor):
    """Scales the Jacobian rows of corner i along its residual r by `factor`, and the residual by its inverse."""
    size = np.sqrt(r[0] * r[0] + r[1] * r[1])
    u, v = r[0] / size, r[1] / size
    for k in range(D + 1):
        along = u * A[k, i] + v * A[k, n + i]
        change = along * ((factor if k < D else 1.0 / factor) - 1.0)
        A[k, i] += change * u
        A[k, n + i] += change * v


@njit(cache=True, nogil=True)
def _marginalise_shared(A, D, n, root, f, precision, own, given, G):
    """Takes the image's common error out of the Gram matrix G (D + 1, D + 1).

    Its own gradient is zero: the cost is the least over it. With `given` noise, own (2, m) stands for its whitened
    residual; returns rhs^T M^-1 rhs of its rows then.
    """
    m = f.shape[1]
    M, inv = np.empty((m, m)), np.empty((m, m))
    C = np.empty((m, D + 1))
    quad = 0.0
    for axis in range(2):
        for a in range(m):
            for b in range(m):
                M[a, b] = precision[a] if a == b else 0.0
            for k in range(D + 1):
                C[a, k] = 0.0
            C[a, D] = own[axis, a] * np.sqrt(precision[a]) if given else 0.0
        for i in range(n):
            for a in range(m):
                wf = root[i] * f[i, a]
                for b in range(m):
                    M[a, b] += wf * root[i] * f[i, b]
                for k in range(D + 1 if given else D):
                    C[a, k] += wf * A[k, axis * n + i]
        _invert_small(M, inv)
        for a in range(m):
            for b in range(m):
                for k in range(D + 1):
                    s = inv[a, b] * C[a, k]
                    for c in range(D + 1):
                        G[k, c] -= s * C[b, c]
                quad += inv[a, b] * C[a, D] * C[b, D]
    return quad


@njit(cache=True, nogil=True)
def _chain(R_ic, p_ic, R_cw, p_wc, rate, vel, Jn, Jm, Jx, Tn, Tm, Tc):
    """Camera pose (right rotation, position in camera axes) by the nodes (Tn, Tm) and the chained border (Tc).

    Chained border: rotation 3, translation 3, time offset 1, tilt of the board 2, IMU intrinsics 24 or 0.
    """
    A = np.empty((6, 6))
    lever = so3.hat(p_ic)
    for i in range(3):
        for j in range(3):
            A[i, j] = R_ic[j, i]
            A[i, 3 + j] = 0.0
            A[3 + i, 3 + j] = R_cw[i, j]
            s = 0.0
            for k in range(3):
                s -= R_ic[k, i] * lever[k, j]
            A[3 + i, j] = s
    for i in range(6):
        for j in range(Jn.shape[1]):
            s = 0.0
            for k in range(6):
                s += A[i, k] * Jn[k, j]
            Tn[i, j] = s
        for j in range(Tm.shape[1]):
            s = 0.0
            for k in range(6):
                s += A[i, k] * Jm[k, j]
            Tm[i, j] = s
        s = 0.0
        for k in range(3):
            s += A[i, k] * rate[k] + A[i, 3 + k] * vel[k]
        Tc[i, 6] = s
        for j in range(Jx.shape[1]):
            s = 0.0
            for k in range(6):
                s += A[i, k] * Jx[k, j]
            Tc[i, 9 + j] = s
    for i in range(3):
        for j in range(3):
            Tc[i, j] = 1.0 if i == j else 0.0
            Tc[3 + i, j] = 0.0
            Tc[i, 3 + j] = 0.0
            Tc[3 + i, 3 + j] = R_ic[j, i]
        # Turning the board about world x (y) is turning the camera the other way about the board's origin.
        Tc[i, 7], Tc[i, 8] = -R_cw[i, 0], -R_cw[i, 1]
        Tc[3 + i, 7] = R_cw[i, 1] * p_wc[2] - R_cw[i, 2] * p_wc[1]
        Tc[3 + i, 8] = R_cw[i, 2] * p_wc[0] - R_cw[i, 0] * p_wc[2]


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
    """Node (through T) with the border and the gradient: side (15, B + 1)."""
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


@njit(cache=True, nogil=True)
def _add_border(G, D, Tc, cols_c, cols_d, border):
    n_b = border.shape[0] - 1
    nc, nd = len(cols_c), len(cols_d)
    full = np.zeros((nc, nc))
    _outer_add(Tc, G, Tc, full)
    for i in range(nc):
        a = cols_c[i]
        if a < 0:
            continue
        for j in range(nc):
            if cols_c[j] >= 0:
                border[a, cols_c[j]] += full[i, j]
        for j in range(nd + 1):
            b = n_b if j == nd else cols_d[j]
            if b >= 0:
                s = 0.0
                for k in range(6):
                    s += Tc[k, i] * G[k, 6 + j]
                border[a, b] += s
                border[b, a] += s
    for i in range(nd):
        a = cols_d[i]
        if a < 0:
            continue
        for j in range(nd):
            if cols_d[j] >= 0:
                border[a, cols_d[j]] += G[6 + i, 6 + j]
        border[a, n_b] += G[6 + i, D]
        border[n_b, a] += G[6 + i, D]


@njit(cache=True, nogil=True)
def accumulate(
    i0, i1, o, start, uv, point, keep, sigma, loss, scale, curved, field, precision, bloom, direction, basis, pars,
    predicted, valid, X, Jp, Jpar, noise, shared_noise, given, R_ic, p_ic, R_cw, p_wc, rate, vel, Jn, Jm, Jx,
    node, first, cols_c, cols_d, diagonal, upper, side, border, residual, root_out, shared_out,
):  # fmt: skip
    """Images i0..i1: residuals, weights and common errors out, and the normal equations where they are wanted.

    Returns half the robust chi^2, or with `given` noise the quadratic form of the common errors' own rows.
    """
    most = 0
    for i in range(i0, i1):
        most = max(most, start[i + 1] - start[i])
    has_bloom = 1 if direction.shape[0] > 0 else 0
    D = 6 + len(pars) + has_bloom + basis.shape[1]
    A = np.empty((D + 1, 2 * most))
    G = np.empty((D + 1, D + 1))
    Tn, Tm, Tc = np.empty((6, 15)), np.empty((6, 15 if Jm.shape[0] else 0)), np.empty((6, 9 + Jx.shape[2]))
    m = field.shape[1]
    error = np.empty((most, 2))
    total = 0.0
    for i in range(i0, i1):
        n0, n1 = start[i], start[i + 1]
        n = n1 - n0
        res, ok, root = residual[n0:n1], np.empty(n, np.bool_), root_out[n0:n1]
        for k in range(n):
            ok[k] = keep[n0 + k] and valid[n0 + k - o]
            for r in range(2):
                res[k, r] = predicted[n0 + k - o, r] - uv[n0 + k, r]
                if has_bloom:
                    res[k, r] += bloom * direction[n0 + k, r]
        f = field[n0:n1]
        cost = _robust_weights(res, ok, f, precision, sigma[i], loss, scale, root, shared_out[i])
        if not given:
            total += cost
        if diagonal.shape[0] == 0:
            continue
        _whole_error(res, f, shared_out[i], error)
        _fill_rows(
            o, n0, n1, error, root, sigma[i], loss, scale, curved, X, Jp, Jpar, pars, has_bloom, direction, basis,
            point, R_cw[i], A
        )  # fmt: skip
        if given:
            for k in range(n):
                A[D, k] = noise[n0 + k, 0] if ok[k] else 0.0
                A[D, n + k] = noise[n0 + k, 1] if ok[k] else 0.0
        _gram(A, D + 1, 2 * n, G)
        if m:
            quad = _marginalise_shared(A, D, n, root, f, precision, shared_noise[i], given, G)
            if given:
                total += quad
        if Jm.shape[0]:
            _chain(R_ic, p_ic, R_cw[i], p_wc[i], rate[i], vel[i], Jn[i], Jm[i], Jx[i], Tn, Tm, Tc)
        else:
            _chain(R_ic, p_ic, R_cw[i], p_wc[i], rate[i], vel[i], Jn[i], Jn[i], Jx[i], Tn, Tm, Tc)
        k = node[i] - first
        _outer_add(Tn, G, Tn, diagonal[k])
        _add_side(Tn, G, D, Tc, cols_c, cols_d, side[k])
        if Jm.shape[0]:
            _outer_add(Tn, G, Tm, upper[k])
            _outer_add(Tm, G, Tm, diagonal[k + 1])
            _add_side(Tm, G, D, Tc, cols_c, cols_d, side[k + 1])
        _add_border(G, D, Tc, cols_c, cols_d, border)
    return total


@njit(cache=True, nogil=True)
def accumulate_clusters(
    i0, i1, o, start, point, cluster, n_clusters, column, loss, curved, residual, root_all, shared, field, direction,
    basis, pars,
    X, Jp, Jpar, R_ic, p_ic, R_cw, p_wc, rate, vel, Jn, Jm, Jx, node, first, cols_c, cols_d, side, border,
):  # fmt: skip
    """Gradients of images i0..i1 by cluster of corners, into columns `column` and on of side and border."""
    most = 0
    for i in range(i0, i1):
        most = max(most, start[i + 1] - start[i])
    has_bloom = 1 if direction.shape[0] > 0 else 0
    D = 6 + len(pars) + has_bloom + basis.shape[1]
    A, error = np.empty((D + 1, 2 * most)), np.empty((most, 2))
    Tn, Tm, Tc = np.empty((6, 15)), np.empty((6, 15 if Jm.shape[0] else 0)), np.empty((6, 9 + Jx.shape[2]))
    G = np.empty((D, n_clusters))
    for i in range(i0, i1):
        n0, n1 = start[i], start[i + 1]
        n = n1 - n0
        _whole_error(residual[n0:n1], field[n0:n1], shared[i], error)
        _fill_rows(
            o, n0, n1, error, root_all[n0:n1], 1.0, loss, 1.0, curved, X, Jp, Jpar, pars, has_bloom, direction, basis,
            point,
            R_cw[i], A,
        )  # fmt: skip
        for d in range(D):
            for g in range(n_clusters):
                G[d, g] = 0.0
        for k in range(n):
            for d in range(D):
                G[d, cluster[n0 + k]] += A[d, k] * A[D, k] + A[d, n + k] * A[D, n + k]
        next_by = Jm[i] if Jm.shape[0] else Jn[i]
        _chain(R_ic, p_ic, R_cw[i], p_wc[i], rate[i], vel[i], Jn[i], next_by, Jx[i], Tn, Tm, Tc)
        k = node[i] - first
        for g in range(n_clusters):
            for d in range(6):
                f = G[d, g]
                for a in range(15):
                    side[k, a, column + g] += Tn[d, a] * f
                for a in range(Tm.shape[1]):
                    side[k + 1, a, column + g] += Tm[d, a] * f
                for a in range(len(cols_c)):
                    if cols_c[a] >= 0:
                        border[cols_c[a], column + g] += Tc[d, a] * f
            for a in range(len(cols_d)):
                if cols_d[a] >= 0:
                    border[cols_d[a], column + g] += G[6 + a, g]
