"""Tags of one family in an image: dark quads whose cells are a pattern of the family."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.base.compiled import njit
from icalib.detection.primitives.decoding import cell_greys, dark_in_ring, levels, lookup, read_cells, unit_homography
from icalib.detection.primitives.edge_model import LEAST_RISE
from icalib.detection.primitives.edges import fit_quad
from icalib.detection.primitives.families import Family
from icalib.detection.primitives.quads import ImageWithQuads

LEAST_CONTRAST = 16.0  # grey levels between black and white of a tag
_WRONG_BORDER = 0.15  # share of the cells of the black border that may be white
_WRONG_RING = 0.15  # share of the samples around the tag that may be dark


@dataclass(frozen=True)
class Tags:
    """Tags in one image: ids (n,) int64; quads (n, 4, 2) px, accurate to about 0.2 px; contrast (n,) grey levels.

    The corners of a tag that is not mirrored are clockwise in the image, from the top left corner of OpenCV's picture
    of it.
    """

    ids: np.ndarray
    quads: np.ndarray
    contrast: np.ndarray


def find_tags(view: ImageWithQuads, family: Family, border_bits: int, window: int, separate: bool) -> Tags:
    """All tags of `family` with a black border of `border_bits` cells.

    An id may appear more than once; a tag that was found as two quads appears once. `window` and `separate` are those
    of `dark_quads`.
    """
    return tags_at(view.image, view.quads(window, separate), family, border_bits)


def tags_at(image: np.ndarray, quads: np.ndarray, family: Family, border_bits: int) -> Tags:
    """The tags of `family` among the quads (n, 4, 2) px, clockwise in the image."""
    ids, fitted, contrast = _decode_all(image, quads, family.bits, border_bits, family.codes, family.max_errors)
    keep = _first_of_each(ids, fitted)
    return Tags(ids[keep], fitted[keep], contrast[keep])


def _first_of_each(ids: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Rows of the decoded tags, without repetitions of one with the same id at the same position."""
    keep: list[int] = []
    for row in np.flatnonzero(ids >= 0):
        center = quads[row].mean(axis=0)
        size = np.ptp(quads[row], axis=0).max()
        same = [k for k in keep if ids[k] == ids[row]]
        if all(np.abs(quads[k].mean(axis=0) - center).max() > 0.5 * size for k in same):
            keep.append(int(row))
    return np.array(keep, dtype=np.int64)


@njit(cache=True, nogil=True)
def _decode_all(image, quads, bits, border, codes, max_errors):
    """(ids (n,), quads (n, 4, 2), contrast (n,)) of the quads after a fit of their sides; id -1 if a quad is no tag."""
    n = len(quads)
    ids, contrast = np.full(n, -1, dtype=np.int64), np.zeros(n)
    fitted = np.empty((n, 4, 2))
    for i in range(n):
        side = shortest_side(quads[i])
        reach = min(max(2.0, 0.1 * side), 12.0)
        fits, quad = fit_quad(image, quads[i], reach, LEAST_RISE)
        if fits:
            fits, quad = fit_quad(image, quad, min(2.0, 0.1 * side + 0.5), LEAST_RISE)
        if fits:
            ids[i], turn, contrast[i] = decode(image, quad, bits, border, codes, max_errors)
            for k in range(4):
                fitted[i, k] = quad[(k + 4 - turn) % 4]
    return ids, fitted, contrast


@njit(cache=True, nogil=True)
def shortest_side(quad):
    """Length [px] of the shortest side of the quad (4, 2)."""
    least = 1e300
    for k in range(4):
        du, dv = quad[(k + 1) % 4, 0] - quad[k, 0], quad[(k + 1) % 4, 1] - quad[k, 1]
        least = min(least, np.sqrt(du * du + dv * dv))
    return least


@njit(cache=True, nogil=True)
def decode(image, quad, bits, border, codes, max_errors):
    """(id, turn, contrast): the tag inside the quad, id -1 if there is none. Corner k of the tag is quad[(k - turn) %
    4]."""
    n = bits + 2 * border
    grey = cell_greys(image, unit_homography(quad), n)
    black, white = levels(grey, border)
    contrast = white - black
    if contrast < LEAST_CONTRAST or np.isnan(grey).any():
        return -1, 0, contrast
    threshold = 0.5 * (black + white)
    code, wrong = read_cells(grey, border, threshold)
    if wrong > _WRONG_BORDER * (n * n - bits * bits) or dark_in_ring(grey, threshold) > _WRONG_RING * 4 * n:
        return -1, 0, contrast
    tag, turn, errors = lookup(code, codes)
    if errors > max_errors:
        return -1, 0, contrast
    return tag, turn, contrast
