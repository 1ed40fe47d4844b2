"""Compiled back substitution for the elimination of keyframes and features (`front_kernels.py`)."""

from __future__ import annotations

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.blas import solve_upper
from icalib.optim.front_kernels import step_factors
from icalib.optim.state import KEYFRAME_DIM


@njit(cache=True, nogil=True)
def _solve_columns(U, X):
    """X (p, m) <- U^-1 X."""
    for j in range(X.shape[1]):
        solve_upper(U, X[:, j])


@njit(cache=True, nogil=True)
def substitute_all(plan, sizes, turn, workspace, calib, white, chain):
    """Back substitution: fills chain (n, 15, m), whose kept keyframe is an input.

    calib (B + 1, m): steps of the calibration parameters; last row: factor of the gradient. white (rows, m): further
    right-hand sides after forward substitution, by step: uncoupled, coupled, dying.
    """
    n_b, m, end = len(calib), calib.shape[1], len(white)
    solved = np.zeros((KEYFRAME_DIM + sizes.wide.max(), m))
    solved[KEYFRAME_DIM : KEYFRAME_DIM + n_b] = calib
    for g in range(len(plan.after) - 1, -1, -1):
        a, c = sizes.uncoupled[g], sizes.coupled[g]
        U, Ud, D, Wr, Wc = step_factors(g, sizes, n_b, workspace)
        begin = end - a - len(Wc)
        solved[:KEYFRAME_DIM] = 0.0
        if plan.after[g] >= 0:
            solved[:KEYFRAME_DIM] = chain[plan.after[g]]
        x = white[begin + a : end] - Wc @ solved[: Wc.shape[1]]
        _solve_columns(Ud, x[c:])
        z = np.empty((a + c, m))
        z[a:] = x[:c] - D @ x[c:]
        _solve_columns(U[a:, a:], z[a:])
        z[:a] = white[begin : begin + a] - Wr @ solved[: KEYFRAME_DIM + n_b]
        for i in range(a):
            for j in range(a, a + c):
                for k in range(m):
                    z[i, k] -= U[i, j] * z[j, k]
        _solve_columns(U[:a, :a], z[:a])
        _take_back(g, plan, n_b, x[c:], solved)
        _turn_back(g, plan, a, turn, z, chain)
        end = begin


@njit(cache=True, nogil=True)
def _take_back(g, plan, n_b, dying, solved):
    """Restores features to their slots before the step, in `solved`."""
    o = KEYFRAME_DIM + n_b
    for q in range(plan.dying.start[g], plan.dying.start[g + 1]):
        at, x = o + 3 * plan.dying.values[q], 3 * (q - plan.dying.start[g])
        solved[at : at + 3] = dying[x : x + 3]
    for q in range(plan.leave.start[g], plan.leave.start[g + 1]):
        a, b = o + 3 * plan.leave.values[q], o + 3 * plan.enter[q]
        solved[a : a + 3] = solved[b : b + 3]


@njit(cache=True, nogil=True)
def _turn_back(g, plan, uncoupled, turn, z, chain):
    """Fills the steps of the keyframes, rotated back to their own dimensions."""
    r, c, x = 0, uncoupled, np.empty((KEYFRAME_DIM, z.shape[1]))
    for q in range(plan.keyframes.start[g], plan.keyframes.start[g + 1]):
        k = plan.keyframes.values[q]
        n = plan.coupled[k]
        x[:n], x[n:] = z[c : c + n], z[r : r + KEYFRAME_DIM - n]
        c, r = c + n, r + KEYFRAME_DIM - n
        chain[k] = turn[k] @ x
