"""Tracks corners of the scene through the images of one camera, in order.

For each image: contrast equalisation, pyramidal Lucas-Kanade forward and backward, alignment with the first view of
each track, new corners in empty cells.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from icalib.base.extras import load_cv2
from icalib.detection.tracking.patches import RADIUS, Templates, align, cut_templates, no_templates

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
