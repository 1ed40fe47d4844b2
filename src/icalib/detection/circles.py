"""Grids of circles: dark ellipses are assigned to the grid, then a blurred ellipse is fitted to the edge of each.

The centre of this ellipse is not the projected centre of the circle; `sensors/camera/corner_bias.py` corrects it.

Finds the dark ellipses of an image that are the circles of a grid.

Each ellipse shows the affine map between target and image about its circle, up to a rotation. Neighbours are therefore
recognised in the coordinates of the ellipse, under any perspective. The grid grows from one circle and two neighbours:
each further circle is searched at its prediction by the nearest known ones.

Kernel that fits a blurred ellipse to the pixels about its edge, by Gauss-Newton with limited steps.

    grey(u) = inside + (outside - inside) Phi(d(u) / blur),  d(u) = (|W (u - c)| - 1) / |gradient of |W (u - c)||

c (2,) px is the centre; W (2, 2) 1/px maps the ellipse to the unit circle; Phi is the normal distribution function; d
is the distance from the ellipse to first order (Sampson). The model is point symmetric about c. So is the image of an
ellipse under blur and any camera response, so that these do not bias the centre.

The eight parameters are c (2), the shape S (S_00, S_11, S_01), blur [px], and the grey levels inside and outside. A
step of the shape is W <- (I + S) W. S is symmetric because a rotation of the unit circle does not change the ellipse.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erf, exp, hypot, pi, sqrt

import numpy as np

from icalib.base.compiled import njit
from icalib.base.extras import load_cv2
from icalib.detection.decoding import ImageCorners, mapped, nearest_greys, no_corners, with_verdicts
from icalib.detection.edge_model import BLUR_RANGE_PX, solve_small
from icalib.detection.growth import PredictedCorners, consistent_corners, fit_homography
from icalib.detection.tags import LEAST_CONTRAST, ImageWithQuads
from icalib.geometry.targets import Circles

# Share of the circles that need an ellipse at a consistent position; with fewer, there is no grid.
_LEAST_CIRCLE_SHARE = 0.5


@dataclass(frozen=True)
class CirclesDetector:
    """Finds the centres of the circles of `target`, all of which must be in the image."""

    target: Circles

    def detect(self, image: np.ndarray) -> ImageCorners:
        """The centres of the ellipses in the image (h, w) uint8, numbered as `Circles.points`.

        Raises RecordingError for an image that is not grey with 8 bits.
        """
        return self.find(ImageWithQuads(image))

    def find(self, view: ImageWithQuads) -> ImageCorners:
        """As `detect`, for an image whose quads may be known already."""
        for window in view.windows:
            grids = find_grids(self.target, dark_ellipses(view.image, window, step_of(self.target)))
            if grids:
                # The image does not distinguish the rotations: the one whose rows run most to the right is taken.
                centres = self._centres(view.image, max(grids, key=self._to_the_right))
                if len(centres.point):
                    return centres
        return no_corners()

    def find_near(self, view: ImageWithQuads, expected: PredictedCorners) -> ImageCorners | None:
        """As `find`, near predicted centres of all circles; None if one is not predicted or not found."""
        if len(expected.point) < len(self.target.points):
            return None
        centres = self._centres(view.image, expected.uv)
        return centres if expected.all_detected(view.image, centres) else None

    def _centres(self, image: np.ndarray, uv: np.ndarray) -> ImageCorners:
        """Centres of the ellipses near uv (n, 2) px; none if fewer than _LEAST_CIRCLE_SHARE are found and
        consistent."""
        axes = _projected_radii(self.target.points[:, :2], self.target.diameter, uv)
        fine, quality = fit_ellipses(image, uv, axes)
        valid = np.isfinite(quality[0])
        board = self.target.points[:, :2] / self.target.spacing
        consistent = consistent_corners(fine, board, valid, quality[4], image.shape)
        if (valid & consistent).mean() < _LEAST_CIRCLE_SHARE:
            return no_corners()
        return with_verdicts(np.arange(len(fine)), fine, quality, consistent)

    def _to_the_right(self, uv: np.ndarray) -> float:
        """Cosine between the target's x in the image and u, by an affine fit to the centres uv (n, 2) px."""
        xy = np.column_stack([self.target.points[:, :2], np.ones(len(uv))])
        A = np.linalg.lstsq(xy, uv, rcond=None)[0]
        return float(A[0, 0] / np.linalg.norm(A[0]))


def _projected_radii(xy: np.ndarray, diameter: float, uv: np.ndarray) -> np.ndarray:
    """(n, 2, 2) px: in its rows, the images of each circle's radii along x and y of the target.

    xy (n, 2) and `diameter` [m]: of the target; uv (n, 2) px: centres in the image. The affine map about each centre is
    fitted to the five centres nearest to it on the target.
    """
    out = np.empty((len(xy), 2, 2))
    for i in range(len(xy)):
        near = np.argsort(((xy - xy[i]) ** 2).sum(axis=1), kind="stable")[1:6]
        A = np.linalg.lstsq(xy[near] - xy[i], uv[near] - uv[i], rcond=None)[0]
        out[i] = 0.5 * diameter * A
    return out


# least half axis beyond the blur; smaller ellipses have no plateau inside, and are rejected as blurred
LEAST_HALF_AXIS_PX = 2.5
_LEAST_DIAMETER_PX = 2.0 * LEAST_HALF_AXIS_PX  # smaller ellipses are not used
_CIRCLE_CONTRAST = 0.5 * LEAST_CONTRAST  # grey levels below the local mean
_MOST_OBLIQUE = 0.17  # least ratio of the axes: a circle seen at 80 degrees from the normal
# largest relative difference from the area of the ellipse with the same second moments; 0.2 for a triangle
_LIKE_ELLIPSE = 0.1
# distance from the edge, and number of directions, at which the white around a circle is sampled
_OUTSIDE_PX, _AROUND = 3.0, 12
# range of the distance of neighbours, over the step of the grid, in the coordinates of an ellipse: allows for
# perspective
_NEIGHBOUR = (0.5, 1.8)
_RIGHT_ANGLE = 0.45  # of the step: largest distance of the second neighbour from a quarter turn of the first
# Of the step in the image: largest distance of a circle from its prediction; at half a step it would be ambiguous.
_MOST_CIRCLE_OFF = 0.4
_PREDICTING_CIRCLES = 6  # known circles that predict the next one; with more, distortion matters
_LEAST_FOR_PERSPECTIVE = 5  # fewer known circles predict the next one by an affine map

Node = tuple[int, int]


@dataclass(frozen=True)
class Ellipses:
    """Dark regions that resemble ellipses: centre (m, 2) px; unit (m, 2, 2) 1/px, which maps each to the unit
    circle."""

    centre: np.ndarray
    unit: np.ndarray


def dark_ellipses(image: np.ndarray, window: int, step: float) -> Ellipses:
    """Dark ellipses in the image (h, w) uint8, surrounded by brighter pixels. Pixels are dark if they are darker than
    the mean of `window` x `window` px.

    step: distance of the nearest other circle, in radii.
    """
    cv2 = load_cv2()
    dark = cv2.adaptiveThreshold(
        image, 255, cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV, window, _CIRCLE_CONTRAST
    )
    contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    centre, unit = [], []
    least_area = 0.25 * np.pi * _LEAST_DIAMETER_PX**2 * _MOST_OBLIQUE
    for contour in contours:
        if len(contour) < _LEAST_DIAMETER_PX or cv2.contourArea(contour, True) >= 0.0:
            continue  # the border of a hole
        m = cv2.moments(contour)
        if m["m00"] < least_area:
            continue
        covariance = np.array([[m["mu20"], m["mu11"]], [m["mu11"], m["mu02"]]]) / m["m00"]
        variance, axes = np.linalg.eigh(covariance)
        half = 2.0 * np.sqrt(np.maximum(variance, 0.0))
        area = np.pi * half[0] * half[1]
        # A contour runs through the centres of the outermost pixels.
        if 2.0 * half[1] + 1.0 < _LEAST_DIAMETER_PX or half[0] < _MOST_OBLIQUE * half[1]:
            continue
        if abs(m["m00"] / area - 1.0) < _LIKE_ELLIPSE:
            centre.append((m["m10"] / m["m00"], m["m01"] / m["m00"]))
            unit.append(axes / (half + 0.5) @ axes.T)
    return _on_white(image, Ellipses(np.array(centre).reshape(-1, 2), np.array(unit).reshape(-1, 2, 2)), step)


def _on_white(image: np.ndarray, ellipses: Ellipses, step: float) -> Ellipses:
    """The ellipses that are darker than their surroundings in all directions, sampled at most half-way to the next
    circle."""
    angle = 2.0 * np.pi * np.arange(_AROUND) / _AROUND
    to_edge = np.linalg.inv(ellipses.unit) @ np.stack([np.cos(angle), np.sin(angle)])  # (m, 2, directions)
    outside = to_edge * np.minimum(1.0 + _OUTSIDE_PX / np.linalg.norm(to_edge, axis=1, keepdims=True), 0.5 * step)
    around = nearest_greys(image, ellipses.centre[:, None] + outside.swapaxes(1, 2))
    keep = (around - nearest_greys(image, ellipses.centre)[:, None] >= LEAST_CONTRAST).all(axis=1)
    return Ellipses(ellipses.centre[keep], ellipses.unit[keep])


def find_grids(target: Circles, ellipses: Ellipses) -> list[np.ndarray]:
    """Centres (n, 2) px of the target's circles, in one array for each symmetric rotation of the target that fits.

    Empty if the ellipses do not contain the whole grid, or if the grid is a part of a larger one.
    """
    step = step_of(target)
    wanted = _nodes_of(target)
    tried = np.zeros(len(ellipses.centre), dtype=bool)
    for seed in range(len(ellipses.centre)):
        if not tried[seed]:
            known = _grown(ellipses, seed, step)
            tried[list(known.values())] = True
            grids = [ellipses.centre[rows] for turn in range(4) if len(rows := _matched(known, _turned(wanted, turn)))]
            if grids:
                return grids
    return []


def step_of(target: Circles) -> float:
    """Distance of nearest centres, in radii of the circles."""
    return float(target.spacing * (np.sqrt(2.0) if target.asymmetric else 1.0) / (0.5 * target.diameter))


def _nodes_of(target: Circles) -> np.ndarray:
    """(n, 2) int64: index of each circle in the grid of nearest neighbours.

    The second axis is the first one rotated clockwise by a quarter turn, as v is from u.
    """
    x, y = np.rint(target.points[:, 0] / target.spacing), np.rint(-target.points[:, 1] / target.spacing)
    nodes = np.stack([x + y, y - x], axis=1) / 2.0 if target.asymmetric else np.stack([x, y], axis=1)
    return nodes.astype(np.int64)


def _turned(nodes: np.ndarray, quarters: int) -> np.ndarray:
    """Grid indices (n, 2), rotated clockwise by quarter turns."""
    for _ in range(quarters):
        nodes = np.stack([-nodes[:, 1], nodes[:, 0]], axis=1)
    return nodes


def _matched(known: dict[Node, int], wanted: np.ndarray) -> list[int]:
    """Rows of the ellipses at the grid indices `wanted` (n, 2), shifted to the only position at which all of them are
    known.

    Empty if there is no such position, or more than one.
    """
    matches = []
    for a, b in known:
        moved = wanted - wanted[0] + (a, b)
        if len(known) >= len(wanted) and all((int(p), int(q)) in known for p, q in moved):
            matches.append([known[int(p), int(q)] for p, q in moved])
    return matches[0] if len(matches) == 1 else []


def _grown(ellipses: Ellipses, seed: int, step: float) -> dict[Node, int]:
    """Rows of the ellipses by their grid index, from `seed` outwards; only the seed if it has no two neighbours."""
    known: dict[Node, int] = {(0, 0): seed}
    neighbours = _two_neighbours(ellipses, seed, step)
    if neighbours is None:
        return known
    known[1, 0], known[0, 1] = neighbours
    free = np.ones(len(ellipses.centre), dtype=bool)
    free[list(known.values())] = False
    changed = True
    while changed and free.any():
        changed = False
        for node, beside in _frontier(known).items():
            row = _nearest_ellipse(ellipses.centre, free, known, node, beside)
            if row >= 0:
                known[node], free[row], changed = row, False, True
    return known


def _two_neighbours(ellipses: Ellipses, seed: int, step: float) -> tuple[int, int] | None:
    """Rows of the ellipse nearest to the seed, in the coordinates of the seed, and of the one a quarter turn from it.
    None if their distances do not fit a grid."""
    v = (ellipses.centre - ellipses.centre[seed]) @ ellipses.unit[seed].T
    distance = np.linalg.norm(v, axis=1)
    distance[seed] = np.inf
    first = int(np.argmin(distance))
    if not _NEIGHBOUR[0] * step < distance[first] < _NEIGHBOUR[1] * step:
        return None
    off = np.linalg.norm(v - (-v[first, 1], v[first, 0]), axis=1)
    off[[seed, first]] = np.inf
    second = int(np.argmin(off))
    return (first, second) if off[second] < _RIGHT_ANGLE * distance[first] else None


def _frontier(known: dict[Node, int]) -> dict[Node, Node]:
    """Unknown grid indices beside known ones, each with one known neighbour."""
    beside = {}
    for a, b in known:
        for node in ((a + 1, b), (a, b + 1), (a - 1, b), (a, b - 1)):
            if node not in known:
                beside[node] = (a, b)
    return beside


def _nearest_ellipse(centre: np.ndarray, free: np.ndarray, known: dict[Node, int], node: Node, beside: Node) -> int:
    """Row of the free ellipse nearest to the prediction of a grid index by known ones, -1 if it is too far."""
    nodes, rows = np.array(list(known)), np.array(list(known.values()))
    squared = ((nodes - node) ** 2).sum(axis=1)
    near = np.argsort(squared, kind="stable")[:_PREDICTING_CIRCLES]
    at, uv = nodes[near].astype(np.float64), centre[rows[near]]
    if len(near) >= _LEAST_FOR_PERSPECTIVE:
        place = np.array(mapped(fit_homography(at, uv, len(at)), float(node[0]), float(node[1])))
    else:
        affine = np.linalg.lstsq(np.column_stack([at, np.ones(len(at))]), uv, rcond=None)[0]
        place = np.array([*node, 1.0]) @ affine
    off = np.where(free, np.linalg.norm(centre - place, axis=1), np.inf)
    best = int(np.argmin(off))
    return best if off[best] < _MOST_CIRCLE_OFF * np.linalg.norm(place - centre[known[beside]]) else -1


_SIZE = 8  # number of parameters
_MOST_ELLIPSE_STEPS = 20  # at most; a fit that needs more counts as failed
_CONVERGED_PX = 1e-3  # largest shift of the edge in the last step; far below the noise of a centre
_MOST_STEP_PX = 1.0  # largest shift of the edge in one step: the model is linear over about the width of the blur
_HALF_STRIP = (2.0, 3.0)  # px, and blurs, the larger of both: half width of the strip of fitted pixels
_MOST_EDGE_STRIP = 0.6  # of the smaller half axis: the same, at most. More would include the opposite edge
_FIRST_BLUR = 0.8  # px, start value
# Largest shift of the centre from the start: this share of the smaller half axis, plus 1 px. Doubled, it may reach a
# neighbour.
_MOST_CENTRE_MOVE = 0.5


@njit(cache=True, nogil=True)
def fit_ellipses(image, uv, axes):
    """(uv (n, 2) px, quality (5, n)) of the ellipses in the image (h, w) that start at uv (n, 2) px with `axes`.

    axes (n, 2, 2) px: in its rows, the images of two perpendicular radii of a circle. uv stays where no ellipse fits.

    The rows of quality are those of `refined_crossings`: sigma [px] of the centre per axis for image noise of one grey
    level, NaN where no ellipse fits; blur [px]; smaller over larger axis (in place of the sine between edges); by how
    much the smaller half axis exceeds the least plus the blur [px] (the room); the larger diameter [px].
    """
    out, quality = uv.copy(), np.full((5, len(uv)), np.nan)
    for i in range(len(uv)):
        u, v, sigma, blur, a, b = _fit(image, uv[i, 0], uv[i, 1], axes[i])
        out[i, 0], out[i, 1] = u, v
        quality[0, i], quality[1, i] = sigma, blur
        quality[2, i], quality[3, i], quality[4, i] = b / max(a, 1e-12), b - LEAST_HALF_AXIS_PX - blur, 2.0 * a
    return out, quality


@njit(cache=True, nogil=True)
def _half_axes(W):
    """The larger and the smaller half axis [px] of the ellipse |W (u - c)| = 1: from the eigenvalues of W^T W."""
    a = W[0, 0] ** 2 + W[1, 0] ** 2
    b = W[0, 0] * W[0, 1] + W[1, 0] * W[1, 1]
    c = W[0, 1] ** 2 + W[1, 1] ** 2
    mean, half_gap = 0.5 * (a + c), hypot(0.5 * (a - c), b)
    return 1.0 / sqrt(max(mean - half_gap, 1e-12)), 1.0 / sqrt(mean + half_gap)


@njit(cache=True, nogil=True)
def _fit(image, u0, v0, axes):
    """(u, v, sigma, blur, larger and smaller half axis) [px], from (u0, v0); sigma is NaN where no ellipse fits.

    sigma is for image noise of one grey level, and the mean of both axes.
    """
    det = axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]
    if not abs(det) > 1e-9:
        return u0, v0, np.nan, 0.0, 0.0, 0.0
    # Rows of axes are the images of two radii: the ellipse is centre + axes^T (unit vector).
    W = np.array([[axes[1, 1], -axes[1, 0]], [-axes[0, 1], axes[0, 0]]]) / det
    p = np.array([u0, v0, _FIRST_BLUR, 0.0, 0.0])  # centre, blur, grey inside, grey outside; W holds the shape
    A = np.zeros((_SIZE, _SIZE))
    for iteration in range(_MOST_ELLIPSE_STEPS):
        large, small = _half_axes(W)
        if small < 0.5 * LEAST_HALF_AXIS_PX or hypot(p[0] - u0, p[1] - v0) > _MOST_CENTRE_MOVE * small + 1.0:
            return u0, v0, np.nan, 0.0, large, small
        half = min(max(_HALF_STRIP[0], _HALF_STRIP[1] * p[2]), _MOST_EDGE_STRIP * small)
        if not _inside(image, p, large + half):
            return u0, v0, np.nan, p[2], large, small
        b, n = _accumulate(A, image, p, W, half, iteration == 0)
        if n < 2 * _SIZE or not p[4] - p[3] >= LEAST_CONTRAST:
            return u0, v0, np.nan, p[2], large, small
        if _move(p, W, solve_small(A, b), large) < _CONVERGED_PX:
            large, small = _half_axes(W)
            return p[0], p[1], _sigma(A), p[2], large, small
    large, small = _half_axes(W)
    return p[0], p[1], np.nan, p[2], large, small


@njit(cache=True, nogil=True, inline="always")
def _move(p, W, step, large):
    """Adds a step (8,), shortened to _MOST_STEP_PX, to the parameters p (5,) and the shape W (2, 2). Returns the shift
    of the edge [px] by the whole step. large [px]: larger half axis."""
    moved = max(hypot(step[0], step[1]), large * max(abs(step[2]), abs(step[3]), abs(step[4])))
    scale = min(1.0, _MOST_STEP_PX / max(moved, 1e-12))
    p[0] += scale * step[0]
    p[1] += scale * step[1]
    S = scale * np.array([[step[2], step[4]], [step[4], step[3]]])
    before = W.copy()
    for i in range(2):
        for j in range(2):
            W[i, j] = before[i, j] + S[i, 0] * before[0, j] + S[i, 1] * before[1, j]
    p[2] = min(max(p[2] + scale * min(max(step[5], -0.5 * p[2]), p[2]), BLUR_RANGE_PX[0]), BLUR_RANGE_PX[1])
    # Grey levels enter linearly: their step needs no limit.
    p[3] += step[6]
    p[4] += step[7]
    return moved


@njit(cache=True, nogil=True)
def _sigma(A):
    """Standard deviation of the centre [px], the mean of both axes, from the normal matrix A (8, 8); NaN if it is not
    positive definite."""
    variance = 0.0
    for k in range(2):
        unit = np.zeros(_SIZE)
        unit[k] = 1.0
        variance += 0.5 * solve_small(A, unit)[k]
    return sqrt(variance) if variance > 0.0 else np.nan


@njit(cache=True, nogil=True)
def _inside(image, p, reach):
    """Whether the image holds all pixels within `reach` px of the centre."""
    return (
        p[0] - reach >= 0.0
        and p[1] - reach >= 0.0
        and p[0] + reach <= image.shape[1] - 1.0
        and p[1] + reach <= image.shape[0] - 1.0
    )


@njit(cache=True, nogil=True)
def _accumulate(A, image, p, W, half, set_levels):
    """Fills the lower triangle of A (8, 8) with J^T J of the pixels within `half` px of the edge. Returns J^T error
    (8,) and the number of pixels.

    With `set_levels` the grey levels p[3], p[4] are first set to the means inside and outside.
    """
    large, _ = _half_axes(W)
    x0, x1 = int(np.ceil(p[0] - large - half)), int(p[0] + large + half)
    y0, y1 = int(np.ceil(p[1] - large - half)), int(p[1] + large + half)
    if set_levels:
        _set_levels(image, p, W, half, x0, x1, y0, y1)
    A[:] = 0.0
    b, J, n = np.zeros(_SIZE), np.empty(_SIZE), 0
    contrast, blur = p[4] - p[3], p[2]
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            d, t0, t1, s0, s1, gradient, radius = _distance(W, x - p[0], y - p[1])
            if not abs(d) <= half:
                continue
            z = d / blur
            share = 0.5 * (1.0 + erf(z / sqrt(2.0)))
            slope = contrast * exp(-0.5 * z * z) / (sqrt(2.0 * pi) * blur)
            J[0], J[1] = -slope * s0 / gradient, -slope * s1 / gradient
            J[2], J[3] = slope * radius * t0 * t0 / gradient, slope * radius * t1 * t1 / gradient
            J[4] = slope * 2.0 * radius * t0 * t1 / gradient
            J[5], J[6], J[7] = -slope * z, 1.0 - share, share
            error = image[y, x] - p[3] - contrast * share
            n += 1
            for i in range(_SIZE):
                b[i] += J[i] * error
                for j in range(i + 1):
                    A[i, j] += J[i] * J[j]
    for i in range(_SIZE):
        A[i, i] *= 1.0 + 1e-9  # keeps A positive definite to rounding
    return b, n


@njit(cache=True, nogil=True)
def _distance(W, x, y):
    """Sampson distance [px] of the pixel u = (x, y) from the ellipse |W u| = 1, positive outside, and its terms.

    The terms: the unit vector W u / |W u| (2), the gradient of |W u| [1/px] (2), its length, and |W u|.
    """
    a, b = W[0, 0] * x + W[0, 1] * y, W[1, 0] * x + W[1, 1] * y
    radius = max(hypot(a, b), 1e-9)
    t0, t1 = a / radius, b / radius
    s0, s1 = t0 * W[0, 0] + t1 * W[1, 0], t0 * W[0, 1] + t1 * W[1, 1]
    gradient = max(hypot(s0, s1), 1e-12)  # zero at the very centre
    return (radius - 1.0) / gradient, t0, t1, s0, s1, gradient, radius


@njit(cache=True, nogil=True)
def _set_levels(image, p, W, half, x0, x1, y0, y1):
    """Sets p[3], p[4] to the mean grey levels inside and outside, from the pixels of the strip that are farthest from
    the edge."""
    inside, n_inside, outside, n_outside = 0.0, 0, 0.0, 0
    for y in range(y0, y1 + 1):
        for x in range(x0, x1 + 1):
            d = _distance(W, x - p[0], y - p[1])[0]
            if -half <= d <= -0.5 * half:
                inside += image[y, x]
                n_inside += 1
            elif 0.5 * half <= d <= half:
                outside += image[y, x]
                n_outside += 1
    p[3], p[4] = inside / max(n_inside, 1), outside / max(n_outside, 1)
