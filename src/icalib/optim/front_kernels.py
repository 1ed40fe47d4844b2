"""Compiled steps of the elimination of keyframes and features (`front.py`), in place in a front that fits the cache.

The front is the upper triangle over calibration parameters and features in slots; `carry` (15, 15 + .) what is left of
the keyframe that comes next: with itself, calibration parameters, features. Matrices are split into rows that meet no
feature ("rest") and those that do ("coupled"), and the former are eliminated first: of a keyframe that one camera sees
from, six dimensions of 15 meet any."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.blas import factorise, solve_transposed, solve_upper, subtract_gram, subtract_product
from icalib.optim.state import KEYFRAME_DIM, POSE_DIM


class FrontChain(NamedTuple):
    """Keyframes of the piece: diagonal, upper (n, 15, 15), side (n, 15, B + 1), the direction, and how each is turned:
    turn (n, 15, 15), its columns the new dimensions; pose and next_pose by these (I, 6, 15)."""

    diagonal: np.ndarray
    upper: np.ndarray
    side: np.ndarray
    forwards: bool
    turn: np.ndarray
    pose: np.ndarray
    next_pose: np.ndarray


class Sizes(NamedTuple):
    """Of each step (G,): rows that meet no feature, rows that do, those of features that die, columns of the front; and
    where its factors begin in the room (G + 1,)."""

    rest: np.ndarray
    coupled: np.ndarray
    dying: np.ndarray
    wide: np.ndarray
    start: np.ndarray


@njit(cache=True, nogil=True)
def _factors(g, sizes, n_b, room):
    """Views of step g: U of the keyframes, and of dying features; keyframes by these; rows of rest, and of all
    others."""
    a, c, d, w = sizes.rest[g], sizes.coupled[g], sizes.dying[g], sizes.wide[g]
    o, p = sizes.start[g], a + c
    U = room[o : o + p * p].reshape(p, p)
    o += p * p
    Ud = room[o : o + d * d].reshape(d, d)
    o += d * d
    D = room[o : o + c * d].reshape(c, d)
    o += c * d
    Wr = room[o : o + a * (KEYFRAME_DIM + n_b)].reshape(a, KEYFRAME_DIM + n_b)
    o += a * (KEYFRAME_DIM + n_b)
    return U, Ud, D, Wr, room[o : o + (c + d) * (KEYFRAME_DIM + w)].reshape(c + d, KEYFRAME_DIM + w)


@njit(cache=True, nogil=True)
def _mirror(v, first, M):
    """M <- (1 - 2 v v^T) M for a unit vector v, zeros before its element `first`."""
    for j in range(M.shape[1]):
        s = 0.0
        for i in range(first, len(v)):
            s += v[i] * M[i, j]
        for i in range(first, len(v)):
            M[i, j] -= 2.0 * s * v[i]


@njit(cache=True, nogil=True)
def _reflect(T, Q):
    """Q (15, 15), orthogonal: T Q has nothing but zeros behind its first rows' number of columns (Householder)."""
    A, v = T.T.copy(), np.empty(KEYFRAME_DIM)
    Q[:] = np.eye(KEYFRAME_DIM)
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
    """Turns every keyframe such that what meets features comes first."""
    n, seeing = len(turn), np.zeros(len(sums.keyframe), dtype=np.bool_)
    for e in range(len(sums.image)):
        seeing[sums.image[e]] = True
    rows, filled = np.zeros((n, KEYFRAME_DIM, KEYFRAME_DIM)), np.zeros(n, dtype=np.int64)
    for i in range(len(sums.keyframe)):
        k = sums.keyframe[i]
        if seeing[i] and plan.coupled[k] < KEYFRAME_DIM:
            rows[k, filled[k] : filled[k] + POSE_DIM] = sums.pose[i]
            filled[k] += POSE_DIM
    for k in range(n):
        turn[k] = np.eye(KEYFRAME_DIM)
        if filled[k]:
            _reflect(rows[k, : filled[k]], turn[k])
    for i in range(len(sums.keyframe)):
        pose[i] = sums.pose[i] @ turn[sums.keyframe[i]]
    for i in range(len(next_pose)):
        next_pose[i] = sums.next_pose[i]


@njit(cache=True, nogil=True)
def _join(g, plan, sums, n_b, front, carry, old_wide):
    """Features move, and others join."""
    for q in range(plan.leave.start[g], plan.leave.start[g + 1]):
        a, b = n_b + 3 * plan.leave.values[q], n_b + 3 * plan.enter[q]
        # Columns of a row lie side by side, rows do not: all three of a feature at a time.
        for x in range(old_wide):
            if b <= x < b + 3 or a <= x < a + 3:
                continue
            for i in range(3):
                front[min(b + i, x), max(b + i, x)] = front[min(a + i, x), max(a + i, x)]
        for i in range(3):
            for j in range(i, 3):
                front[b + i, b + j] = front[a + i, a + j]
            carry[:, KEYFRAME_DIM + b + i] = carry[:, KEYFRAME_DIM + a + i]
    wide = n_b + 3 * plan.alive[g]
    for q in range(plan.born.start[g], plan.born.start[g + 1]):
        f, a = plan.born.values[q], n_b + 3 * plan.born_at[q]
        front[:a, a : a + 3] = 0.0
        front[a : a + 3, a:wide] = 0.0
        carry[:, KEYFRAME_DIM + a : KEYFRAME_DIM + a + 3] = 0.0
    for q in range(plan.born.start[g], plan.born.start[g + 1]):
        f, a = plan.born.values[q], n_b + 3 * plan.born_at[q]
        for i in range(3):
            for j in range(i, 3):
                front[a + i, a + j] += sums.own[f, i, j]
        for j in range(n_b):
            for i in range(3):
                front[j, a + i] += sums.side[f, i, j]


@njit(cache=True, nogil=True)
def _places(g, plan, rest, row):
    """row (K, 15): where each dimension of the step's keyframes stands, rest first."""
    r, c = 0, rest
    for q in range(plan.keyframes.start[g], plan.keyframes.start[g + 1]):
        k = plan.keyframes.values[q]
        for j in range(KEYFRAME_DIM):
            if j < plan.coupled[k]:
                row[k, j] = c
                c += 1
            else:
                row[k, j] = r
                r += 1


@njit(cache=True, nogil=True)
def _fill_keyframes(g, plan, chain, row, U, Wr, Wc):
    """Adds the sums of the step's keyframes, each turned by its Q, to U, Wr and Wc.

    U (a + c, a + c), upper triangle: the keyframes with one another. Wr (a, .), Wc (c + d, .): the a rest rows and the
    c coupled ones (then the d of dying features) by columns: 15 of the keyframe after, calib, gradient, and features in
    Wc. row (K, 15): see `_places`. q counts the step's keyframes, k those of the piece."""
    a, n_b, last = len(Wr), chain.side.shape[2], plan.keyframes.start[g + 1] - 1
    for q in range(plan.keyframes.start[g], last + 1):
        k = plan.keyframes.values[q]
        Q = chain.turn[k]
        own, side = Q.T @ chain.diagonal[k] @ Q, Q.T @ chain.side[k]
        after = plan.keyframes.values[q + 1] if q < last else plan.after[g]
        link = np.zeros((KEYFRAME_DIM, KEYFRAME_DIM))
        if after >= 0:
            link = Q.T @ (chain.upper[k] if chain.forwards else chain.upper[after].T.copy())
        if q < last:
            link = link @ chain.turn[after]
        for i in range(KEYFRAME_DIM):
            x = row[k, i]
            into = Wr[x] if x < a else Wc[x - a]
            for j in range(n_b):
                into[KEYFRAME_DIM + j] += side[i, j]
            for j in range(KEYFRAME_DIM):
                if row[k, j] >= x:
                    U[x, row[k, j]] += own[i, j]
                if q == last:
                    into[j] += link[i, j]
                else:
                    y = row[after, j]
                    U[min(x, y), max(x, y)] += link[i, j]


@njit(cache=True, nogil=True)
def _fill_carry(g, plan, row, carry, U, Wc, rest):
    """What the step before left of the first keyframe."""
    k = plan.keyframes.values[plan.keyframes.start[g]]
    x = row[k, 0]
    for i in range(KEYFRAME_DIM):
        for j in range(i, KEYFRAME_DIM):
            U[x + i, x + j] += carry[i, j]
        Wc[x - rest + i, KEYFRAME_DIM:] += carry[i, KEYFRAME_DIM : Wc.shape[1]]


@njit(cache=True, nogil=True)
def _add_pose(T, n, block, rows, column, into):
    """into[rows:rows + n, column:column + 3] += (block T)^T, T (6, 15) its first n columns."""
    for j in range(POSE_DIM):
        for k in range(n):
            f = T[j, k]
            for i in range(3):
                into[rows + k, column + i] += f * block[i, j]


@njit(cache=True, nogil=True)
def _fill_pairs(g, plan, sums, chain, row, rest, n_b, Wc, carry):
    """Features in the front with the step's keyframes, and with the one after (carry)."""
    here, after = plan.keyframes.start[g + 1] > plan.keyframes.start[g], plan.after[g]
    for q in range(plan.pair.start[g], plan.pair.start[g + 1]):
        e, column = plan.pair.values[q], KEYFRAME_DIM + n_b + 3 * plan.pair_at[q]
        i = sums.image[e]
        k = sums.keyframe[i]
        if k == after or not here:
            _add_pose(chain.pose[i], KEYFRAME_DIM, sums.block[e], 0, column, carry)
        else:
            _add_pose(chain.pose[i], plan.coupled[k], sums.block[e], row[k, 0] - rest, column, Wc)
        if len(chain.next_pose):
            if k + 1 == after or not here:
                _add_pose(chain.next_pose[i], KEYFRAME_DIM, sums.block[e], 0, column, carry)
            else:
                _add_pose(chain.next_pose[i], KEYFRAME_DIM, sums.block[e], row[k + 1, 0] - rest, column, Wc)


@njit(cache=True, nogil=True)
def _eliminate_local(g, plan, sums, chain, row, rest, U, Wc, front, coupled):
    """Features that this step alone sees. False: not definite."""
    n, n_b = plan.local.start[g + 1] - plan.local.start[g], sums.side.shape[2]
    V, own, used = np.zeros((3 * n, coupled + n_b)), np.empty((3, 3)), 0
    for q in range(n):
        at = plan.local.start[g] + q
        f, rows = plan.local.values[at], V[3 * q : 3 * q + 3]
        for p in range(plan.local_start[at], plan.local_start[at + 1]):
            e = plan.local_pair[p]
            i = sums.image[e]
            k = sums.keyframe[i]
            begin = row[k, 0] - rest
            for a in range(3):
                for j in range(POSE_DIM):
                    w = sums.block[e, a, j]
                    for b in range(plan.coupled[k]):
                        rows[a, begin + b] += w * chain.pose[i, j, b]
        for a in range(3):
            for j in range(n_b):
                rows[a, coupled + j] = sums.side[f, a, j]
                if j < n_b - 1 and rows[a, coupled + j] != 0.0:
                    used = max(used, j + 1)
        own[:] = sums.own[f]
        if not factorise(own):
            return False
        solve_transposed(own, rows)
    subtract_gram(V[:, :coupled], U[rest:, rest:])
    # Of the calibration parameters features meet the `used` columns at most, and the gradient.
    here, gradient, last = V[:, coupled : coupled + used], V[:, coupled + n_b - 1 :], KEYFRAME_DIM + n_b
    subtract_product(V[:, :coupled], here, Wc[:coupled, KEYFRAME_DIM : KEYFRAME_DIM + used])
    subtract_product(V[:, :coupled], gradient, Wc[:coupled, last - 1 : last])
    subtract_gram(here, front[:used, :used])
    subtract_product(here, gradient, front[:used, n_b - 1 : n_b])
    subtract_gram(gradient, front[n_b - 1 : n_b, n_b - 1 : n_b])
    return True


@njit(cache=True, nogil=True)
def _eliminate_keyframes(U, Wr, Wc, carry, front):
    """Takes the step's keyframes out of what comes next, but for the front, which is left to `_eliminate_dying`."""
    a, c, thin = len(Wr), len(U) - len(Wr), Wr.shape[1]
    if not factorise(U):
        return False
    solve_transposed(U[:a, :a], Wr)
    subtract_product(U[:a, a:], Wr, Wc[:c, :thin])
    solve_transposed(U[a:, a:], Wc[:c])
    subtract_product(Wr[:, :KEYFRAME_DIM], Wr, carry[:, :thin])
    subtract_product(Wc[:c, :KEYFRAME_DIM], Wc[:c], carry[:, : Wc.shape[1]])
    subtract_gram(Wr[:, KEYFRAME_DIM:], front[: thin - KEYFRAME_DIM, : thin - KEYFRAME_DIM])
    return True


@njit(cache=True, nogil=True)
def _eliminate_dying(g, plan, n_b, c, Ud, D, Wc, carry, front):
    """Takes dying features out of what comes next, and these and the keyframes out of the front. False: not
    definite."""
    dying, W, wide = (
        plan.dying.values[plan.dying.start[g] : plan.dying.start[g + 1]],
        Wc[c:],
        Wc.shape[1] - KEYFRAME_DIM,
    )
    for q in range(len(dying)):
        o = n_b + 3 * dying[q]
        for y in range(o):
            for i in range(3):
                W[3 * q + i, KEYFRAME_DIM + y] = front[y, o + i]
        for i in range(3):
            f, x = o + i, 3 * q + i
            W[x, :KEYFRAME_DIM] = carry[:, KEYFRAME_DIM + f]
            W[x, KEYFRAME_DIM + o : KEYFRAME_DIM + f] = front[o:f, f]
            W[x, KEYFRAME_DIM + f :] = front[f, f:wide]
            D[:, x] = Wc[:c, KEYFRAME_DIM + f]
    subtract_product(D, Wc[:c, KEYFRAME_DIM:], W[:, KEYFRAME_DIM:])
    for q in range(len(dying)):
        for i in range(3):
            f, x = KEYFRAME_DIM + n_b + 3 * dying[q] + i, 3 * q + i
            Ud[:, x] = W[:, f]
            Wc[:, f] = 0.0
    if not factorise(Ud):
        return False
    solve_transposed(Ud, W)
    subtract_product(W[:, :KEYFRAME_DIM], W, carry[:, : Wc.shape[1]])
    subtract_gram(Wc[:, KEYFRAME_DIM:], front[:wide, :wide])
    return True


@njit(cache=True, nogil=True)
def eliminate_all(plan, sizes, sums, chain, room, front, carry):
    """All steps; their factors are left in `room`, the kept keyframe's sums in `carry`, the calibration parameters' in
    `front`. False: not definite."""
    n_b, old_wide = chain.side.shape[2], 0
    row = np.zeros((len(chain.diagonal), KEYFRAME_DIM), dtype=np.int64)
    for g in range(len(plan.after)):
        a, c = sizes.rest[g], sizes.coupled[g]
        U, Ud, D, Wr, Wc = _factors(g, sizes, n_b, room)
        _join(g, plan, sums, n_b, front, carry, old_wide)
        old_wide = sizes.wide[g]
        if a + c:
            U[:], Wr[:], Wc[:] = 0.0, 0.0, 0.0
            _places(g, plan, a, row)
            _fill_keyframes(g, plan, chain, row, U, Wr, Wc)
            _fill_carry(g, plan, row, carry, U, Wc, a)
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


@njit(cache=True, nogil=True)
def _solve_columns(U, X):
    """X (p, m) <- U^-1 X."""
    for j in range(X.shape[1]):
        solve_upper(U, X[:, j])


@njit(cache=True, nogil=True)
def substitute_all(plan, sizes, turn, room, calib, white, chain):
    """Fills `chain` (n, 15, m), of which the kept keyframe is given, from calib (B + 1, m), its last row what the
    gradient counts; white (rows, m): what stands on the right beside the gradient, by step: rest, coupled, dying."""
    n_b, m, end = len(calib), calib.shape[1], len(white)
    known = np.zeros((KEYFRAME_DIM + sizes.wide.max(), m))
    known[KEYFRAME_DIM : KEYFRAME_DIM + n_b] = calib
    for g in range(len(plan.after) - 1, -1, -1):
        a, c = sizes.rest[g], sizes.coupled[g]
        U, Ud, D, Wr, Wc = _factors(g, sizes, n_b, room)
        begin = end - a - len(Wc)
        known[:KEYFRAME_DIM] = 0.0
        if plan.after[g] >= 0:
            known[:KEYFRAME_DIM] = chain[plan.after[g]]
        x = white[begin + a : end] - Wc @ known[: Wc.shape[1]]
        _solve_columns(Ud, x[c:])
        z = np.empty((a + c, m))
        z[a:] = x[:c] - D @ x[c:]
        _solve_columns(U[a:, a:], z[a:])
        z[:a] = white[begin : begin + a] - Wr @ known[: KEYFRAME_DIM + n_b]
        for i in range(a):
            for j in range(a, a + c):
                for k in range(m):
                    z[i, k] -= U[i, j] * z[j, k]
        _solve_columns(U[:a, :a], z[:a])
        _take_back(g, plan, n_b, x[c:], known)
        _turn_back(g, plan, a, turn, z, chain)
        end = begin


@njit(cache=True, nogil=True)
def _take_back(g, plan, n_b, dying, known):
    """Features in the slots that they had at the end of the step before."""
    o = KEYFRAME_DIM + n_b
    for q in range(plan.dying.start[g], plan.dying.start[g + 1]):
        at, x = o + 3 * plan.dying.values[q], 3 * (q - plan.dying.start[g])
        known[at : at + 3] = dying[x : x + 3]
    for q in range(plan.leave.start[g], plan.leave.start[g + 1]):
        a, b = o + 3 * plan.leave.values[q], o + 3 * plan.enter[q]
        known[a : a + 3] = known[b : b + 3]


@njit(cache=True, nogil=True)
def _turn_back(g, plan, rest, turn, z, chain):
    """Steps of the keyframes, in their own dimensions."""
    r, c, x = 0, rest, np.empty((KEYFRAME_DIM, z.shape[1]))
    for q in range(plan.keyframes.start[g], plan.keyframes.start[g + 1]):
        k = plan.keyframes.values[q]
        n = plan.coupled[k]
        x[:n], x[n:] = z[c : c + n], z[r : r + KEYFRAME_DIM - n]
        c, r = c + n, r + KEYFRAME_DIM - n
        chain[k] = turn[k] @ x
