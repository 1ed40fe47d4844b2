"""Kernels that refine the corners of many tags at once, and measure the quality of each corner."""

from __future__ import annotations

from math import hypot

import numpy as np

from icalib.base.compiled import njit
from icalib.detection.primitives.crossing_model import LEAST_WINDOW_PX, fit_crossing
from icalib.detection.primitives.edge_model import END_PX, USUAL_BLUR_PX, fit_corners, step_blur
from icalib.detection.primitives.growth import side_vectors
from icalib.detection.primitives.saddles import MARGIN_BLURS
from icalib.detection.primitives.tags import LEAST_CONTRAST, shortest_side
from icalib.geometry.edge_fits import EDGE

# px, and of a side, the larger of both: largest distance of a corner from its rough position
_MOST_CORNER_MOVE = (2.0, 0.03)
_LEAST_STRIP_PX = 1.5  # least half width of the fitted strip along an edge
_MOST_STRIP = (4.0, 3.0)  # px, and blurs: largest half width of the same strip
_STRIP_BLURS = 2.25  # blurs between the strip along an edge and other features
_BLUR_STRIP = (2.5, 0.06)  # px, and of a side: largest half width of the strip if only the blur is measured
_LEAST_INSET_PX = (1.0, 0.5)  # as LEAST_WINDOW_PX, for features in the dark and in the white fields
_END_BLURS = 2.4  # blurs left out at the ends of a side
MEASURES = 5  # number of rows of `quality` before those of the edges


@njit(cache=True, nogil=True)
def _shape(quad, k):
    """(sine of the angle at corner k, height [px] of the quad over its longer side there, shorter side [px])."""
    ea, eb = side_vectors(quad, k)
    la, lb = hypot(ea[0], ea[1]), hypot(eb[0], eb[1])
    sine = abs(ea[0] * eb[1] - ea[1] * eb[0]) / max(la * lb, 1e-12)
    return sine, min(la, lb) * sine, min(la, lb)


@njit(cache=True, nogil=True)
def _strip(least, blur, most):
    """Half width [px] of the strip along an edge, if the nearest other feature is `least` px away."""
    return min(max(least - _STRIP_BLURS * blur, _LEAST_STRIP_PX), most)


@njit(cache=True, nogil=True)
def _measured_blur(image, quad, k, least):
    """Blur [px] across side k of the quad, or side k + 2 if k has no edge; NaN if neither has one."""
    most = max(_BLUR_STRIP[0], _BLUR_STRIP[1] * shortest_side(quad))
    for m in (k, k + 2):
        u0, v0, u1, v1 = quad[m, 0], quad[m, 1], quad[(m + 1) % 4, 0], quad[(m + 1) % 4, 1]
        blur, contrast = step_blur(image, u0, v0, u1, v1, END_PX, _strip(least, USUAL_BLUR_PX, most))
        if contrast > 0.0:
            return blur
    return np.nan


@njit(cache=True, nogil=True)
def _measured_blurs(image, quads, least):
    """(n, 2) blur [px] across each quad's sides 0 and 1; the median over the image if they have no edge."""
    blur = np.empty((len(quads), 2))
    for i in range(len(quads)):
        for k in range(2):
            blur[i, k] = _measured_blur(image, quads[i], k, least[i])
    known = blur.ravel()[~np.isnan(blur.ravel())]
    usual = np.median(known) if len(known) else USUAL_BLUR_PX
    for i in range(len(quads)):
        for k in range(2):
            if np.isnan(blur[i, k]):
                blur[i, k] = usual
    return blur


@njit(cache=True, nogil=True)
def _shapes(quads, quality):
    """Fills the rows sine, height and side of `quality`; returns (n,) the least height [px] of each quad."""
    least = np.empty(len(quads))
    for i in range(len(quads)):
        for k in range(4):
            quality[2, i, k], quality[3, i, k], quality[4, i, k] = _shape(quads[i], k)
        least[i] = quality[3, i].min()
    return least


@njit(cache=True, nogil=True)
def refined_crossings(image, quads, surroundings):
    """(uv (n, 4, 2) px, quality (5 + 2 EDGE, n, 4)) of the X-corners at the quads (n, 4, 2) px.

    surroundings: as in `fit_crossing`. Rows of quality: sigma [px] per axis for image noise of one grey level, NaN if
    there is no corner; blur [px]; sine of the angle between the edges; distance to the nearest other feature minus the
    distance that the smallest window needs [px]; shorter side [px]; both edges of the corner, as in `edge_fits`.
    """
    uv, quality = np.empty(quads.shape), np.empty((MEASURES + 2 * EDGE, len(quads), 4))
    blur = _measured_blurs(image, quads, surroundings.min() * _shapes(quads, quality))
    for i in range(len(quads)):
        quality[1, i] = blur[i].max()
        for k in range(4):
            ea, eb = side_vectors(quads[i], k)
            most_move = max(_MOST_CORNER_MOVE[0], _MOST_CORNER_MOVE[1] * quality[4, i, k])
            blur_a, blur_b = blur[i, k % 2], blur[i, (k + 1) % 2]
            u, v, sigma, contrast, edges = fit_crossing(
                image, quads[i, k, 0], quads[i, k, 1], ea, eb, surroundings, blur_a, blur_b, most_move
            )
            uv[i, k, 0], uv[i, k, 1] = u, v
            quality[0, i, k] = sigma if contrast >= LEAST_CONTRAST else np.nan
            quality[MEASURES:, i, k] = edges.ravel()
    room = surroundings[0] * quality[3] - LEAST_WINDOW_PX
    for k in range(2):
        room = np.minimum(room, surroundings[1 + k] * quality[3] - _LEAST_INSET_PX[k])
    quality[3] = room - MARGIN_BLURS * quality[1]
    return uv, quality


@njit(cache=True, nogil=True)
def refined_corners(image, quads, clear):
    """As `refined_crossings`, for the L-corners of dark quads with clockwise corners in the image.

    clear: distance of the nearest other feature, in units of the quad's sides.
    """
    uv, quality = np.empty(quads.shape), np.empty((MEASURES + 2 * EDGE, len(quads), 4))
    least = clear * _shapes(quads, quality)
    for i in range(len(quads)):
        most = max(_MOST_STRIP[0], _BLUR_STRIP[1] * shortest_side(quads[i]))
        first, _, blur, _ = fit_corners(image, quads[i], END_PX, _strip(least[i], USUAL_BLUR_PX, most))
        half = _strip(least[i], blur.max(), max(_MOST_STRIP[0], _MOST_STRIP[1] * blur.max()))
        end = max(END_PX, _END_BLURS * blur.max())
        uv[i], quality[0, i], quality[1, i], edges = fit_corners(image, first, end, half)
        for k in range(4):
            quality[MEASURES:, i, k] = edges[k].ravel()
            most_move = max(_MOST_CORNER_MOVE[0], _MOST_CORNER_MOVE[1] * quality[4, i, k])
            if hypot(uv[i, k, 0] - quads[i, k, 0], uv[i, k, 1] - quads[i, k, 1]) > most_move:
                quality[0, i, k] = np.nan
    quality[3] = clear * quality[3] - _LEAST_STRIP_PX - _STRIP_BLURS * quality[1]
    return uv, quality
