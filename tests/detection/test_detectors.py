"""What the detectors leave out, in what order they number, and every error that a user can meet."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from tests.cases import each

from icalib.base.extras import load_cv2
from icalib.detection import (
    VERDICTS,
    AprilGridDetector,
    CharucoDetector,
    CheckerboardDetector,
    ImageCorners,
    MarkerDetector,
    corner_stream,
)
from icalib.detection.decoding import with_verdicts
from icalib.detection.detectors import detector_of
from icalib.detection.tags import tag_family
from icalib.errors import CalibrationError, RecordingError
from icalib.geometry.targets import Charuco
from icalib.geometry.targets.boards import pattern_of
from icalib.geometry.targets.families import FAMILIES, opencv_bits

cv2 = pytest.importorskip("cv2")

FRONTAL = (1.0, 10.0, 30.0, 12.0, (5.0, -3.0))


def tag_cells(pattern, tag, cols=6, n=10, gap=3):
    row, col = divmod(tag, cols)
    y, x = gap + row * (n + gap), gap + col * (n + gap)
    return slice(y, y + n), slice(x, x + n)


def test_points_are_numbered_as_the_target_numbers_them(rendering):
    from icalib.geometry.targets import AprilGrid

    pattern = rendering.aprilgrid(6, 6)
    H = rendering.homography(pattern, *FRONTAL)
    found = AprilGridDetector(6, 6, 0.3).detect(rendering.render(pattern, H))
    # The pattern begins with a row of squares, 3 cells of 8.8 mm, and the target at corner 0 of tag 0.
    truth = rendering.applied(H, AprilGrid(6, 6, 0.088, 0.3).points[:, :2] + 0.0264)
    assert found.kept.all() and len(found.point) == 144
    np.testing.assert_allclose(found.uv, truth[found.point], atol=0.1)


def test_a_tag_that_appears_twice_is_found_once_where_it_belongs(rendering):
    pattern = rendering.aprilgrid(6, 6)
    pattern.white[tag_cells(pattern, 20)] = pattern.white[tag_cells(pattern, 0)]
    H = rendering.homography(pattern, *FRONTAL)
    found = AprilGridDetector(6, 6, 0.3).detect(rendering.render(pattern, H))
    assert sorted(set(found.point // 4)) == [tag for tag in range(36) if tag != 20]
    errors = rendering.errors(pattern, H, found.point, found.uv)
    assert np.abs(errors.uv).max() < 0.2


def test_tags_that_are_not_on_the_board_are_left_out(rendering):
    pattern = rendering.aprilgrid(6, 6)
    image = rendering.render(pattern, rendering.homography(pattern, *FRONTAL))
    # Of a board of 2 x 6 the first two rows are there.
    assert set(AprilGridDetector(2, 6, 0.3).detect(image).point) == set(range(48))


def test_a_tag_that_is_hidden_is_left_out(rendering):
    pattern = rendering.aprilgrid(6, 6)
    rows, cols = tag_cells(pattern, 14)
    pattern.white[rows, cols] = np.random.default_rng(0).random((10, 10)) < 0.5
    found = AprilGridDetector(6, 6, 0.3).detect(rendering.render(pattern, rendering.homography(pattern, *FRONTAL)))
    assert set(range(36)) - set(found.point[found.kept] // 4) == {14}


@each(
    "detector",
    [
        AprilGridDetector(6, 6, 0.3),
        CharucoDetector(6, 9, 0.75, "4x4_50"),
        CheckerboardDetector(6, 9),
        MarkerDetector("4x4_50", tuple(range(50))),
        MarkerDetector("tag36h11", (3,)),
    ],
)
def test_nothing_is_found_in_clutter(detector):
    rng = np.random.default_rng(1)
    for blur in (0.0, 2.0, 8.0):
        clutter = rng.standard_normal((480, 752))
        clutter = cv2.GaussianBlur(clutter, (0, 0), blur) if blur > 0.0 else clutter
        image = cv2.normalize(clutter, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
        found = detector.detect(image)
        assert len(found.point) == len(found.uv) == 0
    assert len(detector.detect(np.full((480, 752), 255, dtype=np.uint8)).point) == 0


def test_views_of_an_image_are_read_and_not_written(rendering):
    pattern = rendering.aprilgrid(6, 6)
    image = rendering.render(pattern, rendering.homography(pattern, *FRONTAL))
    wide = np.repeat(image[:, :, None], 3, axis=2)
    before = wide.copy()
    found = AprilGridDetector(6, 6, 0.3).detect(wide[:, :, 1])
    np.testing.assert_array_equal(found.uv, AprilGridDetector(6, 6, 0.3).detect(image).uv)
    np.testing.assert_array_equal(wide, before)


@pytest.mark.parametrize("rows", [5, 6])
def test_legacy_charuco_boards_are_opencvs(rows):
    source = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    board = cv2.aruco.CharucoBoard((7, rows), 1.0, 0.75, source)
    board.setLegacyPattern(True)
    image = cv2.GaussianBlur(board.generateImage((640, 480), None, 24, 1), (0, 0), 0.8)
    found = CharucoDetector(rows, 7, 0.75, "4x4_50", legacy=True).detect(image)
    assert found.point.tolist() == list(range(6 * (rows - 1)))
    side = min((640 - 48) / 7.0, (480 - 48) / rows)
    corner = 0.5 * np.array([640, 480]) - 0.5 * side * np.array([7, rows]) - 0.5
    expected = corner + side * np.asarray(board.getChessboardCorners())[:, :2]
    np.testing.assert_allclose(found.uv, expected, atol=1.0)  # OpenCV rounds the squares' places to pixels


@pytest.mark.parametrize("family", ["5x5_100", "DICT_APRILTAG_36h11"])
def test_a_charuco_board_is_read_alike_from_opencvs_print_and_ours(family):
    """OpenCV's picture of the board, and ours, of the same size at the same place."""
    target, cell = Charuco(7, 5, 0.07, 0.05, family), 80
    name = next(n for n in dir(cv2.aruco) if n.lower() == f"dict_{family.lower().removeprefix('dict_')}")
    source = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    theirs = cv2.aruco.CharucoBoard((7, 5), 0.07, 0.05, source).generateImage((7 * cell, 5 * cell), None, 0, 1)
    pattern = pattern_of(target)
    x, y = ((np.arange(n * cell) + 0.5) * 0.07 / cell for n in (7, 5))
    rows, cols = np.searchsorted(pattern.y, 0.07 - y) - 1, np.searchsorted(pattern.x, x - 0.07) - 1
    ours = np.where(pattern.white[rows[:, None], cols], 255, 0).astype(np.uint8)
    for board in (theirs, ours):
        image = cv2.GaussianBlur(np.pad(board, 30, constant_values=255), (0, 0), 0.8)
        found = detector_of(target).detect(image)
        assert found.kept.all() and found.point.tolist() == list(range(24))
        expected = target.points[:, :2] * [1.0, -1.0] / 0.07 * cell + 30 + cell - 0.5
        np.testing.assert_allclose(found.uv, expected, atol=0.02)


def test_a_symmetric_checkerboard_runs_to_the_right(rendering):
    for rows, cols, roll in [(5, 7, 60.0), (5, 7, -60.0), (6, 6, 40.0), (6, 6, -40.0)]:
        pattern = rendering.checkerboard(rows, cols)
        H = rendering.homography(pattern, 0.8, 10.0, 30.0, roll, (0.0, 0.0), False)
        found = CheckerboardDetector(rows, cols).detect(rendering.render(pattern, H))
        assert len(found.point) == rows * cols
        np.testing.assert_allclose(found.uv, rendering.applied(H, pattern.points)[found.point], atol=0.1)


@each(
    ("make", "sentence"),
    [
        (lambda: AprilGridDetector(30, 30, 0.3), r"30 x 30 tags needs more ids than tag36h11 has \(587\); check rows"),
        (
            lambda: AprilGridDetector(6, 6, 0.3, family="tag37"),
            "no tag family 'tag37', did you mean 'tag36h11'",
        ),
        (lambda: CharucoDetector(20, 20, 0.7, "4x4_50"), "needs 200 markers and 4x4_50 has 50; check rows"),
        (lambda: CharucoDetector(5, 5, 1.2, "4x4_50"), "marker_ratio is 1.2; give the marker's edge divided"),
        (lambda: CheckerboardDetector(2, 9), "2 x 9 inner corners is too small; use one of 3 x 4 or more"),
        (lambda: MarkerDetector("4x4_50", (50,)), r"id 50 is not one of 4x4_50 \(0 to 49\) or is listed twice"),
        (lambda: MarkerDetector("4x4_50", (7, 7)), "id 7 is not one of .* or is listed twice; correct the list"),
        (lambda: AprilGridDetector(6, 6, 0.3).detect(np.zeros((9, 9, 3), np.uint8)), r"convert it to grey levels"),
        (lambda: MarkerDetector("4x4_50", (7,)).detect(np.zeros((9, 9))), "type float64; convert it to grey levels"),
    ],
)
def test_errors_say_what_to_do(make, sentence):
    with pytest.raises(CalibrationError, match=sentence):
        make()


def test_without_opencv_the_extra_is_named(monkeypatch):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(importlib, "import_module", absent)
    with pytest.raises(RecordingError, match=r"not installed; run pip install .\.\[images\]"):
        load_cv2()


def test_a_family_that_an_old_opencv_lacks_is_refused(monkeypatch):
    monkeypatch.delattr(cv2.aruco, "DICT_ARUCO_MIP_36h12")
    opencv_bits.cache_clear()
    with pytest.raises(RecordingError, match="has no tags of aruco_mip_36h12; update opencv-python-headless"):
        opencv_bits("aruco_mip_36h12")


@each("name", FAMILIES)
def test_families_are_read_from_opencv(name):
    family = tag_family(name)
    assert family.codes.shape[1] == 4 and 4 <= family.bits <= 7
    if name.startswith("tag"):
        cells, distance = name[3:].split("h")
        assert family.bits**2 == int(cells)
        assert 0 <= family.max_errors <= (int(distance) - 1) // 2


def corners(points, verdicts=None):
    n = len(points)
    verdict = np.zeros(n, dtype=np.int8) if verdicts is None else np.array(verdicts, dtype=np.int8)
    return ImageCorners(np.array(points), np.arange(2.0 * n).reshape(n, 2), np.full(n, 0.03), np.ones(n), verdict)


def test_only_kept_corners_enter_a_stream():
    stream = corner_stream("cam0", np.array([5, 9, 12]), [corners([3, 8, 9], [0, 2, 0]), corners([]), corners([1])])
    assert stream.start.tolist() == [0, 2, 2, 3]
    assert stream.point.tolist() == [3, 9, 1]
    assert stream.uv.tolist() == [[0.0, 1.0], [4.0, 5.0], [0.0, 1.0]]
    assert stream.sigma.tolist() == [0.03, 0.03, 0.03]
    with pytest.raises(RecordingError, match="cam0: the image at 9 ns does not come after the one at 9 ns; sort"):
        corner_stream("cam0", np.array([9, 9]), [corners([1]), corners([2])])
    with pytest.raises(RecordingError, match="cam0: 1 images have 2 stamps; give one for each"):
        corner_stream("cam0", np.array([5, 9]), [corners([1])])


def test_verdicts_follow_the_rule():
    #                  kept, faint, blurred, oblique, inconsistent, not found, all at once
    unit_sigma = np.array([0.01, 0.2, 0.01, 0.01, 0.01, np.nan, 0.2])
    room_px = np.array([0.1, 0.1, -0.1, 0.1, 0.1, 0.1, -0.1])
    sine = np.array([1.0, 1.0, 1.0, 0.25, 1.0, 1.0, 0.25])
    quality = np.stack([unit_sigma, np.ones(7), sine, room_px, np.ones(7)])
    consistent = np.array([True, True, True, True, False, True, False])
    found = with_verdicts(np.arange(7)[::-1], np.zeros((7, 2)), quality, consistent)
    assert found.point.tolist() == [0, 2, 3, 4, 5, 6]
    assert [VERDICTS[v] for v in found.verdict] == [
        "inconsistent",
        "inconsistent",
        "oblique",
        "blurred",
        "faint",
        "kept",
    ]
    assert found.counts() == {"kept": 1, "faint": 1, "blurred": 1, "oblique": 1, "inconsistent": 2}
    assert found.sigma[-1] == pytest.approx(np.hypot(0.02, 0.02))
