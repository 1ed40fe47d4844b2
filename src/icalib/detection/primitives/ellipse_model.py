"""Kernel that fits a blurred ellipse to the pixels about its edge, by Gauss-Newton with limited steps.

    grey(u) = inside + (outside - inside) Phi(d(u) / blur),  d(u) = (|W (u - c)| - 1) / |gradient of |W (u - c)||

c (2,) px is the centre; W (2, 2) 1/px maps the ellipse to the unit circle; Phi is the normal distribution function; d
is the distance from the ellipse to first order (Sampson). The model is point symmetric about c. So is the image of an
ellipse under blur and any camera response, so that these do not bias the centre.

The eight parameters are c (2), the shape S (S_00, S_11, S_01), blur [px], and the grey levels inside and outside. A
step of the shape is W <- (I + S) W. S is symmetric because a rotation of the unit circle does not change the ellipse.
"""

from __future__ import annotations

from math import erf, exp, hypot, pi, sqrt

import numpy as np

from icalib.base.compiled import njit
from icalib.detection.primitives.edge_model import BLUR_RANGE_PX, solve_small
from icalib.detection.primitives.tags import LEAST_CONTRAST

_SIZE = 8  # number of parameters
_MOST_ELLIPSE_STEPS = 20  # at most; a fit that needs more counts as failed
_CONVERGED_PX = 1e-3  # largest shift of the edge in the last step; far below the noise of a centre
_MOST_STEP_PX = 1.0  # largest shift of the edge in one step: the model is linear over about the width of the blur
_HALF_STRIP = (2.0, 3.0)  # px, and blurs, the larger of both: half width of the strip of fitted pixels
_MOST_EDGE_STRIP = 0.6  # of the smaller half axis: the same, at most. More would include the opposite edge
_FIRST_BLUR = 0.8  # px, start value
# Largest shift of the centre from the start: this share of the smaller half axis, plus 1 px. Doubled, it may reach a
# neighbour.
_MOST_CENTRE_MOVE = 0.5
# least half axis beyond the blur; smaller ellipses have no plateau inside, and are rejected as blurred
LEAST_HALF_AXIS_PX = 2.5


@njit(cache=True, nogil=True)
def fit_ellipses(image, uv, axes):
    """(uv (n, 2) px, quality (5, n)) of the ellipses in the image (h, w) that start at uv (n, 2) px with `axes`.

    axes (n, 2, 2) px: in its rows, the images of two perpendicular radii of a circle. uv stays where no ellipse fits.

    The rows of quality are those of `refined_crossings`: sigma [px] of the centre per axis for image noise of one grey
    level, NaN where no ellipse fits; blur [px]; smaller over larger axis (in place of the sine between edges); by how
    much the smaller half axis exceeds the least plus the blur [px] (the room); the larger diameter [px].
    """
    out, quality = uv.copy(), np.full((5, len(uv)), np.nan)
    for i in range(len(uv)):
        u, v, sigma, blur, a, b = _fit(image, uv[i, 0], uv[i, 1], axes[i])
        out[i, 0], out[i, 1] = u, v
        quality[0, i], quality[1, i] = sigma, blur
        quality[2, i], quality[3, i], quality[4, i] = b / max(a, 1e-12), b - LEAST_HALF_AXIS_PX - blur, 2.0 * a
    return out, quality


@njit(cache=True, nogil=True)
def _half_axes(W):
    """The larger and the smaller half axis [px] of the ellipse |W (u - c)| = 1: from the eigenvalues of W^T W."""
    a = W[0, 0] ** 2 + W[1, 0] ** 2
    b = W[0, 0] * W[0, 1] + W[1, 0] * W[1, 1]
    c = W[0, 1] ** 2 + W[1, 1] ** 2
    mean, half_gap = 0.5 * (a + c), hypot(0.5 * (a - c), b)
    return 1.0 / sqrt(max(mean - half_gap, 1e-12)), 1.0 / sqrt(mean + half_gap)


@njit(cache=True, nogil=True)
def _fit(image, u0, v0, axes):
    """(u, v, sigma, blur, larger and smaller half axis) [px], from (u0, v0); sigma is NaN where no ellipse fits.

    sigma is for image noise of one grey level, and the mean of both axes.
    """
    det = axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]
    if not abs(det) > 1e-9:
        return u0, v0, np.nan, 0.0, 0.0, 0.0
    # Rows of axes are the images of two radii: the ellipse is centre + axes^T (unit vector).
    W = np.array([[axes[1, 1], -axes[1, 0]], [-axes[0, 1], axes[0, 0]]]) / det
    p = np.array([u0, v0, _FIRST_BLUR, 0.0, 0.0])  # centre, blur, grey inside, grey outside; W holds the shape
    A = np.zeros((_SIZE, _SIZE))
    for iteration in range(_MOST_ELLIPSE_STEPS):
        large, small = _half_axes(W)
        if small < 0.5 * LEAST_HALF_AXIS_PX or hypot(p[0] - u0, p[1] - v0) > _MOST_CENTRE_MOVE * small + 1.0:
            return u0, v0, np.nan, 0.0, large, small
        half = min(max(_HALF_STRIP[0], _HALF_STRIP[1] * p[2]), _MOST_EDGE_STRIP * small)
        if not _inside(image, p, large + half):
            return u0, v0, np.nan, p[2], large, small
        b, n = _accumulate(A, image, p, W, half, iteration == 0)
        if n < 2 * _SIZE or not p[4] - p[3] >= LEAST_CONTRAST:
            return u0, v0, np.nan, p[2], large, small
        if _move(p, W, solve_small(A, b), large) < _CONVERGED_PX:
            large, small = _half_axes(W)
            return p[0], p[1], _sigma(A), p[2], large, small
    large, small = _half_axes(W)
    return p[0], p[1], np.nan, p[2], large, small


@njit(cache=True, nogil=True, inline="always")
def _move(p, W, step, large):
    """Adds a step (8,), shortened to _MOST_STEP_PX, to the parameters p (5,) and the shape W (2, 2). Returns the shift
    of the edge [px] by the whole step. large [px]: larger half axis."""
    moved = max(hypot(step[0], step[1]), large * max(abs(step[2]), abs(step[3]), abs(step[4])))
    scale = min(1.0, _MOST_STEP_PX / max(moved, 1e-12))
    p[0] += scale * step[0]
    p[1] += scale * step[1]
    S = scale * np.array([[step[2], step[4]], [step[4], step[3]]])
    before = W.copy()
    for i in range(2):
        for j in range(2):
            W[i, j] = before[i, j] + S[i, 0] * before[0, j] + S[i, 1] * before[1, j]
    p[2] = min(max(p[2] + scale * min(max(step[5], -0.5 * p[2]), p[2]), BLUR_RANGE_PX[0]), BLUR_RANGE_PX[1])
    # Grey levels enter linearly: their step needs no limit.
    p[3] += step[6]
    p[4] += step[7]
    return moved


@njit(cache=True, nogil=True)
def _sigma(A):
    """Standard deviation of the centre [px], the mean of both axes, from the normal matrix A (8, 8); NaN if it is not
    positive definite."""
    variance = 0.0
    for k in range(2):
        unit = np.zeros(_SIZE)
        unit[k] = 1.0
        variance += 0.5 * solve_small(A, unit)[k]
    return sqrt(variance) if variance > 0.0 else np.nan


@njit(cache=True, nogil=True)
def _inside(image, p, reach):
    """Whether the image holds all pixels within `reach` px of the centre."""
    return (
        p[0] - reach >= 0.0
        and p[1] - reach >= 0.0
        and p[0] + reach <= image.shape[1] - 1.0
        and p[1] + reach <= image.shape[0] - 1.0
    )


@njit(cache=True, nogil=True)
def _accumulate(A, image, p, W, half, set_levels):
    """Fills the lower triangle of A (8, 8) with J^T J of the pixels within `half` px of the edge. Returns J^T error
    (8,) and the number of pixels.

    With `set_levels` the grey levels p[3], p[4] are first set to the means inside and outside.
    """
    large, _ = _half_axes(W)
    x0, x1 = int(np.ceil(p[0] - large - half)), int(p[0] + large + half)
    y0, y1 = int(np.ceil(p[1] - large - half)), int(p[1] + large + half)
    if set_levels:
        _set_levels(image, p, W, half, x0, x1, y0, y1)
    A[:] = 0.0
    b, J, n = np.zeros(_SIZE), np.empty(_SIZE), 0
    contrast, blur = p[4] - p[3], p[2]
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            d, t0, t1, s0, s1, gradient, radius = _distance(W, x - p[0], y - p[1])
            if not abs(d) <= half:
                continue
            z = d / blur
            share = 0.5 * (1.0 + erf(z / sqrt(2.0)))
            slope = contrast * exp(-0.5 * z * z) / (sqrt(2.0 * pi) * blur)
            J[0], J[1] = -slope * s0 / gradient, -slope * s1 / gradient
            J[2], J[3] = slope * radius * t0 * t0 / gradient, slope * radius * t1 * t1 / gradient
            J[4] = slope * 2.0 * radius * t0 * t1 / gradient
            J[5], J[6], J[7] = -slope * z, 1.0 - share, share
            error = image[y, x] - p[3] - contrast * share
            n += 1
            for i in range(_SIZE):
                b[i] += J[i] * error
                for j in range(i + 1):
                    A[i, j] += J[i] * J[j]
    for i in range(_SIZE):
        A[i, i] *= 1.0 + 1e-9  # keeps A positive definite to rounding
    return b, n


@njit(cache=True, nogil=True)
def _distance(W, x, y):
    """Sampson distance [px] of the pixel u = (x, y) from the ellipse |W u| = 1, positive outside, and its terms.

    The terms: the unit vector W u / |W u| (2), the gradient of |W u| [1/px] (2), its length, and |W u|.
    """
    a, b = W[0, 0] * x + W[0, 1] * y, W[1, 0] * x + W[1, 1] * y
    radius = max(hypot(a, b), 1e-9)
    t0, t1 = a / radius, b / radius
    s0, s1 = t0 * W[0, 0] + t1 * W[1, 0], t0 * W[0, 1] + t1 * W[1, 1]
    gradient = max(hypot(s0, s1), 1e-12)  # zero at the very centre
    return (radius - 1.0) / gradient, t0, t1, s0, s1, gradient, radius


@njit(cache=True, nogil=True)
def _set_levels(image, p, W, half, x0, x1, y0, y1):
    """Sets p[3], p[4] to the mean grey levels inside and outside, from the pixels of the strip that are farthest from
    the edge."""
    inside, n_inside, outside, n_outside = 0.0, 0, 0.0, 0
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            d = _distance(W, x - p[0], y - p[1])[0]
            if -half <= d <= -0.5 * half:
                inside += image[y, x]
                n_inside += 1
            elif 0.5 * half <= d <= half:
                outside += image[y, x]
                n_outside += 1
    p[3], p[4] = inside / max(n_inside, 1), outside / max(n_outside, 1)
