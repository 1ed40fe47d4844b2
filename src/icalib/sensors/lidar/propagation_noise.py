"""What the gyroscope's noise between a keyframe and the bins that hang on it takes from what a LiDAR tells.

A bin is where the readings carry the keyframe, and these have noise: on the way it turns the IMU by an angle that walks
away from nothing. On one side of a keyframe that walk is taken for one unknown turn x, N(0, I), by which a bin is
turned as far as the walk gets there: `walked` x. |x|^2 is added to the chi^2, and the best x taken: with H = J^T J and
u = J^T (J_all, r) of x, summed over the bins, u^T (I + H)^-1 u is taken off the normal equations. J is that of the
state that a pass starts from: were it taken anew, the cost would draw to where noise explains more.

In 12 ms an industrial IMU loses less than a spinning LiDAR sees. A ten times noisier one loses as much: the LiDAR would
be believed more than it can be, and rotations be off by 1.6 times what is said of them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry.small import cholesky

POSE, PLANE = 6, 3


class Walk(NamedTuple):
    """Sums over bins on one side of a keyframe, by the unknown turn: information (3, 3); by_pose (3, w + 1), with the w
    keyframes and columns that act through the pose, and with the residual; by_plane (P, 3, 3), with the columns of each
    plane, of which those in `met` (P,) are not empty, `n_met` (1,) of them."""

    information: np.ndarray
    by_pose: np.ndarray
    by_plane: np.ndarray
    met: np.ndarray
    n_met: np.ndarray


@njit(cache=True, nogil=True, inline="always")
def no_walk(width, n_planes):
    """No bin yet."""
    nothing = np.zeros((n_planes, 3, PLANE))
    return Walk(
        np.zeros((3, 3)), np.zeros((3, width + 1)), nothing, np.zeros(n_planes, np.int64), np.zeros(1, np.int64)
    )


@njit(cache=True, nogil=True, inline="always")
def add_entry(turned, slope, row, B, by_pose, walk):
    """One plane in a bin: turned (3, 4), slope (3,) as in `Bins`; row (4,) its whitened residuals; B (>= 6, 4) their
    derivatives by the bin's pose first, of which by_pose (3, 6) gathers what they share with the turn."""
    last = walk.by_pose.shape[1] - 1
    for a in range(3):
        walk.by_pose[a, last] += slope[a]
        for c in range(4):
            d = turned[a, c]
            walk.by_pose[a, last] += d * row[c]
            for b in range(3):
                walk.information[a, b] += d * turned[b, c]
            for j in range(POSE):
                by_pose[a, j] += d * B[j, c]


@njit(cache=True, nogil=True, inline="always")
def add_pose(by_pose, T, walk):
    """What a bin's entries gathered, T (6, w) its pose by keyframes and columns."""
    for a in range(3):
        for j in range(POSE):
            for i in range(T.shape[1]):
                walk.by_pose[a, i] += by_pose[a, j] * T[j, i]


@njit(cache=True, nogil=True, inline="always")
def add_plane(turned, B, q, walk):
    """Plane q in a bin, B (10, 4) with the derivatives by the plane after those by the pose."""
    known = False
    for i in range(walk.n_met[0]):
        known = known or walk.met[i] == q
    if not known:
        walk.met[walk.n_met[0]] = q
        walk.n_met[0] += 1
    for a in range(3):
        for t in range(PLANE):
            for c in range(4):
                walk.by_plane[q, a, t] += turned[a, c] * B[POSE + t, c]


@njit(cache=True, nogil=True, inline="always")
def columns_of(walk, columns, of_plane):
    """(m,) calibration columns of what was summed: `columns` (c,), which act through the pose, then those of the
    planes, of_plane (P, 3)."""
    n_c, n = len(columns), walk.n_met[0]
    own = np.empty(n_c + PLANE * n, np.int64)
    for j in range(n_c):  # in loops: copies of arrays take seconds to compile
        own[j] = columns[j]
    for i in range(n):
        for t in range(PLANE):
            own[n_c + PLANE * i + t] = of_plane[walk.met[i], t]
    return own


@njit(cache=True, nogil=True, inline="always")
def taken_off(walk):
    """V (3, w + 3 n + 1): V^T V is the Schur term of the walk's three unknowns, to be subtracted from the normal
    equations. Columns: keyframes, calibration parameters in the order of `columns_of` (n planes met), residual. Resets
    the walk."""
    n, width, L = walk.n_met[0], walk.by_pose.shape[1] - 1, walk.information
    last = width + PLANE * n
    V = np.empty((3, last + 1))
    for a in range(3):
        for j in range(width):
            V[a, j] = walk.by_pose[a, j]
        V[a, last] = walk.by_pose[a, width]
        for i in range(n):
            for t in range(PLANE):
                V[a, width + PLANE * i + t] = walk.by_plane[walk.met[i], a, t]
        L[a, a] += 1.0
    cholesky(L)
    for a in range(3):
        for j in range(last + 1):
            for b in range(a):
                V[a, j] -= L[a, b] * V[b, j]
            V[a, j] /= L[a, a]
    for i in range(n):
        walk.by_plane[walk.met[i]] = 0.0
    walk.information[:], walk.by_pose[:] = 0.0, 0.0
    walk.n_met[0] = 0
    return V
