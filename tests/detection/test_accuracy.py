"""Every target's corners in rendered images: found, within hundredths of a pixel, and without bias."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.detection import AprilGridDetector, CharucoDetector, CheckerboardDetector, MarkerDetector

pytestmark = pytest.mark.slow

pytest.importorskip("cv2")

# distance [m], tilt, turn, roll [deg], offset [px]
POSES = {
    "frontal": (0.75, 3.0, 20.0, 5.0, (3.3, 1.7)),
    "tilted": (0.8, 45.0, 70.0, 10.0, (0.0, 0.0)),
    "oblique": (0.8, 60.0, 20.0, 33.0, (10.0, 0.0)),
    "small": (2.0, 20.0, 0.0, 25.0, (50.0, 30.0)),
    "upside down": (0.9, 20.0, 50.0, 170.0, (15.0, 8.0)),
    "cut": (0.5, 30.0, 50.0, 15.0, (150.0, 80.0)),
}
ALL = dict.fromkeys(POSES, 0.97)

# target: (name and arguments in `rendering`, detector, y up, least share of the visible corners kept at blur 0.7)
TARGETS = {
    "kalibr": (("aprilgrid", 6, 6, 2, 3, True), AprilGridDetector(6, 6, 0.3), True, ALL | {"cut": 0.9}),
    "one-bit squares": (
        ("aprilgrid", 6, 6, 1, 2, True),
        AprilGridDetector(6, 6, 0.25, border_bits=1),
        True,
        ALL | {"oblique": 0.85, "cut": 0.9},
    ),
    "two-bit plain": (
        ("aprilgrid", 6, 6, 2, 3, False),
        AprilGridDetector(6, 6, 0.3, squares=False),
        True,
        ALL | {"oblique": 0.85, "cut": 0.7},
    ),
    "one-bit plain": (
        ("aprilgrid", 5, 5, 1, 4, False),
        AprilGridDetector(5, 5, 0.5, border_bits=1, squares=False),
        True,
        ALL | {"tilted": 0.9, "oblique": 0.45, "small": 0.0, "cut": 0.7},
    ),
    "charuco": (("charuco", 6, 9, "4X4_50"), CharucoDetector(6, 9, 0.75, "4x4_50"), False, ALL | {"small": 0.9}),
    "charuco 5x5": (
        ("charuco", 5, 8, "5X5_100"),
        CharucoDetector(5, 8, 7.0 / 9.0, "5x5_100"),
        False,
        ALL | {"small": 0.5},
    ),
    "charuco of apriltags": (
        ("charuco", 5, 8, "APRILTAG_36h11"),
        CharucoDetector(5, 8, 0.8, "tag36h11"),
        False,
        ALL | {"oblique": 0.85, "small": 0.4},
    ),
    "checkerboard": (("checkerboard", 6, 9), CheckerboardDetector(6, 9), False, ALL | {"cut": 0.0}),
    "checkerboard 7 x 6": (("checkerboard", 7, 6), CheckerboardDetector(7, 6), False, ALL | {"cut": 0.0}),
    "aruco": (("markers", "4X4_50", (3, 7), 1), MarkerDetector("4x4_50", (3, 7)), True, ALL | {"cut": 0.5}),
    "apriltag": (
        ("markers", "APRILTAG_36H11", (3, 7), 1),
        MarkerDetector("tag36h11", (3, 7)),
        True,
        ALL | {"cut": 0.5},
    ),
}
IMAGES = 2  # fewer have too few corners for the bound on their mean
CROWDED_SIGMA_PX = 0.035  # of corners so near to the bits of their tag that these may move them


IN_CI = ("kalibr", "charuco", "checkerboard", "apriltag")  # one of each kind


@each("pose", POSES)
@each("target", IN_CI)
def test_corners_are_right(rendering, target, pose):
    corners_are_right(rendering, target, pose, 0.7)


@pytest.mark.full
@each("pose", POSES)
@each("target", TARGETS)
@pytest.mark.parametrize("blur", [0.7, 1.2])
def test_corners_of_all_targets_are_right(rendering, target, pose, blur):
    corners_are_right(rendering, target, pose, blur)


def corners_are_right(rendering, target, pose, blur):
    (kind, *arguments), detector, y_up, least = TARGETS[target]
    pattern = getattr(rendering, kind)(*arguments)
    distance, tilt, turn, roll, offset = POSES[pose]
    uv, inward, visible = [], [], 0
    for seed in range(IMAGES):
        H = rendering.homography(pattern, distance, tilt, turn, roll + 7.0 * seed, offset, y_up)
        found = detector.detect(rendering.render(pattern, H, blur, noise=2.0, seed=seed))
        assert len(np.unique(found.point)) == len(found.point)
        clear = found.kept & (found.sigma < CROWDED_SIGMA_PX)
        errors = rendering.errors(pattern, H, found.point[clear], found.uv[clear])
        uv, inward = [*uv, errors.uv], [*inward, errors.inward]
        truth = rendering.applied(H, pattern.points)
        visible += int(((truth > 2.0) & (truth < np.array(rendering.size) - 3.0)).all(axis=1).sum())
    uv, inward = np.concatenate(uv), np.concatenate(inward)
    if blur == 0.7:
        assert len(uv) >= least[pose] * visible
    if len(uv) > 0:
        assert np.hypot(*uv.T).max() < 0.25
        assert np.sqrt((uv**2).mean()) < 0.05
    # Fewer corners than that say nothing about the bias: their noise alone is as large.
    if len(uv) >= 30:
        assert abs(inward.mean()) < 0.02
        assert np.abs(uv.mean(axis=0)).max() < 0.02


SIDES = [("APRILTAG_36H11", 18), ("4X4_50", 14), ("APRILTAG_36H11", 20), ("4X4_50", 17)]


@each(("family", "side"), SIDES[:2])
@each("blur", [0.6, 0.8])
def test_small_tags_are_kept_with_a_sigma_that_is_right(rendering, family, side, blur):
    small_tags_are_kept(rendering, family, side, blur)


@pytest.mark.full
@each(("family", "side"), SIDES[2:])
@each("blur", [0.6, 0.8])
def test_tags_that_are_less_small_are_kept_with_a_sigma_that_is_right(rendering, family, side, blur):
    small_tags_are_kept(rendering, family, side, blur)


def small_tags_are_kept(rendering, family, side, blur):
    """Sides [px] for which the bits are too near to the edges: their errors are larger, and so is their sigma."""
    ids = (1, 5, 9)
    pattern = rendering.markers(family, list(ids), 1)
    detector = MarkerDetector("tag36h11" if "36" in family else "4x4_50", ids)
    ratio, seen = [], 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        turns = rng.uniform(0.0, 30.0), rng.uniform(0.0, 360.0), rng.uniform(0.0, 360.0)
        H = rendering.homography(pattern, 0.15 * 460.0 / side, *turns, rng.uniform(-30.0, 30.0, 2))
        found = detector.detect(rendering.render(pattern, H, blur, seed=seed))
        errors = rendering.errors(pattern, H, found.point[found.kept], found.uv[found.kept])
        ratio, seen = [*ratio, errors.uv / found.sigma[found.kept, None]], seen + 12
    ratio = np.concatenate(ratio)
    assert len(ratio) >= (0.9 if blur == 0.6 else 0.5) * seen
    assert np.sqrt((ratio**2).mean()) < 1.25 and np.abs(ratio).max() < 4.0


@pytest.mark.parametrize("target", ["kalibr", pytest.param("two-bit plain", marks=pytest.mark.full)])
def test_sigma_is_the_scatter_under_noise(rendering, target):
    (kind, *arguments), detector, y_up, _ = TARGETS[target]
    pattern = getattr(rendering, kind)(*arguments)
    H = rendering.homography(pattern, *POSES["tilted"], y_up)
    found = [detector.detect(rendering.render(pattern, H, 1.0, noise=6.0, seed=seed)) for seed in range(12)]
    common = set.intersection(*(set(one.point[one.kept].tolist()) for one in found))
    assert len(common) > 100
    rows = [[one.point.tolist().index(p) for p in sorted(common)] for one in found]
    # Without a lens edges are straight: the standard deviation is that of corners whose edges' curvature is known.
    straight = [one.uv - (one.edges[:, :, 6:] * one.edges[:, :, 4:6]).sum(axis=1) for one in found]
    uv = np.array([one[row] for one, row in zip(straight, rows, strict=True)])
    sigma = np.array([one.sigma[row] for one, row in zip(found, rows, strict=True)])
    # The detector takes a noise of 2 grey levels, of which the image has three times as many.
    expected = 9.0 * (sigma**2 - 0.02**2).mean()
    assert uv.var(axis=0, ddof=1).mean() == pytest.approx(expected, rel=0.25)


def test_more_blur_means_larger_sigma_and_blur(rendering):
    pattern = rendering.aprilgrid(6, 6)
    H = rendering.homography(pattern, *POSES["frontal"])
    found = [AprilGridDetector(6, 6, 0.3).detect(rendering.render(pattern, H, blur)) for blur in (0.7, 1.2, 2.0)]
    assert np.diff([np.median(one.sigma) for one in found]).min() > 0.0
    # A pixel adds the blur of its own width, 1 / sqrt(12).
    expected = np.sqrt(np.array([0.7, 1.2, 2.0]) ** 2 + 1.0 / 12.0)
    np.testing.assert_allclose([np.median(one.blur) for one in found], expected, rtol=0.05)


@pytest.mark.parametrize("gamma", [0.45, 2.2])
def test_x_corners_stay_whatever_the_response_to_light(rendering, gamma):
    pattern = rendering.aprilgrid(6, 6)
    H = rendering.homography(pattern, *POSES["tilted"])
    image = 255.0 * (rendering.render(pattern, H, 0.9, noise=0.0) / 255.0) ** gamma
    found = AprilGridDetector(6, 6, 0.3).detect(np.round(image).astype(np.uint8))
    errors = rendering.errors(pattern, H, found.point[found.kept], found.uv[found.kept])
    assert len(errors.uv) > 135
    assert abs(errors.inward.mean()) < 0.03
    assert errors.rms < 0.04
