"""Poses of cameras in a scene of several bodies, whose poses are known: image by image, no guess needed.

Each body's pose is found in each image alone. Small flat bodies far away look the same from two sides; all bodies of an
image tell which is meant.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import CornerStream
from icalib.geometry.cameras.base import CameraModel
from icalib.initialize.steps.target_poses import (
    MAX_POSE_CORNERS,
    MAX_POSE_RMS_PX,
    MIN_POSE_CORNERS,
    POSE_ITERATIONS,
    FlatPoints,
    TargetPoses,
    camera_in_target,
    check_front_side,
    flat_poses,
    refine_pose,
    select_corners,
    target_poses,
    usable_rays,
)
from icalib.model.bodies import Bodies
from icalib.optim.state import Key
from icalib.sensors.camera.corner_factor import Views

MIRRORS = 2


@dataclass(frozen=True)
class TargetScene:
    """Where the bodies stand: R_scene_body, p_scene_body by body and name, as in a state. params: those (P,) of the
    cameras that saw it, by name, where there are several bodies."""

    bodies: Bodies
    values: dict[Key, np.ndarray] = field(default_factory=dict)
    params: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def points(self) -> np.ndarray:
        """(n_points, 3) the target's points in the scene."""
        zeros = {(name, "shape"): np.zeros(self.bodies.basis.shape[1]) for name in self.bodies.bending}
        return self.bodies.points(self.values | zeros)

    @property
    def known(self) -> np.ndarray:
        """(n_points,) bool: points of bodies that have a pose."""
        names = self.bodies.target.bodies
        have = [k == self.bodies.used[0] or (names[k], "rotation") in self.values for k in range(len(names))]
        return np.array(have)[self.bodies.target.body]


def view_poses(stream: CornerStream, views: Views, bodies: Bodies, model: CameraModel, params: np.ndarray):
    """Both poses (V, 2, ...) of the camera in the frame of each view's body."""
    size = np.bincount(bodies.target.body)
    fewest = np.minimum(size, MIN_POSE_CORNERS)[views.body]
    return flat_poses(stream, views.start, fewest, model, params, bodies.target.points, MIRRORS)


def scene_poses(stream: CornerStream, model: CameraModel, params: np.ndarray, scene: TargetScene) -> TargetPoses:
    """Poses of the camera in the scene, image by image, from all its bodies together. Raises EstimationError where
    images are mirrored."""
    if not scene.bodies.several:
        poses = target_poses(stream, model, params, FlatPoints(scene.bodies.target.points))
        check_front_side(stream.name, poses)
        return poses
    return multi_body_poses(stream, model, params, scene)


def multi_body_poses(stream: CornerStream, model: CameraModel, params: np.ndarray, scene: TargetScene) -> TargetPoses:
    """Poses of the camera in the scene from the bodies of the target that have a pose in it."""
    views = Views.of(stream, scene.bodies.target.body)
    seen = view_poses(stream, views, scene.bodies, model, params)
    R_sb, p_sb = scene.bodies.poses(scene.values)
    rays, density, good = usable_rays(stream.uv, model, params)
    n = len(stream.stamps_ns)
    rotation, position, rms = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.full(n, 1e9)
    first = np.searchsorted(views.image, np.arange(n + 1))
    _best_poses(
        stream.start,
        stream.point,
        rays,
        density,
        good & scene.known[stream.point],
        scene.points,
        first,
        views.body,
        seen.rotation,
        seen.position,
        seen.ok,
        R_sb,
        p_sb,
        rotation,
        position,
        rms,
    )
    return TargetPoses(rotation, position, rms < MAX_POSE_RMS_PX, rms)


@njit(cache=True, nogil=True, error_model="numpy")
def _best_poses(
    start, point, rays, density, good, scene_points, first, body, R_bc, p_bc, ok, R_sb, p_sb, rotation, position, rms
):
    """Of each image: the pose that one of its views suggests and all its corners like best, refined on all of them."""
    points, seen = np.empty((MAX_POSE_CORNERS, 3)), np.empty((MAX_POSE_CORNERS, 3))
    R, t, trial_R, trial_t = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    R_sc, p_sc = np.empty((3, 3)), np.empty(3)
    for i in range(len(start) - 1):
        count = select_corners(start[i], start[i + 1], point, rays, density, good, scene_points, points, seen)
        best = 1e9
        for v in range(first[i], first[i + 1]):
            for side in range(R_bc.shape[1]):
                if count < 4 or not ok[v, side]:
                    continue
                k = body[v]
                for a in range(3):
                    p_sc[a] = p_sb[k, a]
                    for b in range(3):
                        p_sc[a] += R_sb[k, a, b] * p_bc[v, side, b]
                        R_sc[a, b] = 0.0
                        for c in range(3):
                            R_sc[a, b] += R_sb[k, a, c] * R_bc[v, side, c, b]
                camera_in_target(R_sc, p_sc, trial_R, trial_t)
                error = refine_pose(points[:count], seen[:count], trial_R.copy(), trial_t.copy(), 1)
                if error < best:
                    best = error
                    R[:], t[:] = trial_R, trial_t
        if best < 1e9:
            rms[i] = refine_pose(points[:count], seen[:count], R, t, POSE_ITERATIONS)
            if rms[i] < 1e9:
                camera_in_target(R, t, rotation[i], position[i])
            else:
                rms[i] = 1e9
