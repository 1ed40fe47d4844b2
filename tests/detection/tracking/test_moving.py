"""Features that move by themselves, seen through lenses that nobody knows, against a scene that stands still."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.detection.tracker import epipolar_errors
from icalib.sensors.camera.read.image_tracks import moving_features

SIZE = (752, 480)
CENTRE = np.array([375.5, 239.5])
IMAGES = 10


def _turned(angles: np.ndarray) -> np.ndarray:
    """(3, 3) about x, then y, then z."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(angles), np.sin(angles)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ about_y @ about_x


def _radtan(points: np.ndarray) -> np.ndarray:
    x, y = (points[:, :2] / points[:, 2:]).T
    r2 = x * x + y * y
    return CENTRE + 460.0 * np.column_stack([x, y]) * (1.0 - 0.28 * r2 + 0.07 * r2 * r2)[:, None]


def _fisheye(points: np.ndarray) -> np.ndarray:
    off = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    return CENTRE + 230.0 * off[:, None] * points[:, :2] / np.hypot(points[:, 0], points[:, 1])[:, None]


def _seen(lens, walking: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """start, feature and uv of 100 points of a room while they are in the picture; the first `walking` belong to a body
    that walks."""
    wide = np.array([2.0, 1.3]) * (1.0 if lens is _radtan else 2.0)
    points = np.column_stack([rng.uniform(-wide, wide, (100, 2)), rng.uniform(2, 6, 100)])
    points[:walking] = [0.6, 0.0, 3.0] + rng.uniform(-0.4, 0.4, (walking, 3))
    count, feature, uv = [], [], []
    for k in range(IMAGES):
        moved = points.copy()
        moved[:walking] += k * np.array([-0.06, 0.05, 0.02])
        R, p = _turned(k * np.array([0.005, 0.012, -0.02])), k * np.array([0.05, 0.01, 0.03])
        local = (moved - p) @ R
        pixels = lens(local) + 0.1 * rng.normal(size=(100, 2))
        inside = ((pixels > 0) & (pixels < np.array(SIZE) - 1)).all(axis=1)
        inside &= np.hypot(*local[:, :2].T) < (1.0 if lens is _radtan else 3.0) * local[:, 2]
        count.append(int(inside.sum()))
        feature.append(np.flatnonzero(inside))
        uv.append(pixels[inside])
    return np.cumsum([0, *count]), np.concatenate(feature), np.concatenate(uv)


@each("lens", [_radtan, _fisheye])
@each("walking", [0, 10, 20])
def test_a_body_that_walks_is_told_from_the_room(lens, walking):
    start, feature, uv = _seen(lens, walking, np.random.default_rng(walking))
    found = np.append(moving_features(start, feature, uv, SIZE), np.zeros(100, dtype=bool))[:100]
    often = np.bincount(feature, minlength=100) > 4
    assert found[:walking][often[:walking]].mean() >= 0.9 if walking else not found[:walking].any()
    assert found[walking:].mean() < 0.02


def test_a_single_wrong_match_ends_no_track():
    """One of ten observations 5 px off is the outlier rejection's matter, which comes later."""
    start, feature, uv = _seen(_radtan, 0, np.random.default_rng(1))
    lasting = np.flatnonzero(np.bincount(feature) == IMAGES)[0]
    uv[np.flatnonzero(feature == lasting)[4]] += [3.0, 4.0]
    assert not moving_features(start, feature, uv, SIZE)[lasting]


def test_errors_are_distances_in_the_image():
    """Of a camera that moves to the right points move along rows; what is 2 px beside its row is so far off, up to the
    share of the other image."""
    rng = np.random.default_rng(0)
    p = rng.uniform(-300, 300, (40, 2))
    q = p - np.column_stack([rng.uniform(5, 40, 40), np.zeros(40)])
    q[3, 1] += 2.0
    error, sigma = epipolar_errors(p / 400.0, q / 400.0, 0.0, 0)
    assert 400.0 * error[3] == pytest.approx(np.sqrt(2.0), rel=1e-3)
    assert 400.0 * np.delete(error, 3).max() < 1e-6 and sigma < 1e-6


def test_few_points_tell_nothing():
    start, feature, uv = _seen(_radtan, 30, np.random.default_rng(2))
    some = feature < 12
    begin = np.concatenate([[0], np.cumsum(some)])[start]
    assert not moving_features(begin, feature[some], uv[some], SIZE).any()
