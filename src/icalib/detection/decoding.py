"""What targets consist of: edges, saddles, quads, tags, ellipses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from itertools import pairwise

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import CornerStream
from icalib.errors import RecordingError
from icalib.geometry.planes import EDGE, NO_EDGES

# Compiled: reads the cells of a tag through a homography, and looks up its pattern.

_M1, _M2, _M4 = np.uint64(0x5555555555555555), np.uint64(0x3333333333333333), np.uint64(0x0F0F0F0F0F0F0F0F)
_SUM, _ONE, _TWO, _FOUR, _TOP = np.uint64(0x0101010101010101), np.uint64(1), np.uint64(2), np.uint64(4), np.uint64(56)
_SPREAD = 0.2  # of a cell: distance from its centre to the four other sampled points
_SHARPEN = 0.25  # factor on the Laplacian over cells, which is added against the blur of small tags


@njit(cache=True, nogil=True)
def popcount(x):
    """Number of ones in a uint64."""
    x = x - ((x >> _ONE) & _M1)
    x = (x & _M2) + ((x >> _TWO) & _M2)
    x = (x + (x >> _FOUR)) & _M4
    return np.int64((x * _SUM) >> _TOP)


@njit(cache=True, nogil=True)
def least_distance(codes):
    """Least number of cells in which two of the patterns (n, 4) uint64 differ, rotations of one pattern included."""
    least = 64
    for i in range(len(codes)):
        for j in range(i, len(codes)):
            for turn in range(4):
                if (i != j or turn > 0) and codes[i, 0] != codes[j, turn]:
                    least = min(least, popcount(codes[i, 0] ^ codes[j, turn]))
    return least


@njit(cache=True, nogil=True)
def lookup(code, codes):
    """(id, turn, wrong cells) of the pattern nearest to `code` (uint64). codes (n, 4): patterns in four rotations."""
    best, best_id, best_turn = 65, -1, 0
    for i in range(len(codes)):
        for turn in range(4):
            distance = popcount(code ^ codes[i, turn])
            if distance < best:
                best, best_id, best_turn = distance, i, turn
    return best_id, best_turn, best


@njit(cache=True, nogil=True)
def bilinear(image, u, v):
    """Grey level at (u, v) px by bilinear interpolation. (u, v) must lie within the outermost pixel centres."""
    x, y = int(u), int(v)
    x, y = min(x, image.shape[1] - 2), min(y, image.shape[0] - 2)
    a, b = u - x, v - y
    top = (1.0 - a) * image[y, x] + a * image[y, x + 1]
    low = (1.0 - a) * image[y + 1, x] + a * image[y + 1, x + 1]
    return (1.0 - b) * top + b * low


def nearest_greys(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Grey levels (...) float64 of the image (h, w) at the pixels nearest to uv (..., 2) px, clipped to the image."""
    u, v = np.moveaxis(np.rint(uv).astype(np.int64), -1, 0)
    return image[v.clip(0, image.shape[0] - 1), u.clip(0, image.shape[1] - 1)].astype(np.float64)


@njit(cache=True, nogil=True)
def unit_homography(quad):
    """(3, 3) H from the unit square (0,0), (1,0), (1,1), (0,1) to the quad (4, 2); zeros if the quad is degenerate."""
    x0, y0, x1, y1 = quad[0, 0], quad[0, 1], quad[1, 0], quad[1, 1]
    x2, y2, x3, y3 = quad[2, 0], quad[2, 1], quad[3, 0], quad[3, 1]
    dx1, dx2, sx = x1 - x2, x3 - x2, x0 - x1 + x2 - x3
    dy1, dy2, sy = y1 - y2, y3 - y2, y0 - y1 + y2 - y3
    det = dx1 * dy2 - dx2 * dy1
    H = np.zeros((3, 3))
    if det == 0.0:
        return H
    g, h = (sx * dy2 - dx2 * sy) / det, (dx1 * sy - sx * dy1) / det
    H[0, 0], H[0, 1], H[0, 2] = x1 - x0 + g * x1, x3 - x0 + h * x3, x0
    H[1, 0], H[1, 1], H[1, 2] = y1 - y0 + g * y1, y3 - y0 + h * y3, y0
    H[2, 0], H[2, 1], H[2, 2] = g, h, 1.0
    return H


@njit(cache=True, nogil=True)
def mapped(H, x, y):
    """(u, v) of the point (x, y) under H; (-1e9, -1e9) if the point is not in front of the camera."""
    w = H[2, 0] * x + H[2, 1] * y + H[2, 2]
    if w <= 1e-9:
        return -1e9, -1e9
    return (H[0, 0] * x + H[0, 1] * y + H[0, 2]) / w, (H[1, 0] * x + H[1, 1] * y + H[1, 2]) / w


@njit(cache=True, nogil=True)
def _sample(image, H, x, y, spread):
    """Mean grey level of five points about (x, y), `spread` apart; NaN if one is outside the image."""
    total = 0.0
    for k in range(5):
        dx = spread * ((k == 1) - (k == 2))
        dy = spread * ((k == 3) - (k == 4))
        u, v = mapped(H, x + dx, y + dy)
        if not (0.0 <= u <= image.shape[1] - 1.0 and 0.0 <= v <= image.shape[0] - 1.0):
            return np.nan
        total += bilinear(image, u, v)
    return total / 5.0


@njit(cache=True, nogil=True)
def cell_greys(image, H, n):
    """(n + 2, n + 2) grey levels of the n x n cells of a tag and of the ring around it; NaN outside the image.

    H maps the unit square to the tag. The ring is sampled half a cell outside the tag's edge.
    """
    grey = np.empty((n + 2, n + 2))
    for row in range(n + 2):
        for col in range(n + 2):
            grey[row, col] = _sample(image, H, (col - 0.5) / n, (row - 0.5) / n, _SPREAD / n)
    return grey


@njit(cache=True, nogil=True)
def levels(grey, border):
    """(black, white): mean grey level of the tag's border, `border` cells wide, and of the ring around it without
    corners."""
    n = len(grey) - 2
    black, n_black, white, n_white = 0.0, 0, 0.0, 0
    for row in range(n + 2):
        for col in range(n + 2):
            value = grey[row, col]
            depth = min(min(row, col), min(n + 1 - row, n + 1 - col))
            if np.isnan(value):
                continue
            if depth == 0 and 1 < row + col < 2 * n + 1 and abs(row - col) < n:
                white += value
                n_white += 1
            elif 1 <= depth <= border:
                black += value
                n_black += 1
    if n_black == 0 or n_white == 0:
        return 0.0, 0.0
    return black / n_black, white / n_white


@njit(cache=True, nogil=True)
def dark_in_ring(grey, threshold):
    """Number of samples of the ring around the tag, without its corners, that are not brighter than the threshold."""
    m, dark = len(grey) - 1, 0
    for k in range(1, m):
        dark += (not grey[0, k] > threshold) + (not grey[m, k] > threshold)
        dark += (not grey[k, 0] > threshold) + (not grey[k, m] > threshold)
    return dark


@njit(cache=True, nogil=True)
def _sharpened(grey, row, col):
    """Grey level of a cell with its negative Laplacian over cells added; the level itself beside unseen cells."""
    value, total = grey[row, col], 0.0
    total = grey[row - 1, col] + grey[row + 1, col] + grey[row, col - 1] + grey[row, col + 1]
    return value if np.isnan(total) else value + _SHARPEN * (4.0 * value - total)


@njit(cache=True, nogil=True)
def read_cells(grey, border, threshold):
    """(code, wrong): data cells as uint64, row by row with white as 1, and the number of border cells that are white.
    Cells outside the image count as black."""
    n = len(grey) - 2
    code, wrong = np.uint64(0), 0
    for row in range(1, n + 1):
        for col in range(1, n + 1):
            white = _sharpened(grey, row, col) > threshold
            depth = min(min(row, col), min(n + 1 - row, n + 1 - col))
            if depth > border:
                code = (code << _ONE) | (_ONE if white else np.uint64(0))
            elif white:
                wrong += 1
    return code, wrong


@njit(cache=True, nogil=True)
def visible_cells(grey, border):
    """uint64 with a one for each data cell inside the image, in the order of `read_cells`."""
    n = len(grey) - 2
    mask = np.uint64(0)
    for row in range(border + 1, n + 1 - border):
        for col in range(border + 1, n + 1 - border):
            mask = (mask << _ONE) | (np.uint64(0) if np.isnan(grey[row, col]) else _ONE)
    return mask


# The corners of one image as a detector returns them, and the rules by which corners are dropped.

IMAGE_NOISE = 2.0  # grey levels, assumed for every image: sigmas are right up to a common factor
MODEL_SIGMA_PX = 0.02  # standard deviation by sampling, printing and the lens, added to that by noise
MOST_SIGMA_PX = 0.25  # corners with a larger sigma are faint
# Sigma [px] of an L-corner for each px by which the nearest other feature is too near, up to MOST_LACKS_PX. On rendered
# tags of 12 to 28 px under three blurs, errors are 0.08 to 0.13 px per px and axis, outwards, because bits near an edge
# lighten its dark side. Beyond the limit they grow faster.
CROWDED, MOST_LACKS_PX = 0.12, 1.25
LEAST_ANGLE_DEG = 15.0  # angle between the edges of a corner, below which it is oblique

VERDICTS = ("kept", "faint", "blurred", "oblique", "inconsistent")
KEPT, FAINT, BLURRED, OBLIQUE, INCONSISTENT = range(5)


@dataclass(frozen=True)
class ImageCorners:
    """Corners of the target in one image, dropped ones included, in the order of `point`.

    point (N,) int64: index into the target's points, each at most once; uv (N, 2) px: (0, 0) is the centre of the
    top-left pixel; sigma (N,) px: expected standard deviation per axis; blur (N,) px: of a Gaussian; verdict (N,) int8:
    index into `VERDICTS`; edges (N, 2, EDGE) float32: as in `edge_fits`, zeros if they are not given.
    """

    point: np.ndarray
    uv: np.ndarray
    sigma: np.ndarray
    blur: np.ndarray
    verdict: np.ndarray
    edges: np.ndarray = field(default_factory=lambda: NO_EDGES)

    def __post_init__(self) -> None:
        if len(self.edges) != len(self.point):
            object.__setattr__(self, "edges", np.zeros((len(self.point), *NO_EDGES.shape[1:]), dtype=np.float32))

    @property
    def kept(self) -> np.ndarray:
        """(N,) bool: whether each corner is kept."""
        return self.verdict == KEPT

    def renumbered(self, point: np.ndarray) -> ImageCorners:
        """The same corners with new indices point (N,) into the target's points, sorted by these."""
        order = np.argsort(point)
        values = {f.name: getattr(self, f.name)[order] for f in fields(self)}
        return ImageCorners(**values | {"point": point[order]})

    def counts(self) -> dict[str, int]:
        """Number of corners with each verdict of `VERDICTS`."""
        return {name: int((self.verdict == k).sum()) for k, name in enumerate(VERDICTS)}


def packed(images: Sequence[ImageCorners]) -> list[ImageCorners]:
    """The same corners, as slices of a few arrays for all images: thousands of small arrays fragment the memory."""
    ends = np.cumsum([0] + [len(image.point) for image in images])
    joined = [np.concatenate([getattr(image, f.name) for image in images]) for f in fields(ImageCorners)]
    return [ImageCorners(*(values[a:b] for values in joined)) for a, b in pairwise(ends)]


def no_corners() -> ImageCorners:
    """An image without corners."""
    nothing = np.zeros(0)
    return ImageCorners(
        nothing.astype(np.int64), np.zeros((0, 2)), nothing.copy(), nothing.copy(), nothing.astype(np.int8)
    )


def with_verdicts(
    point: np.ndarray,
    uv: np.ndarray,
    quality: np.ndarray,
    consistent: np.ndarray,
    crowded: float = np.inf,
) -> ImageCorners:
    """Corners with sigma and verdict. The first of these rules that applies gives the verdict.

    inconsistent: not at the position that neighbours predict. oblique: its edges meet at less than 15 degrees. blurred:
    the nearest other feature is less than 1.5 px + 1.5 blurs away (L-corners: 1.5 px + 2.25 blurs; cells of a tag in
    the dark field: 1 px + 1.5 blurs; markers in the white field: 0.5 px + 1.5 blurs). With `crowded`, sigma [px] for
    each px below this limit, corners up to 1.25 px below it are kept. faint: sigma is above 0.25 px.

    point (N,) int64; uv (N, 2) px; quality (5, N), or with edges (5 + 2 EDGE, N), as `refined_crossings` returns it;
    consistent (N,) bool.
    """
    unit_sigma, blur, sine, room_px, _ = quality[:5]
    rows = np.flatnonzero(np.isfinite(unit_sigma))
    rows = rows[np.argsort(point[rows], kind="stable")]
    sigma, lacks = np.hypot(IMAGE_NOISE * unit_sigma[rows], MODEL_SIGMA_PX), np.maximum(-room_px[rows], 0.0)
    most_lacks = 0.0 if np.isinf(crowded) else MOST_LACKS_PX
    if most_lacks > 0.0:
        sigma = np.hypot(sigma, crowded * lacks)
    verdict = np.full(len(rows), KEPT, dtype=np.int8)
    verdict[sigma > MOST_SIGMA_PX] = FAINT
    verdict[~(lacks <= most_lacks)] = BLURRED
    verdict[sine[rows] < np.sin(np.radians(LEAST_ANGLE_DEG))] = OBLIQUE
    verdict[~consistent[rows]] = INCONSISTENT
    edges = quality[5:, rows].T.reshape(-1, 2, EDGE).astype(np.float32)
    return ImageCorners(point[rows].astype(np.int64), uv[rows], sigma, blur[rows], verdict, edges)


def corner_stream(name: str, stamps_ns: np.ndarray, images: Sequence[ImageCorners]) -> CornerStream:
    """The kept corners of the images of camera `name` at stamps_ns (M,) int64, strictly increasing.

    Raises RecordingError if the stamps do not increase, or if there is not one for each image.
    """
    stamps_ns = np.asarray(stamps_ns, dtype=np.int64)
    if len(stamps_ns) != len(images):
        raise RecordingError(f"{name}: {len(images)} images have {len(stamps_ns)} stamps; give one for each.")
    if (np.diff(stamps_ns) <= 0).any():
        row = int(np.argmax(np.diff(stamps_ns) <= 0)) + 1
        raise RecordingError(
            f"{name}: the image at {stamps_ns[row]} ns does not come after the one at {stamps_ns[row - 1]} ns; "
            "sort the images by stamp and remove repeated ones."
        )
    start = np.concatenate([[0], np.cumsum([int(image.kept.sum()) for image in images])]).astype(np.int64)
    point = np.concatenate([np.zeros(0, dtype=np.int64)] + [image.point[image.kept] for image in images])
    uv = np.concatenate([np.zeros((0, 2))] + [image.uv[image.kept] for image in images])
    sigma = np.concatenate([np.zeros(0)] + [image.sigma[image.kept] for image in images])
    edges = np.concatenate([NO_EDGES] + [image.edges[image.kept] for image in images])
    return CornerStream(name, stamps_ns, start, point, uv, sigma=sigma, edges=edges)


def checked_image(image: np.ndarray) -> np.ndarray:
    """The image as contiguous (h, w) uint8. Raises RecordingError if it is not grey with 8 bits."""
    if image.ndim != 2 or image.dtype != np.uint8:
        raise RecordingError(
            f"an image has shape {image.shape} and type {image.dtype}; convert it to grey levels, (h, w) uint8."
        )
    return np.ascontiguousarray(image)
