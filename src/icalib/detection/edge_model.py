"""Compiled: position of an L-corner, by a fit of a blurred step to each side and the intersection of both.

OpenCV's cornerSubPix shifts such corners inwards by 0.16 to 0.20 px under ordinary blur. A straight edge away from its
ends is symmetric under blur, so neither its position nor the intersection is biased.

Kernels that fit the sides of a dark quad: straight lines through edge points away from the corners.
"""

from __future__ import annotations

from math import erf, hypot, pi, sqrt

import numpy as np

from icalib.base.compiled import njit
from icalib.detection.decoding import bilinear
from icalib.geometry.planes import EDGE

_ITERATIONS = 10  # at most
_CONVERGED_PX = 1e-3  # largest shift of the edge in the last step
END_PX = 3.0  # length left out at both ends of a side, where the blurred corner bends the edge
_MOST_END = 0.25  # of the side: the same, at most
_CURVED_FROM_PX = 24.0  # length of a side from which its curvature is estimated, too
BLUR_RANGE_PX = (0.35, 6.0)  # limits of the fitted blur; the least is about that of a pixel's width
USUAL_BLUR_PX = 0.7  # standard deviation of the Gaussian before it is measured; it only sets windows
LEAST_RISE = 4.0  # grey levels over 2 px at an edge
_PER_UNIT = 128  # entries of the table of the error function per unit; linear interpolation is accurate to 2e-5
_TABLE = np.array([(erf(k / _PER_UNIT), 2.0 / sqrt(pi) * np.exp(-((k / _PER_UNIT) ** 2))) for k in range(514)])
_LEAST_SINE = 0.17  # of the angle between two sides, at least: 10 degrees


@njit(cache=True, nogil=True, inline="always")
def error_function(z):
    """(erf(z), its derivative) from a table, because fits spend most of their time here."""
    at = abs(z) * _PER_UNIT
    if at >= 512.0:
        return (1.0 if z > 0.0 else -1.0), 0.0
    i = int(at)
    f = at - i
    value = _TABLE[i, 0] + f * (_TABLE[i + 1, 0] - _TABLE[i, 0])
    slope = _TABLE[i, 1] + f * (_TABLE[i + 1, 1] - _TABLE[i, 1])
    return (value if z > 0.0 else -value), slope


@njit(cache=True, nogil=True)
def solve_small(A, b):
    """x with A x = b for a small symmetric positive definite A (n, n); zeros if A is not positive definite."""
    n = len(b)
    L, x = np.zeros((n, n)), np.zeros(n)
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                if s <= 1e-12 * abs(A[i, i]):
                    return np.zeros(n)
                L[i, i] = sqrt(s)
            else:
                L[i, j] = s / L[j, j]
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for i in range(n - 1, -1, -1):
        s = x[i]
        for k in range(i + 1, n):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
    return x


@njit(cache=True, nogil=True)
def fit_step(image, u0, v0, u1, v1, end, half):
    """(place (3,), blur, contrast, ends (2, 2)) of the edge from (u0, v0) to (u1, v1), with the bright side on its
    left.

    place: coefficients of the offset [px] along the outward normal, a quadratic polynomial of the position along the
    side, -1 to 1. The quadratic one, the bend, is zero for short sides. blur [px]: of the Gaussian. contrast: grey
    levels, zero if there is no edge. Pixels within `half` px of the side are used, except the last `end` px at both
    ends.

    ends, for each end of the side: first the variance [px^2] of its offset, for image noise of one grey level and a
    known bend. Second, the change of its offset if the bend is fixed at 1 px more than fitted. NaN if there is no edge.
    """
    p, contrast, rows = _fitted_step(image, u0, v0, u1, v1, end, half)
    if contrast == 0.0:
        return np.zeros(3), p[2], 0.0, np.full((2, 2), np.nan)
    return np.array([p[0], p[1], p[5]]), p[2], contrast, _known_bend(rows)


@njit(cache=True, nogil=True)
def step_blur(image, u0, v0, u1, v1, end, half):
    """(blur [px], contrast) of `fit_step`."""
    p, contrast, _ = _fitted_step(image, u0, v0, u1, v1, end, half)
    return p[2], contrast


@njit(cache=True, nogil=True)
def _fitted_step(image, u0, v0, u1, v1, end, half):
    """(p (6,), contrast, rows (7, n)) of `fit_step`: the parameters, and the rows of `_fill_rows` from the last step.

    Parameters: offset, slope, blur, low and high grey level, and for a long side the bend.
    """
    p = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
    length = hypot(u1 - u0, v1 - v0)
    size = 6 if length >= _CURVED_FROM_PX else 5
    t, off, grey = _strip(image, u0, v0, u1, v1, 0.5 * length - min(end, _MOST_END * length), half)
    dark, bright = off < -0.5 * half, off > 0.5 * half
    rows = np.empty((7, len(grey)))
    if len(grey) < 2 * size or not dark.any() or not bright.any():
        return p, 0.0, rows
    p[3], p[4] = grey[dark].mean(), grey[bright].mean()
    A = np.zeros((size, size))
    for _ in range(_ITERATIONS):
        _fill_rows(rows, p, t, off, grey)
        step = solve_small(A, normal_equations(A, rows, rows[6]))
        largest = max(abs(step[0]), abs(step[1]))
        scale = min(1.0, 1.0 / max(largest, 1e-12))
        blur = p[2] + scale * min(max(step[2], -0.5 * p[2]), p[2])
        for k in range(size):
            p[k] += step[k] if k == 3 or k == 4 else scale * step[k]
        p[2] = min(max(blur, BLUR_RANGE_PX[0]), BLUR_RANGE_PX[1])
        if abs(p[0]) + abs(p[1]) + abs(p[5]) > half + 1.0 or p[4] <= p[3]:
            return p, 0.0, rows
        if largest < _CONVERGED_PX and abs(step[2]) < 0.01:
            break
    return p, p[4] - p[3], rows


@njit(cache=True, nogil=True)
def _known_bend(rows):
    """`ends` of `fit_step`, from the rows of its fit. If the bend changes, the other parameters change by -A^-1 a for
    each px, where a are their products with the bend."""
    A, a, ends = np.zeros((5, 5)), np.empty(5), np.empty((2, 2))
    normal_equations(A, rows, rows[6])
    for j in range(5):
        a[j] = row_product(rows[j], rows[5])
    for k in range(2):
        at_end = np.zeros(5)
        at_end[0], at_end[1] = 1.0, 2.0 * k - 1.0
        by_rows = solve_small(A, at_end)
        ends[k, 0] = by_rows[0] + at_end[1] * by_rows[1]
        ends[k, 1] = 1.0 - (by_rows * a).sum()
    return ends


@njit(cache=True, nogil=True)
def _strip(image, u0, v0, u1, v1, reach, half):
    """(t, off, grey), each (n,), of the pixels within `reach` px along and `half` px across the side's middle.

    t is -1 to 1 from end to end; off [px] is positive on the left. Empty if the strip leaves the image.
    """
    length = hypot(u1 - u0, v1 - v0)
    tu, tv = (u1 - u0) / length, (v1 - v0) / length
    cu, cv = 0.5 * (u0 + u1), 0.5 * (v0 + v1)
    ru, rv = abs(tu) * reach + abs(tv) * half, abs(tv) * reach + abs(tu) * half
    if not (cu - ru > 0.0 and cv - rv > 0.0 and cu + ru < image.shape[1] - 1.0 and cv + rv < image.shape[0] - 1.0):
        return np.empty(0), np.empty(0), np.empty(0)
    x0, x1, y0, y1 = int(np.ceil(cu - ru)), int(cu + ru), int(np.ceil(cv - rv)), int(cv + rv)
    m = (x1 - x0 + 1) * (y1 - y0 + 1)
    t, off, grey, n = np.empty(m), np.empty(m), np.empty(m), 0
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            along, d = (x - cu) * tu + (y - cv) * tv, (x - cu) * tv - (y - cv) * tu
            if abs(along) <= reach and abs(d) <= half:
                t[n], off[n], grey[n] = along / (0.5 * length), d, image[y, x]
                n += 1
    return t[:n], off[:n], grey[:n]


@njit(cache=True, nogil=True)
def _fill_rows(rows, p, t, off, grey):
    """Fills rows (7, n): derivatives of the grey level by the six parameters p, and the residual."""
    contrast, blur = p[4] - p[3], p[2]
    for i in range(len(grey)):
        z = (off[i] - p[0] - t[i] * (p[1] + t[i] * p[5])) / blur
        value, by_z = error_function(z / sqrt(2.0))
        share = 0.5 * (1.0 + value)
        slope = contrast * by_z / (2.0 * sqrt(2.0) * blur)
        rows[0, i], rows[1, i], rows[2, i] = -slope, -slope * t[i], -slope * z
        rows[3, i], rows[4, i], rows[5, i] = 1.0 - share, share, -slope * t[i] * t[i]
        rows[6, i] = grey[i] - p[3] - contrast * share


@njit(cache=True, nogil=True, fastmath={"reassoc", "contract"})
def row_product(a, b):
    """a . b of vectors (n,). The order of the sum is free, so that it is vectorised."""
    s = 0.0
    for i in range(len(a)):
        s += a[i] * b[i]
    return s


@njit(cache=True, nogil=True)
def normal_equations(A, rows, error):
    """Fills A (m, m), lower triangle, from the first m of the rows (., n); returns the right side (m,) for the
    residuals `error` (n,)."""
    m = len(A)
    b = np.empty(m)
    for j in range(m):
        b[j] = row_product(rows[j], error)
        for k in range(j + 1):
            A[j, k] = row_product(rows[j], rows[k])
        A[j, j] *= 1.0 + 1e-9
    return b


@njit(cache=True, nogil=True)
def _tangent(quad, k, place, u, v):
    """(a, b, c) with a u + b v = c: tangent of the fitted side k of the quad, at the point nearest to (u, v) along the
    side."""
    m = (k + 1) % 4
    length = hypot(quad[m, 0] - quad[k, 0], quad[m, 1] - quad[k, 1])
    tu, tv = (quad[m, 0] - quad[k, 0]) / length, (quad[m, 1] - quad[k, 1]) / length
    cu, cv = 0.5 * (quad[k, 0] + quad[m, 0]), 0.5 * (quad[k, 1] + quad[m, 1])
    t = ((u - cu) * tu + (v - cv) * tv) / (0.5 * length)
    slope = (place[1] + 2.0 * t * place[2]) / (0.5 * length)
    a, b = tv - slope * tu, -tu - slope * tv
    offset = place[0] + t * (place[1] + t * place[2])
    along = 0.5 * length * t
    return a, b, a * (cu + along * tu + offset * tv) + b * (cv + along * tv - offset * tu)


@njit(cache=True, nogil=True)
def _sine(quad, k):
    """Sine of the angle between the sides that meet in corner k of the quad."""
    a, b = quad[(k + 1) % 4] - quad[k], quad[(k + 3) % 4] - quad[k]
    return abs(a[0] * b[1] - a[1] * b[0]) / max(hypot(a[0], a[1]) * hypot(b[0], b[1]), 1e-12)


@njit(cache=True, nogil=True)
def _edge_row(quad, k, end, place, blur, gain, by_offset):
    """(EDGE,) of side k of the quad, as in `edge_fits`, for the corner at its `end` (0: k, 1: k + 1). by_offset
    (2,): derivative of the corner by the side's offset there."""
    m, row = (k + 1) % 4, np.zeros(EDGE)
    eu, ev = quad[m, 0] - quad[k, 0], quad[m, 1] - quad[k, 1]
    square = eu * eu + ev * ev
    row[2 * (1 - end)], row[2 * (1 - end) + 1] = (eu, ev) if end == 0 else (-eu, -ev)
    # Blur shifts a curved edge towards its centre of curvature, by blur^2 / 2 times the curvature.
    moved = gain * square / 8.0 - 0.5 * blur * blur
    row[4], row[5], row[6] = moved * by_offset[0], moved * by_offset[1], 8.0 * place[2] / square
    return row


@njit(cache=True, nogil=True)
def fit_corners(image, quad, end, half):
    """(corners (4, 2), sigma (4,), blur (4,), edges (4, 2, EDGE)): intersections of the fitted sides of a dark quad.

    The quad's corners are clockwise in the image and accurate to about 1 px. Pixels within `half` px of a side are
    used, except those less than `end` px from another side.

    sigma: standard deviation [px] per axis for image noise of one grey level and known bends of the sides, NaN if no
    corner was found; blur [px]: the larger one of both sides; edges as in `edge_fits`.
    """
    place, ends, side_blur = np.empty((4, 3)), np.empty((4, 2, 2)), np.empty(4)
    for k in range(4):
        m = (k + 1) % 4
        away = end / max(min(_sine(quad, k), _sine(quad, m)), _LEAST_SINE)
        place[k], side_blur[k], _, ends[k] = fit_step(image, quad[k, 0], quad[k, 1], quad[m, 0], quad[m, 1], away, half)
    corners, sigma, blur = quad.copy(), np.full(4, np.nan), np.empty(4)
    edges = np.zeros((4, 2, EDGE))
    for k in range(4):
        before = (k + 3) % 4
        blur[k] = max(side_blur[before], side_blur[k])
        det, a0, b0, a1, b1 = 1.0, 0.0, 0.0, 0.0, 0.0
        for _ in range(3):
            a0, b0, c0 = _tangent(quad, before, place[before], corners[k, 0], corners[k, 1])
            a1, b1, c1 = _tangent(quad, k, place[k], corners[k, 0], corners[k, 1])
            det = a0 * b1 - a1 * b0
            if not abs(det) > _LEAST_SINE:
                break
            corners[k, 0], corners[k, 1] = (c0 * b1 - c1 * b0) / det, (a0 * c1 - a1 * c0) / det
        if abs(det) > _LEAST_SINE:
            sigma[k] = sqrt(0.5 * (ends[before, 1, 0] + ends[k, 0, 0])) / abs(det)
            by_side, by_before = (-b0 / det, a0 / det), (b1 / det, -a1 / det)
            edges[k, 0] = _edge_row(quad, k, 0, place[k], side_blur[k], ends[k, 0, 1], by_side)
            edges[k, 1] = _edge_row(quad, before, 1, place[before], side_blur[before], ends[before, 1, 1], by_before)
    return corners, sigma, blur, edges


_FROM_CORNER = 0.15  # of the side, left out at both ends
_MAX_PROFILES = 24  # edge points of a side, at most
_OUTLIER_PX = 1.0  # distance from the line above which an edge point is an outlier


@njit(cache=True, nogil=True)
def _edge_point(image, u, v, nu, nv, reach, least):
    """Offset [px] along (nu, nv) of the steepest rise of grey level within `reach` px of (u, v); NaN if it is below
    `least`."""
    steps = int(2.0 * reach) + 1
    best, at, before, after, last = least, -1, 0.0, 0.0, 0.0
    for k in range(-steps, steps + 1):
        s = 0.5 * k
        u0, v0, u1, v1 = u + (s - 1.0) * nu, v + (s - 1.0) * nv, u + (s + 1.0) * nu, v + (s + 1.0) * nv
        width, height = image.shape[1] - 1.0, image.shape[0] - 1.0
        inside = min(min(u0, u1), min(v0, v1)) >= 0.0 and max(u0, u1) <= width and max(v0, v1) <= height
        rise = bilinear(image, u1, v1) - bilinear(image, u0, v0) if inside else 0.0
        if k == at + 1 and best > least:
            after = rise
        if rise > best and abs(k) < steps:
            best, at, before, after = rise, k, last, 0.0
        last = rise
    if best <= least:
        return np.nan
    curvature = before - 2.0 * best + after
    return 0.5 * at + (0.25 * (before - after) / curvature if curvature < 0.0 else 0.0)


@njit(cache=True, nogil=True)
def _robust_line(t, d, used, bound):
    """(offset, slope, fits) of d = offset + slope t over the points `used`. Points farther than `bound` are outliers,
    later those farther than _OUTLIER_PX."""
    offset, slope = np.median(d[used]), 0.0
    for _ in range(3):
        s, st, stt, sd, std = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(len(t)):
            if used[k] and abs(d[k] - offset - slope * t[k]) < bound:
                s += 1.0
                st += t[k]
                stt += t[k] * t[k]
                sd += d[k]
                std += t[k] * d[k]
        det = s * stt - st * st
        if s < 3.0 or 2.0 * s < len(t) or det <= 0.0:
            return offset, slope, False
        offset, slope = (stt * sd - st * std) / det, (s * std - st * sd) / det
        bound = _OUTLIER_PX
    return offset, slope, True


@njit(cache=True, nogil=True)
def fit_side(image, u0, v0, u1, v1, reach, least):
    """Line (a, b, c) with a u + b v = c and outward normal (a, b), for the side from (u0, v0) to (u1, v1).

    Seen from the first point, the dark region is on the right (v points down), as inside a quad with clockwise corners.
    All are NaN if less than half of the profiles rise by more than `least` grey levels.
    """
    length = hypot(u1 - u0, v1 - v0)
    if length < 1e-6:
        return np.nan, np.nan, np.nan
    tu, tv = (u1 - u0) / length, (v1 - v0) / length
    nu, nv = tv, -tu
    n = int(min(max(0.7 * length, 5.0), float(_MAX_PROFILES)))
    t, d = np.empty(n), np.empty(n)
    for k in range(n):
        t[k] = length * (_FROM_CORNER + (1.0 - 2.0 * _FROM_CORNER) * k / (n - 1))
        d[k] = _edge_point(image, u0 + t[k] * tu, v0 + t[k] * tv, nu, nv, reach, least)
    used = ~np.isnan(d)
    if 2 * used.sum() < n:
        return np.nan, np.nan, np.nan
    offset, slope, fits = _robust_line(t, d, used, max(_OUTLIER_PX, 0.5 * reach))
    if not fits:
        return np.nan, np.nan, np.nan
    a, b = nu - slope * tu, nv - slope * tv
    norm = hypot(a, b)
    a, b = a / norm, b / norm
    return a, b, a * (u0 + offset * nu) + b * (v0 + offset * nv)


@njit(cache=True, nogil=True)
def fit_quad(image, quad, reach, least):
    """(fits, quad (4, 2)): intersections of the quad's sides after each was moved to the edge within `reach` px.

    The quad is dark, with clockwise corners in the image. fits is False if a side has no edge, or a corner moves by
    more than twice `reach`, plus 1 px.
    """
    lines = np.empty((4, 3))
    for k in range(4):
        m = (k + 1) % 4
        lines[k] = fit_side(image, quad[k, 0], quad[k, 1], quad[m, 0], quad[m, 1], reach, least)
    fitted = np.empty((4, 2))
    for k in range(4):
        p, q = lines[(k + 3) % 4], lines[k]
        det = p[0] * q[1] - p[1] * q[0]
        if not abs(det) > 0.1:
            return False, fitted
        fitted[k, 0] = (p[2] * q[1] - p[1] * q[2]) / det
        fitted[k, 1] = (p[0] * q[2] - p[2] * q[0]) / det
        if hypot(fitted[k, 0] - quad[k, 0], fitted[k, 1] - quad[k, 1]) > 2.0 * reach + 1.0:
            return False, fitted
    return True, fitted
