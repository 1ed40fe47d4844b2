"""Images -> feature tracks: corners of the scene, tracked from image to image (Shi and Tomasi, CVPR 1994)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.base.extras import load_cv2

# Tracks corners of the scene through the images of one camera, in order.
#
# For each image: contrast equalisation, pyramidal Lucas-Kanade forward and backward, alignment with the first view of
# each track, new corners in empty cells.
#
# Compiled: alignment of an image with the first view of each track.
#
# A point tracked only from image to image drifts: its errors add up, and the estimator cannot detect that. Therefore
# each image is aligned with the first view under an affine map (Shi and Tomasi, Good Features to Track, 1994). The map
# is found by inverse compositional Gauss-Newton (Baker and Matthews, 2004). Grey levels are normalised by mean and
# contrast, so that a change of exposure has no effect.

TRACKED_CELLS = 100  # cells of an image; a new track starts only in a cell without one
# images of a track, at most; later views differ too much from the first, and long tracks take the estimator longer
MOST_VIEWS = 30
WINDOW_PX, PYRAMID_LEVEL = 21, 3  # of Lucas-Kanade, for motions of up to 80 px between images
LK_ENDS = 10, 0.05  # steps at most, and px of the last step; the alignment that follows is finer
CLAHE_CLIP, TILES = 3.0, (8, 8)  # of the equalisation (CLAHE)
BLUR_PX = 0.8  # standard deviation of a Gaussian before alignment; interpolation between pixels is then accurate enough
BACK_PX = 0.7  # largest distance between start and end of forward and backward tracking
ALIGNED_PX = 2.0  # largest shift by the alignment from Lucas-Kanade's result
MIN_NCC = 0.8  # correlation with the first view, at least
LEAST_QUALITY = 5e-4  # smaller eigenvalue of a corner, at least (OpenCV's cornerMinEigenVal, grey levels of 0 to 1)
REFINED_WITHIN_PX = 3  # search radius about a corner found at half the resolution


@dataclass(frozen=True)
class Observations:
    """Features in one image: feature (n,) int64; uv (n, 2) px; views (n,) int64: number of earlier images with the
    feature; spread (n,) px^2: as in `TrackStream`."""

    feature: np.ndarray
    uv: np.ndarray
    views: np.ndarray
    spread: np.ndarray


_COLUMNS = ("feature", "uv", "flow", "A", "views")


@dataclass(frozen=True)
class _Tracks:
    """The n current tracks: feature (n,); uv (n, 2) px; flow (n, 2) px: the last motion, NaN in the first view; A (n,
    2, 2): affine map from the first view; views (n,): number of earlier images with the feature; first: the first
    views."""

    feature: np.ndarray
    uv: np.ndarray
    flow: np.ndarray
    A: np.ndarray
    views: np.ndarray
    first: Templates

    @classmethod
    def new(cls, feature: np.ndarray, uv: np.ndarray, first: Templates) -> _Tracks:
        """Tracks that begin at uv (n, 2) px."""
        n = len(feature)
        A = np.tile(np.eye(2), (n, 1, 1))
        return cls(feature, uv.astype(np.float64), np.full((n, 2), np.nan), A, np.zeros(n, np.int64), first)

    def some(self, kept: np.ndarray) -> _Tracks:
        """The tracks selected by `kept`, indices or a mask."""
        columns = {name: getattr(self, name)[kept] for name in _COLUMNS}
        return replace(self, first=self.first.some(kept), **columns)

    def joined(self, other: _Tracks) -> _Tracks:
        """These tracks, followed by the `other` ones."""
        columns = {name: np.concatenate([getattr(self, name), getattr(other, name)]) for name in _COLUMNS}
        return replace(self, first=self.first.joined(other.first), **columns)


def prepared(image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The image (h, w) uint8 with its contrast equalised by regions, uint8, for Lucas-Kanade and new corners; and the
    image smoothed, float32, for alignment."""
    cv2 = load_cv2()
    even = cv2.createCLAHE(CLAHE_CLIP, TILES).apply(image)
    return even, cv2.GaussianBlur(image, (0, 0), BLUR_PX).astype(np.float32)


class Tracker:
    """Tracks corners of the scene through the images of one camera."""

    def __init__(self) -> None:
        self._cv2: Any = load_cv2()
        self._before = np.zeros((0, 0), np.uint8)
        self._alive = _Tracks.new(np.zeros(0, np.int64), np.zeros((0, 2)), no_templates())
        self._next_id = 0

    def pass_over(self, image: np.ndarray) -> None:
        """Tracks through the next image (h, w) uint8 without observations; it does not count as a view of the
        features."""
        self._advance(image)

    def add(self, image: np.ndarray) -> Observations:
        """Tracks through the next image (h, w) uint8, starts new tracks, and returns the observations in the image."""
        even, smooth = self._advance(image)
        self._alive = self._alive.some(self._alive.views < _most_views(self._alive.feature))
        self._add_features(even, smooth)
        alive = self._alive
        spread = alive.first.spread * np.abs(np.linalg.det(alive.A))
        self._alive = replace(alive, views=alive.views + 1)
        return Observations(alive.feature, alive.uv, alive.views, spread)

    def _advance(self, image: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Moves the tracks to the next image; returns the result of `prepared`."""
        even, smooth = prepared(image)
        if len(self._alive.feature):
            self._move_tracks(even, smooth)
        self._before = even
        return even, smooth

    def _move_tracks(self, even: np.ndarray, smooth: np.ndarray) -> None:
        """Moves the tracks by Lucas-Kanade and alignment with the first views; lost tracks end."""
        cv2, alive = self._cv2, self._alive
        before = alive.uv.astype(np.float32)
        size, end = (WINDOW_PX, WINDOW_PX), (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, *LK_ENDS)
        after, status, _ = cv2.calcOpticalFlowPyrLK(
            self._before,
            even,
            before,
            before + self._predicted(),
            winSize=size,
            maxLevel=PYRAMID_LEVEL,
            criteria=end,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        back, back_status, _ = cv2.calcOpticalFlowPyrLK(
            even,
            self._before,
            after,
            before.copy(),
            winSize=size,
            maxLevel=0,
            criteria=end,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        good = (status.ravel() > 0) & (back_status.ravel() > 0) & (np.linalg.norm(back - before, axis=1) < BACK_PX)
        uv, A, ncc = after.astype(np.float64), alive.A.copy(), np.full(len(before), -1.0)
        align(smooth, alive.first, uv, A, ncc)
        good &= (ncc > MIN_NCC) & (np.linalg.norm(uv - after, axis=1) < ALIGNED_PX)
        self._alive = replace(alive, uv=uv, flow=uv - before, A=A).some(good)

    def _predicted(self) -> np.ndarray:
        """(n, 2) px float32: predicted motion of each track, equal to its last motion, or to the median of all for new
        tracks."""
        flow = self._alive.flow
        known = np.isfinite(flow[:, 0])
        median = np.median(flow[known], axis=0) if known.any() else np.zeros(2)
        return np.where(known[:, None], flow, median).astype(np.float32)

    def _add_features(self, even: np.ndarray, smooth: np.ndarray) -> None:
        """Starts a track at the strongest corner of each cell without tracks."""
        uv = self._corners(even)
        first, good = cut_templates(smooth, uv)
        feature = self._next_id + np.arange(int(good.sum()))
        self._next_id += len(feature)
        self._alive = self._alive.joined(_Tracks.new(feature, uv[good], first.some(good)))

    def _corners(self, even: np.ndarray) -> np.ndarray:
        """(n, 2) whole pixels: the strongest corner of each empty cell, away from tracks. Corners are searched at half
        the resolution, which takes a quarter of the time, and then refined at the full one."""
        cv2 = self._cv2
        half = cv2.resize(even, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        (h, w), at = half.shape, np.rint(0.5 * self._alive.uv).astype(int)
        side = int(np.ceil(np.sqrt(h * w / TRACKED_CELLS)))
        rows, cols = -(-h // side), -(-w // side)
        free = np.ones((rows, cols), dtype=bool)
        free[np.clip(at[:, 1] // side, 0, rows - 1), np.clip(at[:, 0] // side, 0, cols - 1)] = False
        quality = np.zeros((rows * side, cols * side), np.float32)
        quality[:h, :w] = cv2.cornerMinEigenVal(half, 3, ksize=3)
        edge = (RADIUS + REFINED_WITHIN_PX) // 2 + 2
        for rim in (quality[:edge], quality[h - edge :], quality[:, :edge], quality[:, w - edge :]):
            rim[:] = 0.0
        for x, y in at.tolist():
            quality[max(y - RADIUS, 0) : y + RADIUS + 1, max(x - RADIUS, 0) : x + RADIUS + 1] = 0.0
        cells = quality.reshape(rows, side, cols, side).transpose(0, 2, 1, 3)[free].reshape(-1, side * side)
        best = cells.argmax(axis=1)
        strong = cells[np.arange(len(cells)), best] > LEAST_QUALITY
        (row, col), (y, x) = np.nonzero(free), np.divmod(best, side)
        pixels = 2 * np.column_stack([col * side + x, row * side + y])[strong]
        return np.array([self._strongest_near(even, x, y) for x, y in pixels.tolist()]).reshape(-1, 2)

    def _strongest_near(self, even: np.ndarray, x: int, y: int) -> tuple[int, int]:
        """The strongest corner within REFINED_WITHIN_PX of a pixel, which must be at least RADIUS inside the image."""
        part = even[y - RADIUS : y + RADIUS + 1, x - RADIUS : x + RADIUS + 1]
        inner = slice(RADIUS - REFINED_WITHIN_PX, RADIUS + REFINED_WITHIN_PX + 1)
        dy, dx = np.divmod(
            self._cv2.cornerMinEigenVal(part, 5, ksize=3)[inner, inner].argmax(), 2 * REFINED_WITHIN_PX + 1
        )
        return x + int(dx) - REFINED_WITHIN_PX, y + int(dy) - REFINED_WITHIN_PX


def _most_views(feature: np.ndarray) -> np.ndarray:
    """(n,) most views of each feature, half to all of MOST_VIEWS: tracks that began together must not all end in the
    same image."""
    half = MOST_VIEWS // 2
    return half + feature % (half + 1)


RADIUS = 7  # px; a patch has 15 x 15 px
SIDE = 2 * RADIUS + 1
CONVERGED_PX = 0.02  # shift by the last step, below which the alignment has converged
MOST_ALIGNMENT_STEPS = 12
LEAST_TEXTURE = 1.0  # least standard deviation of the grey levels of a patch; less is noise


class Templates(NamedTuple):
    """First views of n tracks, patches of SIDE x SIDE px.

    grey (n, SIDE, SIDE) float32: grey levels, mean 0 and standard deviation 1; slope (n, SIDE, SIDE, 2) float32: their
    derivatives by x and y, per px; inverse (n, 6, 6): inverse of the normal matrix of the affine map; spread (n,) px^2:
    second moment of the patch along each axis, weighted as in the alignment.
    """

    grey: np.ndarray
    slope: np.ndarray
    inverse: np.ndarray
    spread: np.ndarray

    def some(self, kept: np.ndarray) -> Templates:
        """The templates selected by `kept`, indices or a mask."""
        return Templates(*(column[kept] for column in self))

    def joined(self, other: Templates) -> Templates:
        """These templates, followed by the `other` ones."""
        return Templates(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def no_templates() -> Templates:
    """Templates of no tracks."""
    return Templates(
        np.zeros((0, SIDE, SIDE), np.float32),
        np.zeros((0, SIDE, SIDE, 2), np.float32),
        np.zeros((0, 6, 6)),
        np.zeros(0),
    )


def cut_templates(image: np.ndarray, uv: np.ndarray) -> tuple[Templates, np.ndarray]:
    """Templates around whole pixels uv (n, 2) of an image (h, w) float32, and a mask (n,) of those with texture in two
    directions. Pixels must be at least RADIUS + 1 px inside the image."""
    n = len(uv)
    grey, slope = np.empty((n, SIDE, SIDE), np.float32), np.empty((n, SIDE, SIDE, 2), np.float32)
    normal = np.empty((n, 6, 6))
    contrast = _cut(image, np.rint(uv).astype(np.int64), grey, slope, normal)
    normal[:, range(6), range(6)] += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None] + 1e-12
    good = (contrast > LEAST_TEXTURE) & (np.linalg.cond(normal) < 1e8)
    normal[~good] = np.eye(6)
    inverse = np.linalg.inv(normal)
    return Templates(grey, slope, inverse, _spread(slope, inverse)), good


def _spread(slope: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """(n,) px^2: second moment of each patch along an axis, weighted as in the alignment. It is the shift that the
    affine alignment estimates for a displacement q(x) = x_a^2, averaged over both axes a and both components of q."""
    y, x = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1].astype(np.float64)
    by_x, by_y = slope[..., 0], slope[..., 1]
    rows = np.stack([by_x * x, by_x * y, by_y * x, by_y * y, by_x, by_y], axis=-1)
    square = np.stack([x * x, y * y])
    products = np.einsum("nija,nijk,qij->nkqa", rows, slope, square, optimize=True)
    shift = np.einsum("nka,nkqa->nkq", inverse[:, 4:], products)
    return np.clip(shift.mean(axis=(1, 2)), 0.0, None)


@njit(cache=True, nogil=True)
def _cut(image, at, grey, slope, normal):
    """Fills grey, slope and normal; returns the contrast (n,) of each patch."""
    contrast = np.empty(len(at))
    for n in range(len(at)):
        c, r = at[n, 0], at[n, 1]
        total, square = 0.0, 0.0
        for i in range(SIDE):
            for j in range(SIDE):
                value = image[r + i - RADIUS, c + j - RADIUS]
                total += value
                square += value * value
        mean = total / SIDE**2
        contrast[n] = np.sqrt(max(square / SIDE**2 - mean * mean, 0.0))
        scale = 1.0 / max(contrast[n], 1e-6)
        normal[n] = 0.0
        row = np.empty(6)
        for i in range(SIDE):
            for j in range(SIDE):
                y, x = r + i - RADIUS, c + j - RADIUS
                grey[n, i, j] = (image[y, x] - mean) * scale
                slope[n, i, j, 0] = 0.5 * scale * (image[y, x + 1] - image[y, x - 1])
                slope[n, i, j, 1] = 0.5 * scale * (image[y + 1, x] - image[y - 1, x])
                _affine_row(slope[n, i, j], i - RADIUS, j - RADIUS, row)
                for a in range(6):
                    for b in range(6):
                        normal[n, a, b] += row[a] * row[b]
    return contrast


@njit(cache=True, nogil=True, inline="always")
def _affine_row(slope, dy, dx, row):
    """Derivatives of a grey level by the affine map (a00, a01, a10, a11, tx, ty): x' = x + A x + t."""
    row[0], row[1], row[4] = slope[0] * dx, slope[0] * dy, slope[0]
    row[2], row[3], row[5] = slope[1] * dx, slope[1] * dy, slope[1]


@njit(cache=True, nogil=True)
def align(image, templates, uv, A, ncc):
    """Aligns the image (h, w) float32 with the templates, from the start values uv (n, 2) px and A (n, 2, 2), which are
    updated.

    The point x of a template is at uv + A x in the image. Fills ncc (n,): correlation of both, or -1 if the patch
    leaves the image, has too little contrast, or the iteration does not converge.
    """
    patch, row, b, step = np.empty((SIDE, SIDE)), np.empty(6), np.empty(6), np.empty(6)
    for n in range(len(uv)):
        ncc[n] = -1.0
        for _ in range(MOST_ALIGNMENT_STEPS):
            correlation = _sample(image, uv[n], A[n], templates.grey[n], patch)
            if correlation < 0.0:
                break
            b[:] = 0.0
            for i in range(SIDE):
                for j in range(SIDE):
                    error = patch[i, j] - templates.grey[n, i, j]
                    _affine_row(templates.slope[n, i, j], i - RADIUS, j - RADIUS, row)
                    for a in range(6):
                        b[a] += row[a] * error
            for a in range(6):
                step[a] = 0.0
                for k in range(6):
                    step[a] += templates.inverse[n, a, k] * b[k]
            moved = _compose(uv[n], A[n], step)
            if moved < 0.0:
                break
            if moved < CONVERGED_PX:
                ncc[n] = correlation
                break


@njit(cache=True, nogil=True)
def _sample(image, uv, A, template, patch):
    """Fills `patch` (SIDE, SIDE) with the grey levels of the mapped patch, normalised to fit the template best. Returns
    the correlation with the template, -1 if the patch leaves the image or has too little contrast."""
    h, w = image.shape
    reach_x = RADIUS * (abs(A[0, 0]) + abs(A[0, 1]))
    reach_y = RADIUS * (abs(A[1, 0]) + abs(A[1, 1]))
    if not (uv[0] - reach_x >= 0.0 and uv[0] + reach_x < w - 1.0 and uv[1] - reach_y >= 0.0):
        return -1.0
    if not uv[1] + reach_y < h - 1.0:
        return -1.0
    total, square, product = 0.0, 0.0, 0.0
    for i in range(SIDE):
        for j in range(SIDE):
            dx, dy = j - RADIUS, i - RADIUS
            x, y = uv[0] + A[0, 0] * dx + A[0, 1] * dy, uv[1] + A[1, 0] * dx + A[1, 1] * dy
            c, r = int(x), int(y)
            p, q = x - c, y - r
            above = image[r, c] + p * (image[r, c + 1] - image[r, c])
            below = image[r + 1, c] + p * (image[r + 1, c + 1] - image[r + 1, c])
            value = above + q * (below - above)
            patch[i, j] = value
            total += value
            square += value * value
            product += value * template[i, j]
    mean = total / SIDE**2
    variance = square / SIDE**2 - mean * mean
    if not (variance > LEAST_TEXTURE**2 and product > 0.0):
        return -1.0
    # Scaled by the projection on the template: noise adds to the contrast, so a scale by contrast would be too small.
    scale = SIDE**2 / product
    for i in range(SIDE):
        for j in range(SIDE):
            patch[i, j] = (patch[i, j] - mean) * scale
    return product / SIDE**2 / np.sqrt(variance)


@njit(cache=True, nogil=True)
def _compose(uv, A, step):
    """Replaces the map (uv, A) by its composition with the inverse of the small map `step`. Returns the shift of uv
    [px], -1 if the step changes areas by a factor of four or more."""
    b00, b01, b10, b11 = 1.0 + step[0], step[1], step[2], 1.0 + step[3]
    determinant = b00 * b11 - b01 * b10
    if not 0.25 < determinant < 4.0:
        return -1.0
    i00, i01, i10, i11 = b11 / determinant, -b01 / determinant, -b10 / determinant, b00 / determinant
    a00, a01, a10, a11 = A[0, 0], A[0, 1], A[1, 0], A[1, 1]
    A[0, 0], A[0, 1] = a00 * i00 + a01 * i10, a00 * i01 + a01 * i11
    A[1, 0], A[1, 1] = a10 * i00 + a11 * i10, a10 * i01 + a11 * i11
    dx, dy = A[0, 0] * step[4] + A[0, 1] * step[5], A[1, 0] * step[4] + A[1, 1] * step[5]
    uv[0] -= dx
    uv[1] -= dy
    return np.sqrt(dx * dx + dy * dy)


# Compiled: the epipolar geometry of two images through an unknown lens.
#
# A pixel at (x, y) from the image centre has the ray (x, y, 1 + lam (x^2 + y^2)). This is the division model of
# Fitzgibbon (Simultaneous linear estimation of multiple view geometry and lens distortion, 2001). Rays f, h of a
# static point satisfy h . F f = 0. F absorbs the focal length, so only the distortion `lam` of the lens must be known.
#
# F is estimated from eight random points, in many draws. The one with the least quantile of errors is used (least
# quantile of squares, Rousseeuw 1984). The quantile is above the median: F is flexible enough to fit a moving body
# that covers nearly half of the image.

MOST_DRAWS = 60  # draws, at most; with 30 % of outliers, none is free of outliers for one in 35 pairs of images
FEWEST_DRAWS, MISSED = 12, 0.01  # draws, at least; probability that no draw is free of outliers at which drawing ends
# up to 35 % of the points may move; the same quantile of the absolute value of a standard normal variable
QUANTILE, QUANTILE_OF_NORMAL = 0.65, 0.9346
REFITS, FITS_TIMES = 2, 3.0  # refits to all points whose errors are within this multiple of the quantile
FEWEST_MATCHED_POINTS = 16  # fewer points give an unreliable quantile


def epipolar_errors(p: np.ndarray, q: np.ndarray, lam: float, seed: int) -> tuple[np.ndarray, float]:
    """First-order distances (n,) of points p and q (n, 2) in two images from the epipolar geometry of most of them, and
    their standard deviation by the quantile. Units are those of p and q, relative to the image centres; n must be at
    least FEWEST_MATCHED_POINTS."""
    rng = np.random.default_rng(seed)
    draws = rng.permuted(np.tile(np.arange(len(p)), (MOST_DRAWS, 1)), axis=1)[:, :8].copy()
    error = np.empty(len(p))
    quantile = _least_quantile(np.ascontiguousarray(p), np.ascontiguousarray(q), lam, draws, error)
    return error, (1.0 + 5.0 / (len(p) - 8)) / QUANTILE_OF_NORMAL * quantile  # Rousseeuw's correction for few points


@njit(cache=True, nogil=True)
def _least_quantile(p, q, lam, draws, least):
    """The least quantile of errors over all draws (m, 8) and refits to all points that fit; fills least (n,) with the
    errors of this F."""
    n = len(p)
    f, h, error, used = np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, dtype=np.bool_)
    for i in range(n):
        f[i, 0], f[i, 1], f[i, 2] = p[i, 0], p[i, 1], 1.0 + lam * (p[i, 0] ** 2 + p[i, 1] ** 2)
        h[i, 0], h[i, 1], h[i, 2] = q[i, 0], q[i, 1], 1.0 + lam * (q[i, 0] ** 2 + q[i, 1] ** 2)
    best, k, last = np.inf, 0, len(draws)
    while k < last + REFITS:
        if k < last:
            used[:] = False
            for i in draws[k]:
                used[i] = True
        else:
            for i in range(n):
                used[i] = least[i] <= FITS_TIMES * best
        k += 1
        _errors(f, h, lam, _fundamental(f, h, used), error)
        quantile = np.partition(error, int(QUANTILE * n))[int(QUANTILE * n)]
        if quantile < best:
            best = quantile
            least[:] = error
            if k < last:
                last = max(min(last, _draws_needed(least, best)), k)
    return best


@njit(cache=True, nogil=True)
def _draws_needed(error, quantile):
    """Number of draws of eight points after which none is free of outliers with probability MISSED."""
    fits = 0
    for e in error:
        fits += e <= FITS_TIMES * quantile
    clean = (fits / len(error)) ** 8
    return FEWEST_DRAWS if clean > 0.99 else max(FEWEST_DRAWS, int(np.log(MISSED) / np.log(1.0 - clean)) + 1)


@njit(cache=True, nogil=True)
def _fundamental(f, h, used):
    """F (3, 3) with h . F f = 0, by linear least squares over the rays with `used` (n,)."""
    A, row = np.zeros((9, 9)), np.empty(9)
    for i in range(len(f)):
        if not used[i]:
            continue
        for a in range(3):
            for b in range(3):
                row[3 * a + b] = h[i, a] * f[i, b]
        for a in range(9):
            for b in range(9):
                A[a, b] += row[a] * row[b]
    return np.ascontiguousarray(np.linalg.eigh(A)[1][:, 0]).reshape(3, 3)


@njit(cache=True, nogil=True)
def _errors(f, h, lam, F, error):
    """Fills error (n,) with Sampson's distance: |h . F f| over the norm of its derivatives by the four pixel
    coordinates."""
    for i in range(len(f)):
        value, size = 0.0, 0.0
        l0, l1, l2 = 0.0, 0.0, 0.0  # F f
        m0, m1, m2 = 0.0, 0.0, 0.0  # F^T h
        for b in range(3):
            l0, l1, l2 = l0 + F[0, b] * f[i, b], l1 + F[1, b] * f[i, b], l2 + F[2, b] * f[i, b]
            m0, m1, m2 = m0 + F[b, 0] * h[i, b], m1 + F[b, 1] * h[i, b], m2 + F[b, 2] * h[i, b]
        value = h[i, 0] * l0 + h[i, 1] * l1 + h[i, 2] * l2
        size += (l0 + 2.0 * lam * h[i, 0] * l2) ** 2 + (l1 + 2.0 * lam * h[i, 1] * l2) ** 2
        size += (m0 + 2.0 * lam * f[i, 0] * m2) ** 2 + (m1 + 2.0 * lam * f[i, 1] * m2) ** 2
        error[i] = abs(value) / np.sqrt(max(size, 1e-30))
