"""Camera poses in a scene of bodies with known poses, image by image, without an initial guess.

The pose of each body in each image is found first. A small flat body far away has two possible poses with nearly the
same projection. The other bodies in the image resolve this ambiguity.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import CornerStream
from icalib.geometry.cameras.base import CameraModel
from icalib.model.bodies import Bodies
from icalib.optim.state import Key
from icalib.sensors.camera.corner_factor import Views
from icalib.sensors.camera.initialize.boards.target_poses import (
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

POSES_PER_VIEW = 2  # two-fold ambiguity of a flat body: depths relative to its centre may be mirrored
NO_POSE_RMS_PX = 1e9  # px, error that marks an image without a pose


@dataclass(frozen=True)
class TargetScene:
    """Poses of the bodies of a target.

    values: R_scene_body, p_scene_body as in a state, keyed by body and parameter; the scene frame is that of the first
    body in use. params: intrinsics and distortion (P,) by camera name, with which the poses were found; empty for one
    body.
    """

    bodies: Bodies
    values: dict[Key, np.ndarray] = field(default_factory=dict)
    params: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def points(self) -> np.ndarray:
        """(n_points, 3) [m] the target's points in the scene."""
        zeros = {(name, "shape"): np.zeros(self.bodies.basis.shape[1]) for name in self.bodies.bending}
        return self.bodies.points(self.values | zeros)

    @property
    def known(self) -> np.ndarray:
        """(n_points,) bool: points of bodies that have a pose."""
        names = self.bodies.target.bodies
        has_pose = [k == self.bodies.used[0] or (names[k], "rotation") in self.values for k in range(len(names))]
        return np.array(has_pose)[self.bodies.target.body]


def view_poses(
    stream: CornerStream, views: Views, bodies: Bodies, model: CameraModel, params: np.ndarray
) -> TargetPoses:
    """Both possible poses T_body_cam (V, 2, ...) for each of V views; a view is one body in one image."""
    size = np.bincount(bodies.target.body)
    fewest = np.minimum(size, MIN_POSE_CORNERS)[views.body]
    return flat_poses(stream, views.start, fewest, model, params, bodies.target.points, POSES_PER_VIEW)


def scene_poses(stream: CornerStream, model: CameraModel, params: np.ndarray, scene: TargetScene) -> TargetPoses:
    """Camera poses in the scene, one for each image; params: (P,) intrinsics and distortion.

    Raises EstimationError if the images are mirrored (checked for targets of one body).
    """
    if not scene.bodies.several:
        poses = target_poses(stream, model, params, FlatPoints(scene.bodies.target.points))
        check_front_side(stream.name, poses)
        return poses
    return multi_body_poses(stream, model, params, scene)


def multi_body_poses(stream: CornerStream, model: CameraModel, params: np.ndarray, scene: TargetScene) -> TargetPoses:
    """Camera poses in the scene, one for each image, from all bodies that have a pose in the scene.

    params: (P,) intrinsics and distortion."""
    views = Views.of(stream, scene.bodies.target.body)
    by_view = view_poses(stream, views, scene.bodies, model, params)
    R_sb, p_sb = scene.bodies.poses(scene.values)
    rays, density, good = usable_rays(stream.uv, model, params)
    n = len(stream.stamps_ns)
    rotation, position, rms = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.full(n, NO_POSE_RMS_PX)
    first_view = np.searchsorted(views.image, np.arange(n + 1))
    _best_poses(
        stream.start,
        stream.point,
        rays,
        density,
        good & scene.known[stream.point],
        scene.points,
        first_view,
        views.body,
        by_view.rotation,
        by_view.position,
        by_view.ok,
        R_sb,
        p_sb,
        rotation,
        position,
        rms,
    )
    return TargetPoses(rotation, position, rms < MAX_POSE_RMS_PX, rms)


@njit(cache=True, nogil=True)
def _compose(R_ab, p_ab, R_bc, p_bc, R_ac, p_ac):
    """Writes the pose T_a_c = T_a_b T_b_c into R_ac (3, 3) and p_ac (3,) m."""
    for a in range(3):
        p_ac[a] = p_ab[a]
        for b in range(3):
            p_ac[a] += R_ab[a, b] * p_bc[b]
            R_ac[a, b] = 0.0
            for c in range(3):
                R_ac[a, b] += R_ab[a, c] * R_bc[c, b]


@njit(cache=True, nogil=True, error_model="numpy")
def _best_poses(
    start, point, rays, density, good, scene_points, first, body, R_bc, p_bc, ok, R_sb, p_sb, rotation, position, rms
):
    """Writes camera poses in the scene and errors of M images: rotation (M, 3, 3), position (M, 3) m, rms (M,) px.

    Candidates are the poses T_body_cam of the views, R_bc, p_bc, ok (V, 2, ...), composed with T_scene_body, R_sb,
    p_sb. The candidate with the least error over all corners of the image is refined on all of them."""
    points, observed = np.empty((MAX_POSE_CORNERS, 3)), np.empty((MAX_POSE_CORNERS, 3))
    R, t, trial_R, trial_t = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    R_sc, p_sc = np.empty((3, 3)), np.empty(3)
    for i in range(len(start) - 1):
        count = select_corners(start[i], start[i + 1], point, rays, density, good, scene_points, points, observed)
        best = NO_POSE_RMS_PX
        for v in range(first[i], first[i + 1]):
            for side in range(R_bc.shape[1]):
                if count < 4 or not ok[v, side]:
                    continue
                _compose(R_sb[body[v]], p_sb[body[v]], R_bc[v, side], p_bc[v, side], R_sc, p_sc)
                camera_in_target(R_sc, p_sc, trial_R, trial_t)
                error = refine_pose(points[:count], observed[:count], trial_R.copy(), trial_t.copy(), 1)
                if error < best:
                    best = error
                    R[:], t[:] = trial_R, trial_t
        if best < NO_POSE_RMS_PX:
            rms[i] = refine_pose(points[:count], observed[:count], R, t, POSE_ITERATIONS)
            if rms[i] < NO_POSE_RMS_PX:
                camera_in_target(R, t, rotation[i], position[i])
            else:
                rms[i] = NO_POSE_RMS_PX
