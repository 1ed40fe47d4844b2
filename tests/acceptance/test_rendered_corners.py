"""Corners found in rendered images against where they truly are: each under its own number, none far off, none pulled.

The images come from the simulator's renderer, which knows nothing of detectors, through a lens with distortion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

from icalib.detection.detectors import detector_of
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard, Target
from icalib.tools.simulation import Imaging, Picture, Renderer, Sheet, handheld
from icalib.tools.simulation.scenario import SimCamera

cv2 = pytest.importorskip("cv2")

CAMERA = handheld().cameras[0]
FISHEYE = replace(
    CAMERA,
    model="pinhole-equidistant",
    intrinsics=(230.0, 229.5, 372.2, 241.4),
    distortion=(0.0035, 0.0007, -0.0021, 0.0002),
)
TARGETS = [
    AprilGrid(6, 6, 0.088, 0.3),
    AprilGrid(3, 4, 0.15, 0.25),
    Charuco(8, 6, 0.08, 0.06, "5x5_100"),
    Charuco(7, 5, 0.09, 0.066, "4x4_50"),
    Checkerboard(6, 9, 0.06),
    Checkerboard(7, 4, 0.07),
]
# Distance [m]; turns about the camera's x, y and z [deg]; where the board's middle lies [px] from the image's.
POSES = [
    (0.85, 0.0, 0.0, 0.0, (0.0, 0.0)),
    (0.95, 25.0, -15.0, 20.0, (30.0, 10.0)),
    (0.90, -20.0, 30.0, 95.0, (-40.0, -10.0)),
    (1.00, 10.0, 35.0, 180.0, (20.0, -20.0)),
    (0.95, -35.0, -10.0, 250.0, (0.0, 15.0)),
    (1.10, 30.0, 20.0, 310.0, (-90.0, 40.0)),
]
BLURS = (0.7, 0.95, 1.2)


def turn(axis: int, degrees: float) -> np.ndarray:
    a, i, j = math.radians(degrees), (axis + 1) % 3, (axis + 2) % 3
    R = np.eye(3)
    R[[i, i, j, j], [i, j, i, j]] = math.cos(a), -math.sin(a), math.sin(a), math.cos(a)
    return R


def view(camera: SimCamera, target: Target, pose: tuple, scale: float = 1.0) -> np.ndarray:
    """T_target_cam (4, 4)."""
    distance, x, y, z, (du, dv) = pose
    fx, fy = camera.intrinsics[:2]
    low, high = target.points.min(axis=0), target.points.max(axis=0)
    R_cam_target = turn(0, x) @ turn(1, y) @ turn(2, z) @ np.diag([1.0, -1.0, -1.0])
    middle = scale * distance * np.array([du / fx, dv / fy, 1.0])
    T = np.eye(4)
    T[:3, :3] = R_cam_target.T
    T[:3, 3] = 0.5 * (low + high) - T[:3, :3] @ middle
    return T


def picture(camera: SimCamera, target: Target, T_target_cam: np.ndarray, blur: float, seed: int = 0) -> Picture:
    renderer = Renderer(camera, Imaging(blur_px=blur, noise=2.0))
    return renderer.picture([Sheet(target, margin=0.06)], T_target_cam, np.random.default_rng(seed))


@dataclass(frozen=True)
class Errors:
    """uv (n, 2) [px] of all corners found, inward (n,): their share towards the centre of the tag, zero without tags;
    the share of the corners in the pictures that was found."""

    uv: np.ndarray
    inward: np.ndarray
    share: float


def errors(target: Target, camera: SimCamera, poses: list, scale: float) -> Errors:
    detector = detector_of(target)
    found, inward, there = [], [], 0
    for seed, pose in enumerate(poses):
        shot = picture(camera, target, view(camera, target, pose, scale), BLURS[seed % len(BLURS)], seed)
        corners, truth = detector.detect(shot.pixels), shot.sheets[0]
        kept = corners.kept
        assert kept.any(), f"nothing found at {pose}"
        assert truth.seen[corners.point[kept]].all()
        error = (corners.uv - truth.uv[corners.point])[kept]
        found.append(error)
        inward.append((error * towards_centers(target, truth.uv)[corners.point[kept]]).sum(axis=1))
        there += int(truth.seen.sum())
    error = np.concatenate(found)
    return Errors(error, np.concatenate(inward), len(error) / there)


def towards_centers(target: Target, uv: np.ndarray) -> np.ndarray:
    """(n, 2) unit directions from each point to the middle of its tag's corners; zero on targets without tags."""
    if not target.blooms:
        return np.zeros_like(uv)
    direction = uv.reshape(-1, 4, 2).mean(axis=1).repeat(4, axis=0) - uv
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def name(target: Target) -> str:
    return f"{target.type}-{len(target.points)}"


VIEWS = {"pinhole": (CAMERA, POSES, 1.0), "fisheye": (FISHEYE, POSES[:5], 0.55)}
IN_CI = {("pinhole", 2), ("fisheye", 4)}  # one target through each lens


def sights() -> list:
    """All targets through all lenses; those that are not `IN_CI` are marked as full."""
    return [
        pytest.param(target, lens, id=f"{name(target)}-{lens}", marks=() if (lens, k) in IN_CI else pytest.mark.full)
        for lens in VIEWS
        for k, target in enumerate(TARGETS)
    ]


@pytest.mark.parametrize(("target", "lens"), sights())
def test_corners_are_found_where_they_are_each_under_its_number(target: Target, lens: str):
    """A wrong number or a mirrored board would be off by a square, some 40 px."""
    error = errors(target, *VIEWS[lens])
    assert np.sqrt(np.mean(error.uv**2)) < 0.03
    assert np.abs(error.uv.mean(axis=0)).max() < 0.005
    assert abs(error.inward.mean()) < 0.02
    assert np.linalg.norm(error.uv, axis=1).max() < 0.25
    assert error.share > 0.85
