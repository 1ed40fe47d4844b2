"""Bias and scatter of corners on straight edges and on edges that are bent as the lens bends them: `corner_bias.py`.

Images are rendered with known lens and poses. For each lens and target: the mean radial error of the corners beyond
100 px from the principal point, with its standard error, and the RMS per axis of all corners. Needs icalib[images].
"""

from __future__ import annotations

import argparse
import dataclasses

import numpy as np
from rendered import scenario_of
from throughput import TARGETS

from icalib.detection.detectors import detector_of
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import AprilGrid, Target
from icalib.sensors.camera.corner_bias import predicted_curvature
from icalib.tools.simulation import Film, film
from icalib.tools.simulation.rendering import exposure_poses

SMALL_TAGS = AprilGrid(6, 6, 0.05, 0.5, border_bits=2, squares=False)
FAR_PX = 100.0
RATE_HZ = 4.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=24, metavar="N", help="of each lens and target (24)")
    count = parser.parse_args().images
    targets = {"AprilGrid": TARGETS[0], "ChArUco": TARGETS[1], "checkerboard": TARGETS[2], "small tags": SMALL_TAGS}
    print(f"{'lens, target':<26}{'radial, straight':>20}{'radial, bent':>20}{'RMS, straight':>15}{'bent':>9}  px")
    for lens in ("pinhole", "fisheye"):
        for name, target in targets.items():
            errors = [np.concatenate(part) for part in zip(*_errors(_filmed(lens, target, count)), strict=True)]
            far, straight, bent = errors
            radial = [f"{np.mean(e[far, 1]):+.4f} +- {np.std(e[far, 1]) / np.sqrt(far.sum()):.4f}" for e in errors[1:]]
            rms = [np.sqrt(np.mean(e[:, 0])) for e in (straight, bent)]
            print(f"{f'{lens}, {name}':<26}{radial[0]:>20}{radial[1]:>20}{rms[0]:>15.4f}{rms[1]:>9.4f}", flush=True)


def _filmed(lens: str, target: Target, count: int) -> Film:
    scenario = scenario_of(lens, count / RATE_HZ + 0.2)
    motion = dataclasses.replace(scenario.motion, rotation_scale=0.5, translation_scale=0.5)
    cameras = (dataclasses.replace(scenario.cameras[0], rate_hz=RATE_HZ),)
    return film(dataclasses.replace(scenario, cameras=cameras, target=target, motion=motion), 0)


def _errors(run: Film):
    """Of each image: far (n,) bool; straight and bent (n, 2): half the squared error and the radial error."""
    (camera,), target = run.scenario.cameras, run.scenario.target
    model, params = camera_model(camera.model), np.array([*camera.intrinsics, *camera.distortion])
    T_target_world, detector = np.linalg.inv(run.scenario.body_poses[0]), detector_of(target)
    for shot in run.shots(workers=1):
        corners = detector.detect(shot.pixels)
        kept = corners.kept
        uv, point, edges = corners.uv[kept], corners.point[kept], corners.edges[kept].astype(np.float64)
        T = T_target_world @ exposure_poses(camera, run.truth.trajectory, shot.seconds, 0.0, 1)[0]
        X, plane = (target.points[point] - T[:3, 3]) @ T[:3, :3], np.tile(T[:3, :3].T[:, :2], (len(point), 1, 1))
        bent = uv.copy()
        for edge in edges.transpose(1, 0, 2):
            curvature, known = predicted_curvature(model, params, X, plane, edge[:, :4].reshape(-1, 2, 2))
            bent += np.where(known, curvature - edge[:, 6], 0.0)[:, None] * edge[:, 4:6]
        true = shot.target.uv[point]
        away = true - camera.intrinsics[2:]
        radius = np.linalg.norm(away, axis=1)
        yield radius > FAR_PX, _both(uv - true, away / radius[:, None]), _both(bent - true, away / radius[:, None])


def _both(error: np.ndarray, outwards: np.ndarray) -> np.ndarray:
    return np.stack([0.5 * (error**2).sum(axis=1), (error * outwards).sum(axis=1)], axis=1)


if __name__ == "__main__":
    main()
