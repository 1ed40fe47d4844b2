"""Boards that fill half of what lenses of 180 degrees and more see: no good corner is inconsistent with the others."""

from __future__ import annotations

import numpy as np
from tests.cases import each

from icalib.detection.detectors import detector_of
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Target
from icalib.tools.simulation import Imaging, Renderer, Sheet
from icalib.tools.simulation.scenario import SimCamera

SIZE, CENTRE = (752, 480), (375.5, 239.5)
CAMERAS = {
    "equidistant": SimCamera("cam0", "pinhole-equidistant", SIZE, (145.0, 145.0, *CENTRE), (0.0,) * 4, np.eye(4)),
    "omni": SimCamera("cam0", "omni-radtan", SIZE, (330.0, 330.0, *CENTRE), (1.3, 0.0, 0.0, 0.0, 0.0), np.eye(4)),
}
TARGETS: dict[str, tuple[Target, float, float]] = {  # distance of the camera [m], least share of corners kept
    "aprilgrid": (AprilGrid(6, 6, 0.088, 0.3), 0.3, 0.8),
    "checkerboard": (Checkerboard(7, 10, 0.06), 0.2, 1.0),
    "charuco": (Charuco(10, 7, 0.07, 0.05, "5x5_100"), 0.22, 0.9),
}


@each("camera", CAMERAS)
@each("name", TARGETS)
def test_corners_of_a_board_seen_from_near_are_kept(camera, name):
    target, distance, least = TARGETS[name]
    a, low, high = np.radians(15.0), target.points.min(axis=0), target.points.max(axis=0)
    z, x = np.array([0.0, np.sin(a), -np.cos(a)]), np.array([1.0, 0.0, 0.0])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.column_stack([x, np.cross(z, x), z]), 0.5 * (low + high) - distance * z
    picture = Renderer(CAMERAS[camera], Imaging(blur_px=0.7, noise=2.0)).picture(
        [Sheet(target)], T, np.random.default_rng(0)
    )
    found, truth = detector_of(target).detect(picture.pixels), picture.sheets[0]
    assert found.counts()["inconsistent"] == 0
    assert found.kept.sum() >= least * truth.seen.sum()
    assert np.linalg.norm(found.uv - truth.uv[found.point], axis=1)[found.kept].max() < 0.3
