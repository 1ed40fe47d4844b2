"""Rotation of a camera between two images, from tracked points: epipolar geometry, without an initial guess.

Unit rays f and h of one point satisfy t . (R f x h) = 0, where R rotates from the first camera to the second and t is
the unit direction of motion. R and t minimise the errors over their standard deviation (Sampson's weighting) with
Cauchy's loss.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.small import solve_definite
from icalib.sensors.camera.stream import TrackStream, shared_rows

MIN_SHARED_POINTS = 12  # points that two images share: a relative pose has five unknowns, the rest gives redundancy
SAMPLED_PAIRS = 30  # pairs of images that show how long tracks are
EPIPOLAR_ITERATIONS = 10  # of rotation and direction, from a start without translation
DIRECTION_ITERATIONS = 4  # of the direction alone, at a fixed rotation
EPIPOLAR_DAMPING = 1e-9  # of the mean diagonal: without translation the direction is unobservable


@njit(cache=True, nogil=True)
def _tangent_basis(t, a, b):
    """Fills a, b (3,): unit vectors orthogonal to the unit vector t (3,) and to each other."""
    k = 0
    for i in range(3):
        if abs(t[i]) < abs(t[k]):
            k = i
    a[:] = 0.0
    a[k] = 1.0
    along = t[k]
    for i in range(3):
        a[i] -= along * t[i]
    n = np.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])
    for i in range(3):
        a[i] /= n
    b[0], b[1], b[2] = t[1] * a[2] - t[2] * a[1], t[2] * a[0] - t[0] * a[2], t[0] * a[1] - t[1] * a[0]


@njit(cache=True, nogil=True)
def _epipolar_errors(f, h, R, t, g, c, e, sigma):
    """Fills g (n, 3) = R f, c (n, 3) = R f x h, the errors e (n,) = t . c / sigma, and sigma (n,): the standard
    deviation of t . c by unit noise of both rays."""
    for i in range(len(f)):
        for r in range(3):
            g[i, r] = R[r, 0] * f[i, 0] + R[r, 1] * f[i, 1] + R[r, 2] * f[i, 2]
        c[i, 0] = g[i, 1] * h[i, 2] - g[i, 2] * h[i, 1]
        c[i, 1] = g[i, 2] * h[i, 0] - g[i, 0] * h[i, 2]
        c[i, 2] = g[i, 0] * h[i, 1] - g[i, 1] * h[i, 0]
        tg = t[0] * g[i, 0] + t[1] * g[i, 1] + t[2] * g[i, 2]
        th = t[0] * h[i, 0] + t[1] * h[i, 1] + t[2] * h[i, 2]
        sigma[i] = np.sqrt(max(2.0 - tg * tg - th * th, 1e-4))
        e[i] = (t[0] * c[i, 0] + t[1] * c[i, 1] + t[2] * c[i, 2]) / sigma[i]


@njit(cache=True, nogil=True)
def _epipolar_row(g, h, c, J_f_lens, J_h_lens, R, t, a, b, J):
    """Fills J (5 + L,): derivative of t . (R f x h) for one point by a left rotation of R, by t along a and b, and by
    the lens. g = R f, c = g x h; J_f_lens, J_h_lens (L, 3): derivatives of the rays f and h by the lens."""
    m0, m1 = h[1] * t[2] - h[2] * t[1], h[2] * t[0] - h[0] * t[2]
    m2 = h[0] * t[1] - h[1] * t[0]
    J[0], J[1] = g[1] * m2 - g[2] * m1, g[2] * m0 - g[0] * m2
    J[2] = g[0] * m1 - g[1] * m0
    J[3] = a[0] * c[0] + a[1] * c[1] + a[2] * c[2]
    J[4] = b[0] * c[0] + b[1] * c[1] + b[2] * c[2]
    for j in range(len(J_f_lens)):
        # t . (R J_f x h + R f x J_h), with m = h x t and t x R f.
        J[5 + j] = 0.0
        for r in range(3):
            R_J_f = R[r, 0] * J_f_lens[j, 0] + R[r, 1] * J_f_lens[j, 1] + R[r, 2] * J_f_lens[j, 2]
            J[5 + j] += R_J_f * (m0 if r == 0 else m1 if r == 1 else m2)
            p, q = (r + 1) % 3, (r + 2) % 3
            J[5 + j] += J_h_lens[j, r] * (t[p] * g[q] - t[q] * g[p])


@njit(cache=True, nogil=True)
def _epipolar_sums(f, h, J_f_lens, J_h_lens, R, t, a, b, A, x):
    """Normal equations A (5 + L, 5 + L), x (5 + L,) of the errors e = t . (R f x h) over their standard deviation, with
    Cauchy's weights. Unknowns: a left rotation of R, t along a and b (which are filled), and L lens parameters.
    J_f_lens, J_h_lens (n, L, 3): derivatives of the rays f, h (n, 3). Returns the weighted sum of squares [rad^2]."""
    n, m = len(f), J_f_lens.shape[1]
    g, c, e, sigma, J = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n), np.empty(5 + m)
    _epipolar_errors(f, h, R, t, g, c, e, sigma)
    scale, cost = 3.0 * np.median(np.abs(e)) + 1e-12, 0.0
    _tangent_basis(t, a, b)
    A[:] = 0.0
    x[:] = 0.0
    for i in range(n):
        _epipolar_row(g[i], h[i], c[i], J_f_lens[i], J_h_lens[i], R, t, a, b, J)
        w = 1.0 / (1.0 + (e[i] / scale) ** 2)
        cost += w * e[i] ** 2
        for r in range(5 + m):
            J[r] /= sigma[i]
            x[r] -= w * J[r] * e[i]
            for k in range(r + 1):
                A[r, k] += w * J[r] * J[k]
    for r in range(5 + m):
        for k in range(r):
            A[k, r] = A[r, k]
    return cost


@njit(cache=True, nogil=True)
def _move_direction(t, a, b, da, db):
    """Moves the unit vector t by da along a and db along b, at most by 0.5 rad."""
    size = np.sqrt(da * da + db * db)
    shorter = 0.5 / size if size > 0.5 else 1.0
    for r in range(3):
        t[r] += shorter * (da * a[r] + db * b[r])
    norm = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    for r in range(3):
        t[r] /= norm


@njit(cache=True, nogil=True)
def refine_relative_pose(f, h, R, t):
    """Refines R (3, 3) and the unit direction t (3,) of the relative pose with h ~ R f + s t, for rays f, h (n, 3).
    Returns the weighted sum of squares [rad^2] before the last step; infinite if singular."""
    a, b, A, x, J_no_lens = np.empty(3), np.empty(3), np.empty((5, 5)), np.empty(5), np.empty((len(f), 0, 3))
    cost = np.inf
    for _ in range(EPIPOLAR_ITERATIONS):
        cost = _epipolar_sums(f, h, J_no_lens, J_no_lens, R, t, a, b, A, x)
        mean = EPIPOLAR_DAMPING * (A[0, 0] + A[1, 1] + A[2, 2])
        for r in range(5):
            A[r, r] += mean
        if not solve_definite(A, x):
            return np.inf
        R[:] = so3.exp(x[:3].copy()) @ R
        _move_direction(t, a, b, x[3], x[4])
    return cost


@njit(cache=True, nogil=True)
def _direction_step(A, x, y):
    """Solves the 2 x 2 block of A (5, 5) that belongs to the direction, for the right side (x, y)."""
    mean = EPIPOLAR_DAMPING * (A[0, 0] + A[1, 1] + A[2, 2])
    p, q, r = A[3, 3] + mean, A[3, 4], A[4, 4] + mean
    inverse = 1.0 / (p * r - q * q)
    return inverse * (r * x - q * y), inverse * (p * y - q * x)


@njit(cache=True, nogil=True)
def rotation_information(f, h, J_f_lens, J_h_lens, R, t, H, g):
    """Fills H (3 + L, 3 + L) and g (3 + L,), the normal equations H step = g of a left rotation of R and of L lens
    parameters, after elimination of the direction of motion t, which is refined. Arguments as for `_epipolar_sums`.
    Returns the weighted sum of squares [rad^2]."""
    a, b, A, x, J_no_lens = np.empty(3), np.empty(3), np.empty((5, 5)), np.empty(5), np.empty((len(f), 0, 3))
    for _ in range(DIRECTION_ITERATIONS):
        _epipolar_sums(f, h, J_no_lens, J_no_lens, R, t, a, b, A, x)
        u, v = _direction_step(A, x[3], x[4])
        _move_direction(t, a, b, u, v)
    n = 5 + J_f_lens.shape[1]
    A, x = np.empty((n, n)), np.empty(n)
    cost = _epipolar_sums(f, h, J_f_lens, J_h_lens, R, t, a, b, A, x)
    for i in range(n - 2):
        r = i if i < 3 else i + 2
        u, v = _direction_step(A, A[3, r], A[4, r])
        g[i] = x[r] - u * x[3] - v * x[4]
        for k in range(n - 2):
            c = k if k < 3 else k + 2
            H[i, k] = A[r, c] - u * A[3, c] - v * A[4, c]
    return cost


@njit(cache=True, nogil=True)
def direction_for_rotation(f, h, R):
    """The direction of motion (3,) that fits rays f, h (n, 3) best for the rotation R: eigenvector of the smallest
    eigenvalue of sum (R f x h)(R f x h)^T."""
    N, g, c = np.zeros((3, 3)), np.empty(3), np.empty(3)
    for i in range(len(f)):
        for r in range(3):
            g[r] = R[r, 0] * f[i, 0] + R[r, 1] * f[i, 1] + R[r, 2] * f[i, 2]
        c[0] = g[1] * h[i, 2] - g[2] * h[i, 1]
        c[1] = g[2] * h[i, 0] - g[0] * h[i, 2]
        c[2] = g[0] * h[i, 1] - g[1] * h[i, 0]
        for r in range(3):
            for k in range(3):
                N[r, k] += c[r] * c[k]
    return np.linalg.eigh(N)[1][:, 0].copy()


@njit(cache=True, nogil=True)
def rotation_information_of_pairs(f, h, J_f_lens, J_h_lens, begin, R, H, g, cost):
    """Fills H (M, 3 + L, 3 + L), g (M, 3 + L) and cost (M,) of `rotation_information`, for pairs of images with
    rotations R (M, 3, 3). Pair i has the rows begin[i]..begin[i + 1] of the rays f, h (n, 3) and of their derivatives
    (n, L, 3)."""
    for i in range(len(R)):
        rows = slice(begin[i], begin[i + 1])
        t = direction_for_rotation(f[rows], h[rows], R[i])
        cost[i] = rotation_information(f[rows], h[rows], J_f_lens[rows], J_h_lens[rows], R[i], t, H[i], g[i])


def rotation_without_translation(f: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R (3, 3) that best rotates rays f to h (n, 3), and the best direction of motion (3,) for it."""
    U, _, Vt = np.linalg.svd(h.T @ f)
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return np.ascontiguousarray(R), direction_for_rotation(f, h, R)


def rotation_error(f: np.ndarray, h: np.ndarray, R: np.ndarray, t: np.ndarray) -> tuple[float, float]:
    """Standard deviation [rad] of a rotation about each axis (RMS over axes), and of a ray across its epipolar plane
    [rad]."""
    H, g, J_no_lens = np.empty((3, 3)), np.empty(3), np.empty((len(f), 0, 3))
    cost = rotation_information(f, h, J_no_lens, J_no_lens, R, t.copy(), H, g)
    H[range(3), range(3)] += EPIPOLAR_DAMPING * np.trace(H)
    return float(np.sqrt(cost / len(f) * np.trace(np.linalg.inv(H)) / 3.0)), float(np.sqrt(cost / len(f)))


def image_pairs(stream: TrackStream, step: float) -> list[tuple[int, int]]:
    """Indices of each image and of the one about `step` s later."""
    t = stream.seconds
    after = np.searchsorted(t, t + step - 0.5 * float(np.median(np.diff(t))))
    return [(i, int(j)) for i, j in enumerate(after) if i < j < len(t)]


def pairs_with_shared_points(
    stream: TrackStream, valid: np.ndarray, steps: Sequence[float], most: int
) -> Iterator[tuple[int, int, np.ndarray, np.ndarray]]:
    """About `most` pairs of images for each of the `steps` [s] between them, with MIN_SHARED_POINTS shared points or
    more: indices of both images, and rows as `shared_points` returns them. If tracks are shorter than the first step,
    all steps are halved until half of the pairs share enough points."""
    for step in _shortened_steps(stream, valid, steps):
        every = image_pairs(stream, step)
        for i, j in every[:: max(1, len(every) // most)]:
            p, q = shared_points(stream, valid, i, j)
            if len(p) >= MIN_SHARED_POINTS:
                yield i, j, p, q


def _shortened_steps(stream: TrackStream, valid: np.ndarray, steps: Sequence[float]) -> Sequence[float]:
    """The steps times 1, 1/2, 1/4 or 1/8: the largest at which more than half of the pairs share enough points."""
    for shorter in (1.0, 0.5, 0.25, 0.125):
        every = image_pairs(stream, shorter * steps[0])
        some = every[:: max(1, len(every) // SAMPLED_PAIRS)]
        enough = sum(len(shared_points(stream, valid, i, j)[0]) >= MIN_SHARED_POINTS for i, j in some)
        if 2 * enough > len(some):
            return [shorter * step for step in steps]
    return steps


def shared_points(stream: TrackStream, valid: np.ndarray, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the points that images i and j share, in i and in j; only those with a valid ray."""
    p, q = shared_rows(stream.start, stream.feature, i, j)
    valid_rows = valid[p] & valid[q]
    return p[valid_rows], q[valid_rows]
