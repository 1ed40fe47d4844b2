"""Checkerboards that are hard to find, look like other boards, or look alike after half a turn."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from tests.cases import each

from icalib.detection import CheckerboardDetector, detectors
from icalib.detection import checkerboard as module
from icalib.detection.checkerboard import shows_grid
from icalib.detection.decoding import ImageCorners
from icalib.detection.detectors import checkerboard_in, detector_of
from icalib.detection.images import number_continuously
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Circles, Scene


@pytest.fixture
def board(rendering):
    """(grey (h, w) uint8, the true places of the corners) of 6 x 9 corners, tilted."""
    pattern = rendering.checkerboard(6, 9)
    H = rendering.homography(pattern, 0.9, 25.0, 40.0, 10.0, (0.0, 0.0), False)
    return rendering.render(pattern, H), rendering.applied(H, pattern.points)


@pytest.mark.parametrize(
    "sizes", [((5, 9), (7, 10), (3, 4)), pytest.param(((6, 8), (5, 8), (9, 9)), marks=pytest.mark.full)]
)
def test_a_board_of_another_size_is_not_found(board, sizes):
    for size in sizes:
        assert not len(CheckerboardDetector(*size).detect(board[0]).point), size


def test_a_board_that_opencv_imagines_is_not_named(board, rendering, monkeypatch):
    """OpenCV's search for any size sees boards in windows and shelves; icalib's detector has to find them, too."""
    tags = rendering.aprilgrid(6, 6)
    image = rendering.render(tags, rendering.homography(tags, 0.9, 30.0, 20.0, 5.0, (0.0, 0.0)))
    assert checkerboard_in([board[0], board[0]]) == "a checkerboard of 6 x 9 inner corners"
    monkeypatch.setattr(detectors, "_largest_boards", lambda image: [(3, 4)])
    assert checkerboard_in([image, image]) == ""


def test_tags_are_no_checkerboard(rendering):
    pattern = rendering.aprilgrid(6, 6)
    for tilt in (0.0, 30.0, 50.0):
        image = rendering.render(pattern, rendering.homography(pattern, 0.9, tilt, 20.0, 5.0, (0.0, 0.0)))
        assert not shows_grid(image, 14)
        for rows, cols in [(6, 9), (4, 5), (5, 6)]:
            assert not len(CheckerboardDetector(rows, cols).detect(image).point)


def test_a_checkerboard_is_not_seen_in_the_squares_of_a_charuco_board(rendering):
    pattern = rendering.charuco(5, 6)
    H = rendering.homography(pattern, 0.7, 20.0, 20.0, 5.0, (0.0, 0.0), False)
    board, tagged = Checkerboard(4, 5, 0.06), Charuco(6, 5, 0.06, 0.04, "4x4_50")
    alone = detector_of(board).detect(rendering.render(pattern, H))
    both = detector_of(Scene(("board", "tagged"), (board, tagged))).detect(rendering.render(pattern, H))
    assert len(alone.point) == 20 and both.point.tolist() == list(range(20, 40))


def test_each_search_finds_the_board_alike(board, monkeypatch):
    """The quick search, in a reduced image and in the whole one, and the thorough one: the corners are the same."""
    image, truth = board
    cv2_quick, cv2_thorough = cv2.findChessboardCorners, cv2.findChessboardCornersSB
    usual = CheckerboardDetector(6, 9).detect(image)
    np.testing.assert_allclose(usual.uv, truth[usual.point], atol=0.06)
    monkeypatch.setattr(module, "_REDUCED_PX", 400)
    asked = []

    def quick(image, size, **options):
        asked.append(image.shape)
        return cv2_quick(image, size, **options) if allowed(image.shape) else (False, None)

    def thorough(image, size, **options):
        asked.append("thorough")
        return cv2_thorough(image, size, **options) if allowed("thorough") else (False, None)

    monkeypatch.setattr(cv2, "findChessboardCorners", quick)
    monkeypatch.setattr(cv2, "findChessboardCornersSB", thorough)
    searches = [(240, 376), "thorough", (480, 752)]
    for k, one in enumerate(searches):
        asked.clear()
        allowed = lambda shape, one=one: shape == one  # noqa: E731
        found = CheckerboardDetector(6, 9).detect(image)
        assert asked == searches[: k + 1]
        np.testing.assert_array_equal(found.point, usual.point)
        np.testing.assert_allclose(found.uv, usual.uv, atol=2e-3)
        np.testing.assert_allclose(found.sigma, usual.sigma, rtol=1e-2)


def test_an_image_without_rows_of_corners_is_not_searched_thoroughly(monkeypatch):
    noise = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (480, 752), dtype=np.uint8), (0, 0), 4.0)
    image = np.interp(noise, (noise.min(), noise.max()), (0, 255)).astype(np.uint8)
    monkeypatch.setattr(cv2, "findChessboardCornersSB", lambda *_, **__: pytest.fail("searched"))
    assert not len(CheckerboardDetector(6, 9).detect(image).point)


@each("blur", [0.7, 2.0, 4.0])
def test_a_blurred_board_stands_in_rows(rendering, blur):
    pattern = rendering.checkerboard(6, 9)
    H = rendering.homography(pattern, 0.9, 25.0, 40.0, 10.0, (0.0, 0.0), False)
    assert shows_grid(rendering.render(pattern, H, blur=blur), 28)


def test_a_board_that_opencvs_plain_search_misses(camera_lidar_board):
    """One of 20 images by a fisheye camera: CALIB_CB_EXHAUSTIVE finds it, and so does the older detector."""
    image = cv2.imread(str(camera_lidar_board / "pose14.jpg"), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    found, theirs = cv2.findChessboardCornersSB(image, (5, 7), flags=cv2.CALIB_CB_EXHAUSTIVE)
    ours = CheckerboardDetector(7, 5).detect(image)
    assert found and ours.kept.sum() == 35
    apart = np.linalg.norm(ours.uv[:, None] - np.asarray(theirs).reshape(1, 35, 2), axis=2).min(axis=1)
    assert np.median(apart) < 0.2


def turning(target: Checkerboard, upright: bool) -> list[ImageCorners]:
    """Corners while the board turns all the way round, 15 degrees from image to image; with `upright` numbered as the
    detector does. Every eighth image shows nothing."""
    images, at = [], target.points[:, :2] - target.points[:, :2].mean(axis=0)
    for k in range(40):
        angle = np.radians(15.0 * k + 5.0)
        R = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        uv = 1000.0 * at * (1.0, -1.0) @ R + (400.0 + 3.0 * k, 300.0)
        number = np.arange(len(uv))
        if upright:
            ends = [uv[np.argsort(turn)][[0, target.cols - 1], 0] for turn in target.turns]
            number = target.turns[int(np.argmax([b - a for a, b in ends]))]
        order = np.argsort(number)
        shown = np.random.default_rng(k).random(len(uv)) < 0.8 * (k % 8 != 7)
        seen = order[shown[order]]
        one = np.ones(len(seen))
        images.append(ImageCorners(np.sort(number[seen]), uv[seen], one, one, np.zeros(len(seen), np.int8)))
    return images


@each("board", [Checkerboard(6, 8, 0.03), Checkerboard(5, 7, 0.03), Checkerboard(6, 6, 0.03)])
def test_a_board_that_turns_keeps_its_numbers(board):
    truth, images = turning(board, False), turning(board, True)
    assert any(not np.array_equal(a.point, b.point) for a, b in zip(truth, images, strict=True))
    scene = Scene(("grid", "board"), (AprilGrid(2, 2, 0.1, 0.3), board))
    for target, first in ((board, 0), (scene, 16)):
        shifted = [ImageCorners(i.point + first, i.uv, i.sigma, i.blur, i.verdict) for i in images]
        for a, b in zip(truth, number_continuously(target, shifted), strict=True):
            np.testing.assert_array_equal(b.point, a.point + first)
            np.testing.assert_allclose(b.uv, a.uv)


def partial_views(target: Checkerboard | Circles, shown: list[np.ndarray]) -> list[ImageCorners]:
    """A tilted board that turns by 10 degrees from image to image, seen by a pinhole camera; image k shows shown[k]."""
    images, at = [], target.points[:, :2] - target.points[:, :2].mean(axis=0)
    size = np.ptp(at, axis=0).max()
    for k, point in enumerate(shown):
        angle = np.radians(10.0 * k)
        x, y = (at @ [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]).T / size
        tilt = np.radians(45.0)
        uv = 500.0 * np.stack([x, y * np.cos(tilt)], axis=1) / (1.3 + y * np.sin(tilt))[:, None] + (320.0 + k, 240.0)
        one = np.ones(len(point))
        images.append(ImageCorners(np.sort(point), uv[np.sort(point)], one, one, np.zeros(len(point), np.int8)))
    return images


@each(
    "target", [Checkerboard(6, 8, 0.03), Checkerboard(5, 9, 0.03), Checkerboard(6, 6, 0.03), Circles(7, 7, 0.04, 0.02)]
)
def test_images_that_show_different_parts_of_a_board_are_numbered_alike(target):
    """In the right turn some images share no point with the one before; a wrong turn shares many."""
    row, col = np.divmod(np.arange(len(target.points)), target.cols)
    half = target.cols // 2
    left, right, line = col < half, col >= target.cols - half, row == 0
    parts = [left, right, left, line, right, (col < 2), (col >= target.cols - 2), row < 3, row >= target.rows - 3, left]
    truth = partial_views(target, [part.nonzero()[0] for part in parts])
    for seed in range(8):
        rng = np.random.default_rng(seed)
        given = [truth[0]]
        for image in truth[1:]:
            number = target.turns[rng.integers(len(target.turns))][image.point]
            order = np.argsort(number)
            one = np.ones(len(order))
            given.append(ImageCorners(number[order], image.uv[order], one, one, np.zeros(len(order), np.int8)))
        for a, b in zip(truth, number_continuously(target, given), strict=True):
            np.testing.assert_array_equal(b.point, a.point)
            np.testing.assert_array_equal(b.uv, a.uv)


def test_an_upright_board_keeps_the_detectors_numbers():
    images = turning(Checkerboard(6, 8, 0.03), True)
    kept = number_continuously(Checkerboard(6, 8, 0.03, upright=True), images)
    for a, b in zip(images, kept, strict=True):
        np.testing.assert_array_equal(a.point, b.point)
        np.testing.assert_array_equal(a.uv, b.uv)
