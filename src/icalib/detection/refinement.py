"""Kernels that refine the corners of many tags at once and measure what their quality follows from."""

from __future__ import annotations

from math import hypot, log, pi, sqrt

import numpy as np
from numba import njit

from icalib.detection.decoding import bilinear
from icalib.detection.edge_model import fit_corners
from icalib.detection.growth import refine_crossings, side_vectors
from icalib.detection.saddles import crossing_contrast, window_frame
from icalib.detection.tags import LEAST_CONTRAST

_MOST_MOVE_PX = 2.0
_BLUR_AT = 0.7  # of half a window's width: where the blur of an X-corner's edges is measured
_HALF_STRIP = (1.5, 4.0)  # px, least and most that are fitted on each side of an edge
_STRIP = 0.6  # of the distance to the nearest other feature
_ERF_INVERSE = 0.147  # Winitzki's constant


@njit(cache=True, nogil=True)
def blur_of_rise(share):
    """Gaussian blur [px] of a step of which `share`, 0 to 1, lies within 1 px of its middle."""
    x = min(max(share, 0.02), 0.98)
    r = log(1.0 - x * x)
    a = 2.0 / (pi * _ERF_INVERSE) + 0.5 * r
    return 1.0 / sqrt(2.0 * (sqrt(a * a - r / _ERF_INVERSE) - a))


@njit(cache=True, nogil=True)
def _rise(image, u, v, nu, nv):
    """Absolute difference of grey over 2 px along (nu, nv) about (u, v); 0 where it leaves the image."""
    width, height = image.shape[1] - 1.0, image.shape[0] - 1.0
    inside_u = min(u - abs(nu), width - u - abs(nu)) >= 0.0
    if not (inside_u and min(v - abs(nv), height - v - abs(nv)) >= 0.0):
        return 0.0
    return abs(bilinear(image, u + nu, v + nv) - bilinear(image, u - nu, v - nv))


@njit(cache=True, nogil=True)
def crossing_blur(image, u, v, ea, eb, clear, contrast):
    """Blur [px] of the blurrier of the two edges that cross at (u, v); contrast is that of the corner's fields."""
    sa, sb, _ = window_frame(ea, eb, clear)
    worst = 1.0
    for axis in range(2):
        e, s = (ea, _BLUR_AT * sa) if axis == 0 else (eb, _BLUR_AT * sb)
        length = hypot(e[0], e[1])
        nu, nv = -e[1] / length, e[0] / length
        rise = _rise(image, u + s * e[0], v + s * e[1], nu, nv) + _rise(image, u - s * e[0], v - s * e[1], nu, nv)
        worst = min(worst, 0.5 * rise / max(contrast, 1.0))
    return blur_of_rise(worst)


@njit(cache=True, nogil=True)
def _shape(quad, k, clear):
    """(sine of the angle at corner k, distance [px] to the nearest other feature, shorter side [px])."""
    ea, eb = side_vectors(quad, k)
    la, lb = hypot(ea[0], ea[1]), hypot(eb[0], eb[1])
    sine = abs(ea[0] * eb[1] - ea[1] * eb[0]) / max(la * lb, 1e-12)
    return sine, clear * min(la, lb) * sine, min(la, lb)


@njit(cache=True, nogil=True)
def refined_crossings(image, quads, clear):
    """(uv (n, 4, 2), quality (5, n, 4)) of the X-corners of the quads (n, 4, 2).

    quality: sigma [px] per axis for a noise of one grey level, NaN where there is no corner; blur [px]; sine of the
    angle between the edges; distance [px] to the nearest other feature; shorter side [px]. `clear` is that distance
    in units of the quad's sides.
    """
    uv, quality = np.empty(quads.shape), np.empty((5, len(quads), 4))
    for i in range(len(quads)):
        uv[i], quality[0, i] = refine_crossings(image, quads[i], clear, _MOST_MOVE_PX)
        for k in range(4):
            ea, eb = side_vectors(quads[i], k)
            quality[2, i, k], quality[3, i, k], quality[4, i, k] = _shape(quads[i], k, clear)
            contrast = crossing_contrast(image, uv[i, k, 0], uv[i, k, 1], ea, eb, clear)
            quality[1, i, k] = crossing_blur(image, uv[i, k, 0], uv[i, k, 1], ea, eb, clear, contrast)
            if contrast < LEAST_CONTRAST:
                quality[0, i, k] = np.nan
    return uv, quality


@njit(cache=True, nogil=True)
def refined_corners(image, quads, clear):
    """As `refined_crossings`, of the L-corners of dark quads whose corners run clockwise in the image."""
    uv, quality = np.empty(quads.shape), np.empty((5, len(quads), 4))
    for i in range(len(quads)):
        least = 1e300
        for k in range(4):
            quality[2, i, k], quality[3, i, k], quality[4, i, k] = _shape(quads[i], k, clear)
            least = min(least, quality[3, i, k])
        half = min(max(_STRIP * least, _HALF_STRIP[0]), _HALF_STRIP[1])
        uv[i], quality[0, i], quality[1, i] = fit_corners(image, quads[i], half)
        for k in range(4):
            if hypot(uv[i, k, 0] - quads[i, k, 0], uv[i, k, 1] - quads[i, k, 1]) > _MOST_MOVE_PX:
                quality[0, i, k] = np.nan
    return uv, quality
