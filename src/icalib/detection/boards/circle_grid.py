"""Finds the dark ellipses of an image that are the circles of a grid.

Each ellipse shows the affine map between target and image about its circle, up to a rotation. Neighbours are therefore
recognised in the coordinates of the ellipse, under any perspective. The grid grows from one circle and two neighbours:
each further circle is searched at its prediction by the nearest known ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.base.extras import load_cv2
from icalib.detection.primitives.decoding import mapped, nearest_greys
from icalib.detection.primitives.ellipse_model import LEAST_HALF_AXIS_PX
from icalib.detection.primitives.growth import fit_homography
from icalib.detection.primitives.tags import LEAST_CONTRAST
from icalib.geometry.targets import Circles

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
