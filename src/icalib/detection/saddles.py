"""Kernel that refines corners where two dark squares touch: X-corners.

An X-corner is point symmetric, however blurred and however oblique, so the point towards which all gradients of a
symmetric window are perpendicular is free of bias, as long as nothing else reaches into the window.
"""

from __future__ import annotations

from math import hypot, sqrt

import numpy as np
from numba import njit

from icalib.detection.decoding import bilinear

LEAST_HALF_PX = 1.5  # half a window's width; fewer pixels than that hold no corner
MOST_HALF_PX = 6.0  # more average the bend of a distorted edge into the corner
MARGIN_BLURS = 1.5  # how far, in blurs, a neighbouring feature reaches into the window
_ITERATIONS = 12
_CONVERGED_PX = 1e-3
_LEAST_SINE = 0.17  # of the angle between the edges: 10 degrees


@njit(cache=True, nogil=True)
def window_frame(ea, eb, clear, blur):
    """(sa, sb, sine): half a window's width in units of the sides ea, eb (2,) px that meet in the corner.

    `clear` is the distance of the nearest other feature in the same units. The window keeps away from it by 1.5 times the
    blur [px], and is 1.5 to 6 px wide across the edges.
    """
    la, lb = hypot(ea[0], ea[1]), hypot(eb[0], eb[1])
    sine = abs(ea[0] * eb[1] - ea[1] * eb[0]) / max(la * lb, 1e-12)
    across, margin = max(sine, _LEAST_SINE), MARGIN_BLURS * blur
    sa = min(max(clear - margin / (la * across), LEAST_HALF_PX / (la * across)), MOST_HALF_PX / la)
    sb = min(max(clear - margin / (lb * across), LEAST_HALF_PX / (lb * across)), MOST_HALF_PX / lb)
    return max(sa, LEAST_HALF_PX / la), max(sb, LEAST_HALF_PX / lb), sine


@njit(cache=True, nogil=True)
def _room(image, u, v, ea, eb, sa, sb):
    """By what factor, at most 1, a window must be scaled so that all its pixels have neighbours in the image."""
    ru = abs(ea[0]) * sa + abs(eb[0]) * sb
    rv = abs(ea[1]) * sa + abs(eb[1]) * sb
    room_u, room_v = min(u, image.shape[1] - 1.0 - u) - 1.0, min(v, image.shape[0] - 1.0 - v) - 1.0
    return max(min(1.0, min(room_u / ru, room_v / rv)), 0.0)


@njit(cache=True, nogil=True)
def _bounds(u, v, ea, eb, sa, sb):
    """(u0, u1, v0, v1) of the pixels that the window may touch."""
    ru = abs(ea[0]) * sa + abs(eb[0]) * sb
    rv = abs(ea[1]) * sa + abs(eb[1]) * sb
    return int(np.ceil(u - ru)), int(np.floor(u + ru)), int(np.ceil(v - rv)), int(np.floor(v + rv))


@njit(cache=True, nogil=True)
def _weight(du, dv, ea, eb, det, sa, sb):
    s = (du * eb[1] - dv * eb[0]) / det / sa
    t = (ea[0] * dv - ea[1] * du) / det / sb
    s, t = 1.0 - s * s, 1.0 - t * t
    return s * t if s > 0.0 and t > 0.0 else 0.0


@njit(cache=True, nogil=True)
def _gradient(image, x, y):
    """Central differences; float before the difference, for grey levels are unsigned."""
    gu = 0.5 * (float(image[y, x + 1]) - float(image[y, x - 1]))
    gv = 0.5 * (float(image[y + 1, x]) - float(image[y - 1, x]))
    return gu, gv


@njit(cache=True, nogil=True)
def refine_saddle(image, u, v, ea, eb, clear, blur, max_move):
    """(u, v, sigma) of the X-corner near (u, v); sigma is NaN where there is none within `max_move` px.

    ea, eb (2,) px are the sides of the dark square that meet in the corner, `clear` is how far, in units of them, the
    nearest other feature is, blur [px] that of the image. sigma is the standard deviation [px] per axis for an image noise of one grey level.
    """
    sa, sb, sine = window_frame(ea, eb, clear, blur)
    det = ea[0] * eb[1] - ea[1] * eb[0]
    u_start, v_start = u, v
    if sine < _LEAST_SINE:
        return u, v, np.nan
    a, b, c, room = 0.0, 0.0, 0.0, 1.0
    for _ in range(_ITERATIONS):
        room = _room(image, u, v, ea, eb, sa, sb)
        if room * min(sa * hypot(ea[0], ea[1]), sb * hypot(eb[0], eb[1])) * sine < 0.99 * LEAST_HALF_PX:
            return u, v, np.nan
        u0, u1, v0, v1 = _bounds(u, v, ea, eb, room * sa, room * sb)
        a, b, c, p, q = 0.0, 0.0, 0.0, 0.0, 0.0
        for y in range(v0, v1 + 1):
            for x in range(u0, u1 + 1):
                w = _weight(x - u, y - v, ea, eb, det, room * sa, room * sb)
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
            return u, v, np.nan
        du, dv = (c * p - b * q) / full, (a * q - b * p) / full
        u, v = u + du, v + dv
        if hypot(u - u_start, v - v_start) > max_move:
            return u, v, np.nan
        if hypot(du, dv) < _CONVERGED_PX:
            break
    return u, v, _sigma(image, u, v, ea, eb, room * sa, room * sb, a, b, c)


@njit(cache=True, nogil=True)
def _sigma(image, u, v, ea, eb, sa, sb, a, b, c):
    """Standard deviation per axis from unit noise in each pixel, carried through the sums of `refine_saddle`.

    There, noise n enters as sum w g (grad n . d); summed by parts, a pixel's share is the divergence of w g d.
    """
    room = _room(image, u, v, ea, eb, sa, sb)
    sa, sb = room * sa, room * sb
    u0, u1, v0, v1 = _bounds(u, v, ea, eb, sa, sb)
    det = ea[0] * eb[1] - ea[1] * eb[0]
    share = np.zeros((v1 - v0 + 3, u1 - u0 + 3, 2))
    for y in range(v0, v1 + 1):
        for x in range(u0, u1 + 1):
            w = _weight(x - u, y - v, ea, eb, det, sa, sb)
            if w > 0.0:
                gu, gv = _gradient(image, x, y)
                for k in range(2):
                    g = 0.5 * w * (gu if k == 0 else gv)
                    i, j = y - v0 + 1, x - u0 + 1
                    share[i, j + 1, k] += g * (x - u)
                    share[i, j - 1, k] -= g * (x - u)
                    share[i + 1, j, k] += g * (y - v)
                    share[i - 1, j, k] -= g * (y - v)
    full, variance = a * c - b * b, 0.0
    for i in range(share.shape[0]):
        for j in range(share.shape[1]):
            p, q = share[i, j, 0], share[i, j, 1]
            variance += ((c * p - b * q) ** 2 + (a * q - b * p) ** 2) / (full * full)
    return sqrt(0.5 * variance)


@njit(cache=True, nogil=True)
def crossing_contrast(image, u, v, ea, eb, clear, blur):
    """Least white minus most black grey of the four fields about an X-corner; the dark one lies between ea and eb."""
    sa, sb, _ = window_frame(ea, eb, clear, blur)
    room = 0.6 * _room(image, u, v, ea, eb, sa, sb)
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
