"""Compiled elimination steps of keyframes and features (`front.py`), in place in a front that fits the cache.

The front is the upper triangle over calibration parameters and the features in its slots. A keyframe has D dimensions,
15 if the rig has one IMU. `carry` (D, D + .) is the remaining system of the next keyframe: with itself, calibration
parameters, features. The rows of keyframes are rotated so that some of them involve no feature ("uncoupled"), and the
others do ("coupled"). Uncoupled rows are eliminated first. A keyframe with images of one camera has six coupled
dimensions.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.blas import factorise, solve_transposed, subtract_gram, subtract_product


class FrontChain(NamedTuple):
    """Keyframes of the piece. diagonal, upper (n, D, D), side (n, D, B + 1): sums; forwards: direction of the
    elimination; turn (n, D, D): orthogonal, its columns are the rotated dimensions; pose and next_pose (I, p, D):
    Jacobians of image poses by the rotated dimensions."""

    diagonal: np.ndarray
    upper: np.ndarray
    side: np.ndarray
    forwards: bool
    turn: np.ndarray
    pose: np.ndarray
    next_pose: np.ndarray


class Sizes(NamedTuple):
    """Sizes of each step (G,): uncoupled rows, coupled rows, rows of features that leave (dying), columns of the front;
    start (G + 1,): of its factors in the workspace."""

    uncoupled: np.ndarray
    coupled: np.ndarray
    dying: np.ndarray
    wide: np.ndarray
    start: np.ndarray


@njit(cache=True, nogil=True)
def step_factors(g, sizes, dim, n_b, workspace):
    """Views of the factors of step g in the workspace `workspace`, of keyframes with `dim` dimensions: U (keyframes),
    Ud (dying features), D (coupled
    keyframe rows by dying features), Wr (uncoupled rows), Wc (coupled rows, then dying features)."""
    a, c, d, w = sizes.uncoupled[g], sizes.coupled[g], sizes.dying[g], sizes.wide[g]
    o, p = sizes.start[g], a + c
    U = workspace[o : o + p * p].reshape(p, p)
    o += p * p
    Ud = workspace[o : o + d * d].reshape(d, d)
    o += d * d
    D = workspace[o : o + c * d].reshape(c, d)
    o += c * d
    Wr = workspace[o : o + a * (dim + n_b)].reshape(a, dim + n_b)
    o += a * (dim + n_b)
    return U, Ud, D, Wr, workspace[o : o + (c + d) * (dim + w)].reshape(c + d, dim + w)


@njit(cache=True, nogil=True)
def _mirror(v, first, M):
    """Householder reflection M <- (1 - 2 v v^T) M for a unit vector v that is zero before element `first`."""
    for j in range(M.shape[1]):
        s = 0.0
        for i in range(first, len(v)):
            s += v[i] * M[i, j]
        for i in range(first, len(v)):
            M[i, j] -= 2.0 * s * v[i]


@njit(cache=True, nogil=True)
def _reflect(T, Q):
    """Fills Q (D, D), orthogonal, such that T Q is zero beyond its first len(T) columns (Householder QR of T^T)."""
    A, v = T.T.copy(), np.empty(len(Q))
    Q[:] = np.eye(len(Q))
    for k in range(A.shape[1]):
        norm = np.sqrt((A[k:, k] ** 2).sum())
        if norm == 0.0:
            continue
        v[:] = 0.0
        v[k:] = A[k:, k]
        v[k] += norm if v[k] > 0.0 else -norm
        v /= np.sqrt((v**2).sum())
        _mirror(v, k, A)
        _mirror(v, k, Q.T)


@njit(cache=True, nogil=True)
def rotate_keyframes(plan, sums, turn, pose, next_pose):
    """Fills the rotation of every keyframe that puts its coupled dimensions first, and the image poses by rotated
    dimensions."""
    n, dim, p, seeing = len(turn), turn.shape[1], sums.pose.shape[1], np.zeros(len(sums.keyframe), dtype=np.bool_)
    for e in range(len(sums.image)):
        seeing[sums.image[e]] = True
    rows, filled = np.zeros((n, dim, dim)), np.zeros(n, dtype=np.int64)
    for i in range(len(sums.keyframe)):
        k = sums.keyframe[i]
        if seeing[i] and plan.coupled[k] < dim:
            rows[k, filled[k] : filled[k] + p] = sums.pose[i]
            filled[k] += p
    for k in range(n):
        turn[k] = np.eye(dim)
        if filled[k]:
            _reflect(rows[k, : filled[k]], turn[k])
    for i in range(len(sums.keyframe)):
        pose[i] = sums.pose[i] @ turn[sums.keyframe[i]]
    for i in range(len(next_pose)):
        next_pose[i] = sums.next_pose[i]


@njit(cache=True, nogil=True)
def _join(g, plan, sums, n_b, front, carry, old_wide):
    """Moves features to other slots of the front, and adds those that join."""
    dim = len(carry)
    for q in range(plan.leave.start[g], plan.leave.start[g + 1]):
        a, b = n_b + 3 * plan.leave.values[q], n_b + 3 * plan.enter[q]
        # Rows are contiguous, columns are not: all three columns of a feature are moved together.
        for x in range(old_wide):
            if b <= x < b + 3 or a <= x < a + 3:
                continue
            for i in range(3):
                front[min(b + i, x), max(b + i, x)] = front[min(a + i, x), max(a + i, x)]
        for i in range(3):
            for j in range(i, 3):
                front[b + i, b + j] = front[a + i, a + j]
            carry[:, dim + b + i] = carry[:, dim + a + i]
    wide = n_b + 3 * plan.alive[g]
    for q in range(plan.born.start[g], plan.born.start[g + 1]):
        f, a = plan.born.values[q], n_b + 3 * plan.born_at[q]
        front[:a, a : a + 3] = 0.0
        front[a : a + 3, a:wide] = 0.0
        carry[:, dim + a : dim + a + 3] = 0.0
    for q in range(plan.born.start[g], plan.born.start[g + 1]):
        f, a = plan.born.values[q], n_b + 3 * plan.born_at[q]
        for i in range(3):
            for j in range(i, 3):
                front[a + i, a + j] += sums.diagonal[f, i, j]
        for j in range(n_b):
            for i in range(3):
                front[j, a + i] += sums.side[f, i, j]


@njit(cache=True, nogil=True)
def _places(g, plan, uncoupled, row):
    """Fills row (K, D) with the row index of each dimension of the step's keyframes, uncoupled rows first."""
    r, c = 0, uncoupled
    for q in range(plan.keyframes.start[g], plan.keyframes.start[g + 1]):
        k = plan.keyframes.values[q]
        for j in range(row.shape[1]):
            if j < plan.coupled[k]:
                row[k, j] = c
                c += 1
            else:
                row[k, j] = r
                r += 1


@njit(cache=True, nogil=True)
def _fill_keyframes(g, plan, chain, row, U, Wr, Wc):
    """Adds the sums of the step's keyframes, each rotated by its Q, to U, Wr and Wc.

    U (a + c, a + c), upper triangle: the keyframes with one another. Wr (a, .), Wc (c + d, .): the a uncoupled rows,
    and the c coupled rows followed by d rows of dying features. Their columns: D of the next keyframe, calibration
    parameters, gradient, and features (Wc only). row (K, D): see `_places`. q counts the step's keyframes, k those of
    the piece.
    """
    a, dim, n_b, last = len(Wr), row.shape[1], chain.side.shape[2], plan.keyframes.start[g + 1] - 1
    for q in range(plan.keyframes.start[g], last + 1):
        k = plan.keyframes.values[q]
        Q = chain.turn[k]
        rotated, side = Q.T @ chain.diagonal[k] @ Q, Q.T @ chain.side[k]
        after = plan.keyframes.values[q + 1] if q < last else plan.after[g]
        link = np.zeros((dim, dim))
        if after >= 0:
            link = Q.T @ (chain.upper[k] if chain.forwards else chain.upper[after].T.copy())
        if q < last:
            link = link @ chain.turn[after]
        for i in range(dim):
            x = row[k, i]
            into = Wr[x] if x < a else Wc[x - a]
            for j in range(n_b):
                into[dim + j] += side[i, j]
            for j in range(dim):
                if row[k, j] >= x:
                    U[x, row[k, j]] += rotated[i, j]
                if q == last:
                    into[j] += link[i, j]
                else:
                    y = row[after, j]
                    U[min(x, y), max(x, y)] += link[i, j]


@njit(cache=True, nogil=True)
def _fill_carry(g, plan, row, carry, U, Wc, uncoupled):
    """Adds the remaining system of the step's first keyframe that the step before left."""
    k = plan.keyframes.values[plan.keyframes.start[g]]
    x, dim = row[k, 0], row.shape[1]
    for i in range(dim):
        for j in range(i, dim):
            U[x + i, x + j] += carry[i, j]
        Wc[x - uncoupled + i, dim:] += carry[i, dim : Wc.shape[1]]


@njit(cache=True, nogil=True)
def _add_pose(T, n, block, rows, column, into):
    """Adds (block T)^T to into[rows:rows + n, column:column + 3], with the first n columns of T (p, D)."""
    for j in range(len(T)):
        for k in range(n):
            f = T[j, k]
            for i in range(3):
                into[rows + k, column + i] += f * block[i, j]


@njit(cache=True, nogil=True)
def _fill_pairs(g, plan, sums, chain, row, uncoupled, n_b, Wc, carry):
    """Adds the terms of features in the front with the step's keyframes, and with the next one (carry)."""
    dim = row.shape[1]
    has_keyframes, after = plan.keyframes.start[g + 1] > plan.keyframes.start[g], plan.after[g]
    for q in range(plan.pair.start[g], plan.pair.start[g + 1]):
        e, column = plan.pair.values[q], dim + n_b + 3 * plan.pair_at[q]
        i = sums.image[e]
        k = sums.keyframe[i]
        if k == after or not has_keyframes:
            _add_pose(chain.pose[i], dim, sums.block[e], 0, column, carry)
        else:
            _add_pose(chain.pose[i], plan.coupled[k], sums.block[e], row[k, 0] - uncoupled, column, Wc)
        if len(chain.next_pose):
            if k + 1 == after or not has_keyframes:
                _add_pose(chain.next_pose[i], dim, sums.block[e], 0, column, carry)
            else:
                _add_pose(chain.next_pose[i], dim, sums.block[e], row[k + 1, 0] - uncoupled, column, Wc)


@njit(cache=True, nogil=True)
def _eliminate_local(g, plan, sums, chain, row, uncoupled, U, Wc, front, coupled):
    """Eliminates features that only this step sees. Returns False if they are not positive definite."""
    n, n_b = plan.local.start[g + 1] - plan.local.start[g], sums.side.shape[2]
    V, block, used = np.zeros((3 * n, coupled + n_b)), np.empty((3, 3)), 0
    for q in range(n):
        at = plan.local.start[g] + q
        f, rows = plan.local.values[at], V[3 * q : 3 * q + 3]
        for p in range(plan.local_start[at], plan.local_start[at + 1]):
            e = plan.local_pair[p]
            i = sums.image[e]
            k = sums.keyframe[i]
            begin = row[k, 0] - uncoupled
            for a in range(3):
                for j in range(sums.block.shape[2]):
                    w = sums.block[e, a, j]
                    for b in range(plan.coupled[k]):
                        rows[a, begin + b] += w * chain.pose[i, j, b]
        for a in range(3):
            for j in range(n_b):
                rows[a, coupled + j] = sums.side[f, a, j]
                if j < n_b - 1 and rows[a, coupled + j] != 0.0:
                    used = max(used, j + 1)
        block[:] = sums.diagonal[f]
        if not factorise(block):
            return False
        solve_transposed(block, rows)
    subtract_gram(V[:, :coupled], U[uncoupled:, uncoupled:])
    # Features depend on the first `used` calibration columns at most, and on the gradient.
    coupled_calib, gradient, dim = V[:, coupled : coupled + used], V[:, coupled + n_b - 1 :], row.shape[1]
    last = dim + n_b
    subtract_product(V[:, :coupled], coupled_calib, Wc[:coupled, dim : dim + used])
    subtract_product(V[:, :coupled], gradient, Wc[:coupled, last - 1 : last])
    subtract_gram(coupled_calib, front[:used, :used])
    subtract_product(coupled_calib, gradient, front[:used, n_b - 1 : n_b])
    subtract_gram(gradient, front[n_b - 1 : n_b, n_b - 1 : n_b])
    return True


@njit(cache=True, nogil=True)
def _eliminate_keyframes(U, Wr, Wc, carry, front):
    """Eliminates the step's keyframes from the following ones; coupled rows are subtracted from the front in
    `_eliminate_dying`. Returns False if they are not positive definite."""
    a, c, thin, dim = len(Wr), len(U) - len(Wr), Wr.shape[1], len(carry)
    if not factorise(U):
        return False
    solve_transposed(U[:a, :a], Wr)
    subtract_product(U[:a, a:], Wr, Wc[:c, :thin])
    solve_transposed(U[a:, a:], Wc[:c])
    subtract_product(Wr[:, :dim], Wr, carry[:, :thin])
    subtract_product(Wc[:c, :dim], Wc[:c], carry[:, : Wc.shape[1]])
    subtract_gram(Wr[:, dim:], front[: thin - dim, : thin - dim])
    return True


@njit(cache=True, nogil=True)
def _eliminate_dying(g, plan, n_b, c, Ud, D, Wc, carry, front):
    """Eliminates dying features, and subtracts these and the coupled rows from the front. Returns False if they are not
    positive definite."""
    dying, W, dim = plan.dying.values[plan.dying.start[g] : plan.dying.start[g + 1]], Wc[c:], len(carry)
    wide = Wc.shape[1] - dim
    for q in range(len(dying)):
        o = n_b + 3 * dying[q]
        for y in range(o):
            for i in range(3):
                W[3 * q + i, dim + y] = front[y, o + i]
        for i in range(3):
            f, x = o + i, 3 * q + i
            W[x, :dim] = carry[:, dim + f]
            W[x, dim + o : dim + f] = front[o:f, f]
            W[x, dim + f :] = front[f, f:wide]
            D[:, x] = Wc[:c, dim + f]
    subtract_product(D, Wc[:c, dim:], W[:, dim:])
    for q in range(len(dying)):
        for i in range(3):
            f, x = dim + n_b + 3 * dying[q] + i, 3 * q + i
            Ud[:, x] = W[:, f]
            Wc[:, f] = 0.0
    if not factorise(Ud):
        return False
    solve_transposed(Ud, W)
    subtract_product(W[:, :dim], W, carry[:, : Wc.shape[1]])
    subtract_gram(Wc[:, dim:], front[:wide, :wide])
    return True


@njit(cache=True, nogil=True)
def eliminate_all(plan, sizes, sums, chain, workspace, front, carry):
    """Eliminates the groups of keyframes of a piece one after the other, with the features that no later group sees.

    Factors remain in `workspace`, the system of the kept keyframe in `carry`, that of the calibration parameters in
    `front`. Returns False if the sums are not positive definite.
    """
    n_b, dim, old_wide = chain.side.shape[2], chain.side.shape[1], 0
    row = np.zeros((len(chain.diagonal), dim), dtype=np.int64)
    for g in range(len(plan.after)):
        a, c = sizes.uncoupled[g], sizes.coupled[g]
        U, Ud, D, Wr, Wc = step_factors(g, sizes, dim, n_b, workspace)
        _join(g, plan, sums, n_b, front, carry, old_wide)
        old_wide = sizes.wide[g]
        if a + c:
            U[:], Wr[:], Wc[:] = 0.0, 0.0, 0.0
            _places(g, plan, a, row)
            _fill_keyframes(g, plan, chain, row, U, Wr, Wc)
            _fill_carry(g, plan, row, carry, U, Wc, a)  # what the previous step left
            carry[:] = 0.0
        _fill_pairs(g, plan, sums, chain, row, a, n_b, Wc, carry)
        if a + c:
            if not _eliminate_local(g, plan, sums, chain, row, a, U, Wc, front, c):
                return False
            if not _eliminate_keyframes(U, Wr, Wc, carry, front):
                return False
        if not _eliminate_dying(g, plan, n_b, c, Ud, D, Wc, carry, front):
            return False
    return True
