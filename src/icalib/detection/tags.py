"""Tags of one family in an image: dark quads whose cells are a pattern of the family.

Dark quads in an image, which are candidates for tags. Families of tags: the bit patterns of all ids, packed for a fast
lookup.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from math import comb

import numpy as np

from icalib.base.compiled import njit
from icalib.base.extras import load_cv2
from icalib.detection.decoding import (
    cell_greys,
    checked_image,
    dark_in_ring,
    least_distance,
    levels,
    lookup,
    read_cells,
    unit_homography,
)
from icalib.detection.edge_model import LEAST_RISE, fit_quad
from icalib.geometry.targets.families import family_name, is_apriltag, opencv_bits

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


_QUAD_CONTRAST = 7  # grey levels below the local mean at which a pixel is dark
_LEAST_SIDE_PX = 7.0  # longer side of the bounding box, at least
_LEAST_FILL = 0.75  # share of its quad's area that a contour covers, at least
_STRAIGHT_SIDE = 0.05  # of the perimeter: largest distance of a contour from its polygon
_WINDOW_SHARES = (0.08, 0.03, 0.2)  # widths of the windows of the local mean, as shares of the image's width


@dataclass(frozen=True, eq=False)
class ImageWithQuads:
    """An image (h, w) uint8 with a cache of its dark quads, which several detectors share.

    Raises RecordingError for an image that is not grey with 8 bits.
    """

    image: np.ndarray
    _quads: dict[tuple[int, bool], np.ndarray] = field(default_factory=dict)
    _ids: dict[tuple[str, int], np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "image", checked_image(self.image))

    @property
    def windows(self) -> tuple[int, ...]:
        """Windows [px] of `threshold_windows` for this image."""
        return threshold_windows(self.image.shape[1])

    def quads(self, window: int, separate: bool) -> np.ndarray:
        """`dark_quads` of the image, from the cache if known."""
        if (window, separate) not in self._quads:
            self._quads[window, separate] = dark_quads(self.image, window, separate)
        return self._quads[window, separate]

    def ids(self, family: str, border_bits: int) -> np.ndarray:
        """(n,) ids of all tags of `family` at the quads of every window, from the cache if known."""
        if (family, border_bits) not in self._ids:
            quads = np.concatenate([self.quads(window, apart) for window in self.windows for apart in (True, False)])
            self._ids[family, border_bits] = tags_at(self.image, quads, tag_family(family), border_bits).ids
        return self._ids[family, border_bits]


def dark_quads(image: np.ndarray, window: int, separate: bool) -> np.ndarray:
    """(n, 4, 2) px: clockwise corners of dark regions with about four straight sides, accurate to about 2 px.

    image (h, w) uint8. Pixels are dark if they are darker than the mean of `window` x `window` px (odd). With
    `separate`, dark regions are first eroded by one pixel, so that tags whose corners touch other dark squares are
    separated.
    """
    cv2 = load_cv2()
    dark = cv2.adaptiveThreshold(
        image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, float(_QUAD_CONTRAST)
    )
    if separate:
        dark = cv2.erode(dark, np.ones((3, 3), dtype=np.uint8))
    contours, hierarchy = cv2.findContours(dark, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    if hierarchy is None:
        return np.zeros((0, 4, 2))
    quads = []
    for contour, parent in zip(contours, hierarchy[0, :, 3], strict=True):
        if parent < 0 and len(contour) >= 4:
            quad = _quad(cv2, contour)
            if quad is not None:
                quads.append(_grown(quad) if separate else quad)
    return np.array(quads).reshape(-1, 4, 2)


def _quad(cv2, contour: np.ndarray) -> np.ndarray | None:
    """The quad (4, 2) of a contour, clockwise; None if it is too small, has not four corners, or fills too little of
    its quad."""
    _, _, width, height = cv2.boundingRect(contour)
    if max(width, height) < _LEAST_SIDE_PX or min(width, height) < 0.25 * _LEAST_SIDE_PX:
        return None
    hull = cv2.convexHull(contour)
    corners = cv2.approxPolyDP(hull, _STRAIGHT_SIDE * cv2.arcLength(hull, True), True)
    if len(corners) != 4:
        return None
    quad = corners[:, 0, :].astype(np.float64)
    area = cv2.contourArea(corners, True)
    if cv2.contourArea(contour) < _LEAST_FILL * abs(area):
        return None
    return quad if area > 0 else quad[::-1]


def _grown(quad: np.ndarray) -> np.ndarray:
    """The quad with each corner moved outwards by one diagonal pixel."""
    out = quad - quad.mean(axis=0)
    return quad + np.sqrt(2.0) * out / np.linalg.norm(out, axis=1, keepdims=True)


def threshold_windows(width: int) -> tuple[int, ...]:
    """Windows [px] of `dark_quads` for images of this width, in the order in which they are tried."""
    return tuple(max(2 * int(0.5 * share * width) + 1, 11) for share in _WINDOW_SHARES)


_FALSE_ALARMS = 1e-3  # largest share of random patterns that may be accepted as tags


@dataclass(frozen=True)
class Family:
    """One family of tags with `bits` x `bits` data cells. codes (n, 4) uint64: the pattern of id i, rotated by 0 to 3
    quarter turns.

    Patterns are OpenCV's, packed row by row from the top left cell, the first cell in the highest bit, white as 1.
    max_errors: wrong cells with which a pattern is still accepted.
    """

    name: str
    bits: int
    codes: np.ndarray
    max_errors: int

    @property
    def is_apriltag(self) -> bool:
        """Whether this is a family of AprilTags, not of ArUco markers."""
        return is_apriltag(self.name)


@lru_cache(maxsize=32)
def tag_family(name: str) -> Family:
    """The family of this name. Raises RigError if there is none, see `family_name`."""
    name = family_name(name)
    patterns = opencv_bits(name)
    n, bits, _ = patterns.shape
    codes = np.array([[_packed(np.rot90(pattern, turn)) for turn in range(4)] for pattern in patterns])
    correctable = (int(least_distance(codes)) - 1) // 2
    return Family(name, bits, codes, min(correctable, _errors_allowed(4 * n, bits * bits)))


def _errors_allowed(n_codes: int, n_cells: int) -> int:
    """Largest number of wrong cells at which at most `_FALSE_ALARMS` of all random patterns are accepted."""
    errors, accepted = 0, n_codes
    while (accepted := accepted + n_codes * comb(n_cells, errors + 1)) <= _FALSE_ALARMS * 2.0**n_cells:
        errors += 1
    return errors


def _packed(pattern: np.ndarray) -> np.uint64:
    """The cells of a pattern as uint64, the first cell in the highest bit."""
    value = 0
    for cell in pattern.ravel():
        value = 2 * value + int(cell)
    return np.uint64(value)
