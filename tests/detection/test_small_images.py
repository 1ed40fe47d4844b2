"""Images that are too small for any board show none."""

from __future__ import annotations

import numpy as np
from tests.cases import each

from icalib.detection.checkerboard import shows_grid
from icalib.detection.detectors import detector_of, other_size
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Circles, Markers, Target

SIDES = (1, 2, 7, 10, 11, 12, 14, 15, 16, 23, 24)
TARGETS = {
    "checkerboard": Checkerboard(6, 7, 0.03),
    "smallest checkerboard": Checkerboard(3, 4, 0.03, inverted=True),
    "circles": Circles(4, 7, 0.03, 0.01),
    "asymmetric circles": Circles(4, 11, 0.03, 0.01, True),
    "AprilGrid": AprilGrid(6, 6, 0.088, 0.3),
    "ChArUco": Charuco(5, 6, 0.06, 0.04, "4x4_50"),
    "markers": Markers("tag36h11", 0.1),
}


def images(side: int) -> list[np.ndarray]:
    """Uniform and random ones: square, long, and so long that they are searched at a fraction of their size."""
    rng = np.random.default_rng(side)
    shapes = [(side, side), (side, 90), (90, side), (side, 2500), (2500, side)]
    return [rng.integers(0, high, shape, dtype=np.uint8) for shape in shapes for high in (1, 256)]


@each("target", TARGETS.values())
@each("side", SIDES)
def test_no_target_is_found(side: int, target: Target):
    for image in images(side):
        assert not len(detector_of(target).detect(image).point)


@each("side", SIDES)
def test_neither_a_grid_nor_a_board_of_another_size_is_found(side: int):
    assert not any(shows_grid(image, 5) for image in images(side))
    assert other_size(images(side)[:2], Checkerboard(6, 7, 0.03)) == ""
