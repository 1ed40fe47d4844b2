"""Targets are searched where the images before lead to expect them; what is found is that of a search of all."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import islice

import numpy as np
import pytest
from tests.cases import each
from tests.typed import instance

from icalib.detection.decoding import ImageCorners, mapped, no_corners
from icalib.detection.detectors import _Detector, _Follower, detector_of
from icalib.detection.growth import PredictedCorners, predict_corners, predict_nodes
from icalib.detection.tags import ImageWithQuads
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Circles
from icalib.tools.simulation import HandheldMotion, film, handheld

pytest.importorskip("cv2")

TARGETS = {
    "grid": AprilGrid(6, 6, 0.088, 0.3),
    "plain grid": AprilGrid(5, 5, 0.1, 0.4, border_bits=2, squares=False, first_id=7),
    "charuco": Charuco(8, 6, 0.08, 0.06, "5x5_100"),
    "inverted charuco": Charuco(7, 5, 0.09, 0.07, "4x4_50", inverted=True),
    "checkerboard": Checkerboard(6, 9, 0.06),
    "checkerboard from the side": Checkerboard(7, 6, 0.06),
    "circles": Circles(11, 4, 0.03, 0.026, asymmetric=True),
}


def corners(point, uv) -> ImageCorners:
    n = len(point)
    return ImageCorners(np.array(point), np.array(uv, float), np.full(n, 0.03), np.ones(n), np.zeros(n, np.int8))


def test_corners_move_on_with_their_acceleration():
    start = np.random.default_rng(0).uniform(50.0, 400.0, (6, 2))
    at = [start + np.array([7.0, -3.0]) * t + np.array([-1.5, 0.5]) * t**2 for t in range(4)]
    points = [[2, 3, 5, 6, 8, 9], [1, 2, 3, 5, 6, 8], [2, 3, 5, 6, 8, 20]]
    # Point 20 is new; it stands where point 9 stood, nearest to point 8.
    rows = [range(6), [0, 0, 1, 2, 3, 4], [0, 1, 2, 3, 4, 4]]
    images = [corners(p, at[t][list(r)]) for t, (p, r) in enumerate(zip(points, rows, strict=True))]
    expected = predict_corners(images)
    assert expected is not None
    np.testing.assert_array_equal(expected.point, points[2])
    np.testing.assert_allclose(expected.uv, at[3][list(rows[2])])
    # Two images show their speed alone.
    expected = predict_corners(images[1:])
    assert expected is not None
    np.testing.assert_allclose(expected.uv[:5], (2.0 * at[2] - at[1])[:5])
    # So do three, of which the first shows nothing in common.
    expected = predict_corners([corners([30, 31], start[:2]), *images[1:]])
    assert expected is not None
    np.testing.assert_allclose(expected.uv[:5], (2.0 * at[2] - at[1])[:5])


@pytest.mark.parametrize("n", [0, 1])
def test_without_two_images_that_show_the_target_nothing_is_expected(n):
    one = corners(range(5), np.zeros((5, 2)))
    assert predict_corners([one] * n) is None
    assert predict_corners([one, no_corners()]) is None
    assert predict_corners([no_corners(), one]) is None
    assert predict_corners([one, one, corners([7, 8, 9, 10], np.zeros((4, 2)))]) is None


def test_nodes_that_were_not_seen_lie_on_the_board():
    H = np.array([[30.0, 4.0, 100.0], [-3.0, 28.0, 80.0], [0.01, -0.02, 1.0]])
    every = np.moveaxis(np.indices((5, 7)), 0, -1).reshape(-1, 2)
    true = np.array([mapped(H, float(row), float(col)) for row, col in every])
    seen = ((every >= 1) & (every < [4, 6])).all(axis=1) & (np.arange(35) % 4 > 0)
    np.testing.assert_allclose(predict_nodes(every[seen], true[seen], 5, 7).reshape(-1, 2), true, atol=1e-6)


@cache
def filmed(name):
    """Seven images of a target, 50 ms apart."""
    base = handheld(0.65)
    motion = HandheldMotion(rotation_scale=0.5, translation_scale=0.5, seed=1)
    run = film(replace(base, target=TARGETS[name], motion=motion, cameras=(base.cameras[0],)), 0)
    return [shot.pixels for shot in islice(run.shots(), 7)]


@each("name", TARGETS)
def test_what_is_found_near_is_what_a_search_of_the_whole_image_finds(name, monkeypatch):
    detector, images = detector_of(TARGETS[name]), filmed(name)
    whole = [detector.detect(image) for image in images]
    kind = type(instance(detector, _Detector).finder)
    searched, plain = [], kind.find
    monkeypatch.setattr(kind, "find", lambda self, view: searched.append(view) or plain(self, view))
    found: list[ImageCorners] = []
    for image in images:
        found.append(detector.detect(image, found[-3:]))
    # The third image may be found by speed alone, and from there on the acceleration is known.
    assert 2 <= len(searched) <= 3
    for a, b in zip(whole, found, strict=True):
        assert len(a.point) > 20
        common, i, j = np.intersect1d(a.point[a.kept], b.point[b.kept], return_indices=True)
        assert len(common) >= a.kept.sum() - 1
        apart = np.abs(a.uv[a.kept][i] - b.uv[b.kept][j])
        assert np.sqrt((apart**2).mean()) < 2e-4 and np.quantile(apart, 0.99) < 1e-3


@each("name", ["grid", "charuco", "checkerboard"])
def test_a_target_that_jumped_is_searched_for(name):
    detector, images = detector_of(TARGETS[name]), filmed(name)[:3]
    before = [detector.detect(image) for image in images[:2]]
    for moved in (np.roll(images[2], 60, axis=1), np.full_like(images[2], 128)):
        a, b = detector.detect(moved), detector.detect(moved, before)
        np.testing.assert_array_equal(a.point, b.point)
        np.testing.assert_array_equal(a.uv, b.uv)


@each("name", ["charuco", "checkerboard"])
@each("squares", [(2, 0), (0, 2), (1, 1)])
def test_a_board_is_not_taken_for_one_that_is_some_squares_away(name, squares):
    """Where it is expected, its squares look right."""
    detector, image = detector_of(TARGETS[name]), filmed(name)[0]
    found, cols = detector.detect(image), {"charuco": 5, "checkerboard": 9}[name]
    at = np.stack(np.divmod(found.point, cols), axis=1)
    rows = at.max(axis=0)[0] + 1
    shifted = predict_nodes(at + 2, found.uv, rows + 4, cols + 4)[
        2 + squares[0] : 2 + squares[0] + rows, 2 + squares[1] : 2 + squares[1] + cols
    ]
    expected = PredictedCorners(np.arange(rows * cols), shifted.reshape(-1, 2))
    finder = instance(instance(detector, _Detector).finder, _Follower)
    assert finder.find_near(ImageWithQuads(image), expected) is None
