"""Corners in rendered images of a lens that bends edges much: where straight edges are biased, bent ones are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.detection.detectors import detector_of
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import AprilGrid, Charuco, Checkerboard
from icalib.sensors.camera.corner_bias import predicted_curvature
from icalib.tools.simulation import HandheldMotion, film, handheld
from icalib.tools.simulation.rendering import Imaging, exposure_poses

pytest.importorskip("cv2")

# target, distance [m], the bias of straight edges at least [px]
TARGETS = {
    "grid with squares": (AprilGrid(6, 6, 0.088, 0.3), 0.5, 0.005),
    "small plain tags": (AprilGrid(6, 6, 0.05, 0.5, border_bits=2, squares=False), 0.6, 0.015),
    "charuco": (Charuco(8, 6, 0.08, 0.06, "5x5_100"), 0.5, 0.003),
    "checkerboard": (Checkerboard(6, 9, 0.06), 0.6, 0.005),
}


def filmed(target, distance_m):
    base = handheld(2.0)
    fisheye = replace(
        base.cameras[0],
        rate_hz=2.5,
        model="pinhole-equidistant",
        intrinsics=(230.0, 229.5, 372.2, 241.4),
        distortion=(0.0035, 0.0007, -0.0021, 0.0002),
    )
    motion = HandheldMotion(rotation_scale=0.4, translation_scale=0.4, distance_m=distance_m, seed=3)
    return film(replace(base, cameras=(fisheye,), target=target, motion=motion), 0, Imaging(blur_px=0.6, noise=0.5))


def with_known_curvature(camera, target, T_target_cam, point, uv, edges):
    """uv (n, 2) on edges that are bent as the true lens bends them."""
    R, model = T_target_cam[:3, :3], camera_model(camera.model)
    X = (target.points[point] - T_target_cam[:3, 3]) @ R
    plane, params = np.tile(R.T[:, :2], (len(X), 1, 1)), np.array([*camera.intrinsics, *camera.distortion])
    for edge in edges.astype(np.float64).transpose(1, 0, 2):
        curvature, known = predicted_curvature(model, params, X, plane, edge[:, :4].reshape(-1, 2, 2))
        assert known.all()
        uv = uv + (curvature - edge[:, 6])[:, None] * edge[:, 4:6]
    return uv


IN_CI = ("grid with squares", "checkerboard")


@pytest.mark.parametrize("name", [pytest.param(n, marks=() if n in IN_CI else pytest.mark.full) for n in TARGETS])
def test_known_curvature_takes_the_bias_away(name):
    target, distance_m, least = TARGETS[name]
    run = filmed(target, distance_m)
    (camera,), detector = run.scenario.cameras, detector_of(target)
    T_target_world = np.linalg.inv(run.scenario.body_poses[0])
    outwards = {"straight": [], "bent": []}
    for shot in run.shots():
        found = detector.detect(shot.pixels)
        uv, point, edges = (x[found.kept] for x in (found.uv, found.point, found.edges))
        T = T_target_world @ exposure_poses(camera, run.truth.trajectory, shot.seconds, 0.0, 1)[0]
        true = shot.target.uv[point]
        away = true - camera.intrinsics[2:]
        far = np.linalg.norm(away, axis=1) > 80.0
        bent = with_known_curvature(camera, target, T, point, uv, edges)
        for key, at in {"straight": uv, "bent": bent}.items():
            outwards[key].append((((at - true) * away).sum(axis=1) / np.linalg.norm(away, axis=1))[far])
    bias = {key: float(np.concatenate(x).mean()) for key, x in outwards.items()}
    assert abs(bias["straight"]) > least
    assert abs(bias["bent"]) < 0.06 * abs(bias["straight"])
