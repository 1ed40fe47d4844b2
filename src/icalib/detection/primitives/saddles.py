"""Kernels for X-corners, where two dark squares touch: windows around them, and their rough positions."""

from __future__ import annotations

from math import hypot

import numpy as np

from icalib.base.compiled import njit
from icalib.detection.primitives.decoding import bilinear

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
