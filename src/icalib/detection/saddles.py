"""Kernels for X-corners, where two dark squares touch: windows around them, and their rough positions.

Compiled: position of an X-corner, where two dark squares touch, by a fit of two crossing blurred steps.

The image of an X-corner is point symmetric under blur, oblique views and any camera response, and so is the model.
Errors of the model therefore do not bias the point, unless other features reach into the window. Gradients alone (as in
cornerSubPix) do not suffice: if the window is hardly wider than the blur, they are biased away from the corner.
"""

from __future__ import annotations

from math import atan2, cos, hypot, sin, sqrt

import numpy as np

from icalib.base.compiled import njit
from icalib.detection.decoding import bilinear
from icalib.detection.edge_model import error_function, normal_equations, row_product, solve_small
from icalib.geometry.planes import EDGE

_LEAST_HALF_PX = 2.0  # least half width of the window of `find_saddle`
_MOST_HALF = (6.0, 0.1)  # px, and of a side, the larger of both: largest half width of the same window
MARGIN_BLURS = 1.5  # blurs between the window and a neighbouring feature
_ITERATIONS = 12
_CONVERGED_PX = 0.02
_LEAST_ROOM_PX = 1.5  # least half width of a window that the image border limits
LEAST_SINE = 0.17  # of the angle between the edges, at least: 10 degrees


@njit(cache=True, nogil=True)
def window_frame(ea, eb, clear, blur, least, most):
    """(sa, sb, sine): half widths of a window in units of the sides ea, eb (2,) px that meet in the corner, and the
    sine between the sides.

    clear: distance of the nearest other feature, in the same units. The window keeps MARGIN_BLURS blurs [px] away from
    it, but its half width across the edges is between `least` and `most` px.
    """
    la, lb = hypot(ea[0], ea[1]), hypot(eb[0], eb[1])
    sine = abs(ea[0] * eb[1] - ea[1] * eb[0]) / max(la * lb, 1e-12)
    across, margin = max(sine, LEAST_SINE), MARGIN_BLURS * blur
    sa = min(max(clear - margin / (la * across), least / (la * across)), most / la)
    sb = min(max(clear - margin / (lb * across), least / (lb * across)), most / lb)
    return max(sa, least / la), max(sb, least / lb), sine


@njit(cache=True, nogil=True)
def room_for(image, u, v, ea, eb, sa, sb):
    """Factor, at most 1, by which a window must be scaled so that all its pixels have neighbours in the image."""
    ru = abs(ea[0]) * sa + abs(eb[0]) * sb
    rv = abs(ea[1]) * sa + abs(eb[1]) * sb
    room_u, room_v = min(u, image.shape[1] - 1.0 - u) - 1.0, min(v, image.shape[0] - 1.0 - v) - 1.0
    return max(min(1.0, min(room_u / ru, room_v / rv)), 0.0)


@njit(cache=True, nogil=True)
def window_bounds(u, v, ea, eb, sa, sb):
    """(u0, u1, v0, v1): bounding box of the window, in whole pixels."""
    ru = abs(ea[0]) * sa + abs(eb[0]) * sb
    rv = abs(ea[1]) * sa + abs(eb[1]) * sb
    return int(np.ceil(u - ru)), int(np.floor(u + ru)), int(np.ceil(v - rv)), int(np.floor(v + rv))


@njit(cache=True, nogil=True)
def _weight(du, dv, ea, eb, det, sa, sb):
    """Weight of a pixel at (du, dv) from the corner: 1 there, 0 at the edge of the window."""
    s = (du * eb[1] - dv * eb[0]) / det / sa
    t = (ea[0] * dv - ea[1] * du) / det / sb
    s, t = 1.0 - s * s, 1.0 - t * t
    return s * t if s > 0.0 and t > 0.0 else 0.0


@njit(cache=True, nogil=True)
def _gradient(image, x, y):
    """Central differences (gu, gv). Grey levels are unsigned, so they are converted before the difference."""
    gu = 0.5 * (float(image[y, x + 1]) - float(image[y, x - 1]))
    gv = 0.5 * (float(image[y + 1, x]) - float(image[y - 1, x]))
    return gu, gv


@njit(cache=True, nogil=True)
def _coarse_frame(ea, eb, clear, blur):
    """`window_frame` with the limits of `find_saddle`."""
    most = max(_MOST_HALF[0], _MOST_HALF[1] * min(hypot(ea[0], ea[1]), hypot(eb[0], eb[1])))
    return window_frame(ea, eb, clear, blur, _LEAST_HALF_PX, most)


@njit(cache=True, nogil=True)
def find_saddle(image, u, v, ea, eb, clear, blur, max_move):
    """(found, u, v): the point within `max_move` px of (u, v) to which the gradients around it are perpendicular.

    ea, eb (2,) px: sides of the dark square that meet in the corner; clear: distance of the nearest other feature, in
    units of the sides; blur [px]: of the image. Accurate to some tenths of a pixel, from a start some pixels away.
    """
    sa, sb, sine = _coarse_frame(ea, eb, clear, blur)
    det = ea[0] * eb[1] - ea[1] * eb[0]
    start_u, start_v = u, v
    if sine < LEAST_SINE:
        return False, u, v
    for _ in range(_ITERATIONS):
        room = room_for(image, u, v, ea, eb, sa, sb)
        if room * min(sa * hypot(ea[0], ea[1]), sb * hypot(eb[0], eb[1])) * sine < _LEAST_ROOM_PX:
            return False, u, v
        du, dv = _step(image, u, v, ea, eb, det, room * sa, room * sb)
        u, v = u + du, v + dv
        if not hypot(u - start_u, v - start_v) <= max_move:
            return False, u, v
        if hypot(du, dv) < _CONVERGED_PX:
            break
    return True, u, v


@njit(cache=True, nogil=True)
def _step(image, u, v, ea, eb, det, sa, sb):
    """(du, dv): step from (u, v) to the point to which the gradients in the window are perpendicular; NaN if there is
    none."""
    u0, u1, v0, v1 = window_bounds(u, v, ea, eb, sa, sb)
    a, b, c, p, q = 0.0, 0.0, 0.0, 0.0, 0.0
    for y in range(v0, v1 + 1):
        for x in range(u0, u1 + 1):
            w = _weight(x - u, y - v, ea, eb, det, sa, sb)
            if w > 0.0:
                gu, gv = _gradient(image, x, y)
                along = gu * (x - u) + gv * (y - v)
                a += w * gu * gu
                b += w * gu * gv
                c += w * gv * gv
                p += w * gu * along
                q += w * gv * along
    full = a * c - b * b
    if full <= 1e-6 * (a + c) * (a + c):
        return np.nan, np.nan
    return (c * p - b * q) / full, (a * q - b * p) / full


@njit(cache=True, nogil=True)
def crossing_contrast(image, u, v, ea, eb, clear, blur):
    """Least white minus most black grey level of the four fields about an X-corner, negative if it is none. The field
    between ea and eb is dark."""
    sa, sb, _ = _coarse_frame(ea, eb, clear, blur)
    room = 0.6 * room_for(image, u, v, ea, eb, sa, sb)
    sa, sb = room * sa, room * sb
    black, white = 0.0, 255.0
    if room == 0.0:
        return 0.0
    for i in range(2):
        for j in range(2):
            s, t = sa * (1 - 2 * i), sb * (1 - 2 * j)
            x, y = u + s * ea[0] + t * eb[0], v + s * ea[1] + t * eb[1]
            value = bilinear(image, x, y)
            if i == j:
                black = max(black, value)
            else:
                white = min(white, value)
    return white - black


_FIT_ITERATIONS = 12
_FIT_CONVERGED_PX = 2e-3
_MOST_STEP_PX = 0.7
# px, and blurs: largest half width of the window; a larger one averages the curvature of distorted edges
_MOST_WINDOW = (6.0, 4.0)
LEAST_WINDOW_PX = 1.5  # px: least half width of the window across the edges
_SIZE = 6  # parameters: u, v, angles of both edges, mean grey level, half the contrast


@njit(cache=True, nogil=True)
def fit_crossing(image, u, v, ea, eb, surroundings, blur_a, blur_b, most_move):
    """(u, v, sigma, contrast, edges (2, EDGE)) of the X-corner near (u, v); sigma is NaN if there is none within
    `most_move` px.

    ea, eb (2,) px: sides of the dark square that meet in the corner; blur_a, blur_b [px]: blur across them.
    surroundings (3,), in units of the sides: distance of the nearest other feature across either edge, and distances
    from both edges at once at which features begin in the dark and in the white fields (inf if there are none).

    sigma [px] is the standard deviation per axis for image noise of one grey level; contrast is in grey levels between
    dark and light; edges as in `edge_fits`.
    """
    edges = np.zeros((2, EDGE))
    sa, sb, margin = _half_widths(image, u, v, ea, eb, surroundings[0], max(blur_a, blur_b))
    if sa == 0.0:
        return u, v, np.nan, 0.0, edges
    xs, ys, grey = _window(image, u, v, ea, eb, sa, sb, surroundings, margin)
    if len(grey) < 2 * _SIZE:
        return u, v, np.nan, 0.0, edges
    contrast = 0.5 * (grey.max() - grey.min())
    p = np.array([u, v, atan2(ea[1], ea[0]), atan2(eb[1], eb[0]), grey.mean(), contrast])
    turn = 1.0 if ea[0] * eb[1] - ea[1] * eb[0] > 0.0 else -1.0
    A, rows = np.zeros((_SIZE, _SIZE)), np.empty((_SIZE + 3, len(grey)))
    for _ in range(_FIT_ITERATIONS):
        _fill_rows(rows, p, xs, ys, grey, turn, blur_a, blur_b)
        step = solve_small(A, normal_equations(A, rows, rows[_SIZE]))
        largest = hypot(step[0], step[1])
        scale = min(1.0, _MOST_STEP_PX / max(largest, 1e-12))
        p += scale * step
        if hypot(p[0] - u, p[1] - v) > most_move or p[5] <= 0.0:
            return u, v, np.nan, 0.0, edges
        if largest < _FIT_CONVERGED_PX:
            _fill_edges(edges, ea, sa, eb, sb, _gain(A, rows))
            return p[0], p[1], _sigma(A), 2.0 * p[5], edges
    return u, v, np.nan, 0.0, edges


@njit(cache=True, nogil=True)
def _half_widths(image, u, v, ea, eb, clear, blur):
    """(sa, sb, margin (2,)), in units of the sides ea, eb: half widths of the window about (u, v), and its distance
    from features in the fields. The half widths are zero if the window would be too narrow.

    clear: distance of the nearest other feature across either edge, in units of the sides; blur [px]."""
    most = max(_MOST_WINDOW[0], _MOST_WINDOW[1] * blur)
    sa, sb, sine = window_frame(ea, eb, clear, blur, LEAST_WINDOW_PX, most)
    room = room_for(image, u, v, ea, eb, sa, sb)
    narrow = min(sa * hypot(ea[0], ea[1]), sb * hypot(eb[0], eb[1])) * sine
    if sine < LEAST_SINE or room * narrow < 0.99 * LEAST_WINDOW_PX:
        return 0.0, 0.0, (0.0, 0.0)
    margin = MARGIN_BLURS * blur / (sine * hypot(ea[0], ea[1])), MARGIN_BLURS * blur / (sine * hypot(eb[0], eb[1]))
    return room * sa, room * sb, margin


@njit(cache=True, nogil=True)
def _window(image, u, v, ea, eb, sa, sb, surroundings, margin):
    """(x (n,), y (n,), grey (n,)) of the pixels in the window (half widths sa, sb in units of the sides) that are at
    least `margin` away from features in the fields."""
    u0, u1, v0, v1 = window_bounds(u, v, ea, eb, sa, sb)
    det = ea[0] * eb[1] - ea[1] * eb[0]
    m = (u1 - u0 + 1) * (v1 - v0 + 1)
    xs, ys, grey, n = np.empty(m), np.empty(m), np.empty(m), 0
    for y in range(v0, v1 + 1):
        for x in range(u0, u1 + 1):
            s = ((x - u) * eb[1] - (y - v) * eb[0]) / det
            t = (ea[0] * (y - v) - ea[1] * (x - u)) / det
            inset = surroundings[1] if s * t > 0.0 else surroundings[2]
            if abs(s) <= sa and abs(t) <= sb and (abs(s) <= inset - margin[0] or abs(t) <= inset - margin[1]):
                xs[n], ys[n], grey[n] = x, y, image[y, x]
                n += 1
    return xs[:n], ys[:n], grey[:n]


@njit(cache=True, nogil=True)
def _fill_rows(rows, p, xs, ys, grey, turn, blur_a, blur_b):
    """Fills rows (9, n): derivatives of the grey level by the six parameters p, the residual, and derivatives by the
    curvature [1 / px] of the edges along ea and eb.

    An edge with curvature c deviates from its tangent by c (t^2 + blur^2) / 2 at a distance t from the corner: blur
    shifts it towards its centre of curvature.
    """
    cos_a, sin_a, cos_b, sin_b = cos(p[2]), sin(p[2]), cos(p[3]), sin(p[3])
    scale_a, scale_b = 1.0 / (sqrt(2.0) * blur_a), 1.0 / (sqrt(2.0) * blur_b)
    for i in range(len(xs)):
        x, y = xs[i] - p[0], ys[i] - p[1]
        # la, lb: distance from the edge along ea towards eb, and from that along eb towards ea. ta, tb: position along
        # both.
        la, lb = turn * (cos_a * y - sin_a * x), turn * (sin_b * x - cos_b * y)
        ta, tb = cos_a * x + sin_a * y, cos_b * x + sin_b * y
        Ea, da = error_function(la * scale_a)
        Eb, db = error_function(lb * scale_b)
        da, db = -p[5] * Eb * da * scale_a, -p[5] * Ea * db * scale_b
        rows[0, i], rows[1, i] = turn * (da * sin_a - db * sin_b), turn * (db * cos_b - da * cos_a)
        rows[2, i], rows[3, i] = -turn * da * ta, turn * db * tb
        rows[4, i], rows[5, i] = 1.0, -Ea * Eb
        rows[6, i] = grey[i] - p[4] + p[5] * Ea * Eb
        # Positive curvature turns left. la grows to the left if `turn` is 1, and lb if it is -1.
        rows[7, i] = turn * 0.5 * da * (ta * ta + blur_a * blur_a)
        rows[8, i] = -turn * 0.5 * db * (tb * tb + blur_b * blur_b)


@njit(cache=True, nogil=True)
def _gain(A, rows):
    """(2, 2) px^2: derivative of the point by the curvature [1 / px] of the edge along ea, and along eb. The fit takes
    the change of grey by a curvature for one by its parameters, so the normal equations give the shift."""
    gain, by = np.empty((2, 2)), np.empty(_SIZE)
    for k in range(2):
        for j in range(_SIZE):
            by[j] = -row_product(rows[j], rows[_SIZE + 1 + k])
        gain[k] = solve_small(A, by)[:2]
    return gain


@njit(cache=True, nogil=True)
def _fill_edges(edges, ea, sa, eb, sb, gain):
    """Fills edges (2, EDGE) with ends and gain of both edges, as in `edge_fits`. The curvature stays zero."""
    for i in range(2):
        edges[0, i], edges[0, 2 + i], edges[0, 4 + i] = -sa * ea[i], sa * ea[i], gain[0, i]
        edges[1, i], edges[1, 2 + i], edges[1, 4 + i] = -sb * eb[i], sb * eb[i], gain[1, i]


@njit(cache=True, nogil=True)
def _sigma(A):
    """Standard deviation per axis [px] of the point: root of half the trace of the 2 x 2 block of A^-1."""
    variance = 0.0
    for k in range(2):
        unit = np.zeros(_SIZE)
        unit[k] = 1.0
        variance += 0.5 * solve_small(A, unit)[k]
    return sqrt(variance) if variance > 0.0 else np.nan
