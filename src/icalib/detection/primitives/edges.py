"""Kernels that fit the sides of a dark quad: straight lines through edge points away from the corners."""

from __future__ import annotations

from math import hypot

import numpy as np

from icalib.base.compiled import njit
from icalib.detection.primitives.decoding import bilinear

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
