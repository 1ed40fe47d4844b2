"""How the bodies of a target stand to each other, from the images that show several of them; no guess needed.

Each body's pose is found in each image alone. Small flat things far away look the same from two sides; which is meant
is what most images agree on. Then all are adjusted together, every image free to stand where it likes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numba import njit

from icalib.errors import EstimationError
from icalib.estimation.bodies import Bodies
from icalib.estimation.corner_factor import Views
from icalib.estimation.state import Key
from icalib.first_guess.target_poses import (
    FEWEST_CORNERS,
    LARGEST_RMS_PX,
    MOST_CORNERS,
    ROUNDS,
    Flat,
    TargetPoses,
    camera_in_target,
    check_side,
    chosen_corners,
    flat_poses,
    refine,
    target_poses,
    usable_rays,
)
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.measurements import CornerStream

VOTES = 40  # images that say how two bodies stand to each other
ALIKE = 3.0  # a mirrored pose is worth a vote while its error is below so many times the other's
VOTE_SCALE = 0.2  # rad, or m per m of distance: votes this far apart do not agree
MIRRORS = 2
LEAST_RMS_PX = 0.05  # errors below this tell nothing apart


@dataclass(frozen=True)
class Placed:
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


def body_poses(stream: CornerStream, views: Views, bodies: Bodies, model: CameraModel, params: np.ndarray):
    """Both poses (V, 2, ...) of the camera in the frame of each view's body."""
    size = np.bincount(bodies.target.body)
    fewest = np.minimum(size, FEWEST_CORNERS)[views.body]
    return flat_poses(stream, views.start, fewest, model, params, bodies.target.points, MIRRORS)


def scene_poses(stream: CornerStream, model: CameraModel, params: np.ndarray, scene: Placed) -> TargetPoses:
    """Poses of the camera in the scene, image by image, from all its bodies together. Raises EstimationError where
    images are mirrored."""
    if not scene.bodies.several:
        poses = target_poses(stream, model, params, Flat(scene.bodies.target.points))
        check_side(stream.name, poses)
        return poses
    views = Views.of(stream, scene.bodies.target.body)
    seen = body_poses(stream, views, scene.bodies, model, params)
    R_sb, p_sb = scene.bodies.poses(scene.values)
    rays, good = usable_rays(stream.uv, model, params)
    n, focal = len(stream.stamps_ns), float(params[0])
    rotation, position, rms = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.full(n, 1e9)
    first = np.searchsorted(views.image, np.arange(n + 1))
    _best_poses(
        stream.start, stream.point, rays, good & scene.known[stream.point], scene.points, first, views.body,
        seen.rotation, seen.position, seen.ok, R_sb, p_sb, focal, rotation, position, rms,
    )  # fmt: skip
    return TargetPoses(rotation, position, rms < LARGEST_RMS_PX, rms)


@njit(cache=True, nogil=True, error_model="numpy")
def _best_poses(
    start, point, rays, good, scene_points, first, body, R_bc, p_bc, ok, R_sb, p_sb, focal, rotation, position, rms
):  # fmt: skip
    """Of each image: the pose that one of its views suggests and all its corners like best, refined on all of them."""
    points, seen = np.empty((MOST_CORNERS, 3)), np.empty((MOST_CORNERS, 2))
    R, t, trial_R, trial_t = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    R_sc, p_sc = np.empty((3, 3)), np.empty(3)
    for i in range(len(start) - 1):
        count = chosen_corners(start[i], start[i + 1], point, rays, good, scene_points, points, seen)
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
                error = refine(points[:count], seen[:count], trial_R.copy(), trial_t.copy(), 1, 2.0 / focal)
                if error < best:
                    best = error
                    R[:], t[:] = trial_R, trial_t
        if best < 1e9:
            rms[i] = focal * refine(points[:count], seen[:count], R, t, ROUNDS, 2.0 / focal)
            if rms[i] < 1e9:
                camera_in_target(R, t, rotation[i], position[i])
            else:
                rms[i] = 1e9


def place_bodies(
    bodies: Bodies, streams: Sequence[CornerStream], models: Sequence[CameraModel], params: dict[str, np.ndarray]
) -> Placed:
    """How the bodies stand to each other, as most of the images of all cameras see it; params (P,) by camera.

    Raises EstimationError naming a body that no image ties to the others.
    """
    votes = [_Votes.of(bodies, s, m, params[s.name]) for s, m in zip(streams, models, strict=True)]
    together = np.sum([v.together for v in votes], axis=0)
    place = {bodies.used[0]: (np.eye(3), np.zeros(3))}
    while len(place) < len(bodies.used):
        rest = [k for k in bodies.used if k not in place]
        ties = together[np.ix_(list(place), rest)]
        a, b = np.unravel_index(np.argmax(ties), ties.shape)
        near, far = list(place)[a], rest[b]
        relative = [pose for v in votes for pose in v.of_pair(near, far)]
        if not relative:
            names = bodies.target.bodies
            raise EstimationError(
                f"no image shows {names[far]} well enough to tell how it stands to {names[near]}; show both closer, in "
                "the same image, or take it out of the target."
            )
        R, p = _agreed(relative)
        R0, p0 = place[near]
        place[far] = R0 @ R, p0 + R0 @ p
    values: dict[Key, np.ndarray] = {}
    for k in bodies.used[1:]:
        values[bodies.target.bodies[k], "rotation"], values[bodies.target.bodies[k], "translation"] = place[k]
    return Placed(bodies, values, params)


@dataclass(frozen=True)
class _Votes:
    """What one camera's images say: views sorted by image, the poses of each, and by image the row of each body's view
    (M, bodies), -1 where it is not seen."""

    poses: TargetPoses
    row: np.ndarray

    @classmethod
    def of(cls, bodies: Bodies, stream: CornerStream, model: CameraModel, params: np.ndarray) -> _Votes:
        views = Views.of(stream, bodies.target.body)
        poses = body_poses(stream, views, bodies, model, params)
        row = np.full((len(stream.stamps_ns), len(bodies.target.bodies)), -1)
        good = np.flatnonzero(poses.ok[:, 0])
        row[views.image[good], views.body[good]] = good
        return cls(poses, row)

    @property
    def together(self) -> np.ndarray:
        """(bodies, bodies) number of images in which two are seen well."""
        seen = (self.row >= 0).astype(np.float32)
        return np.rint(seen.T @ seen).astype(np.int64)

    def of_pair(self, a: int, b: int) -> list[list[tuple[np.ndarray, np.ndarray]]]:
        """For each image with both, up to `VOTES` of them, what T_a_b may be: one to four poses."""
        images = np.flatnonzero((self.row[:, a] >= 0) & (self.row[:, b] >= 0))
        images = images[np.unique(np.linspace(0, len(images) - 1, VOTES).astype(int))] if len(images) else images
        return [self._pairs(self.row[i, a], self.row[i, b]) for i in images]

    def _pairs(self, va: int, vb: int) -> list[tuple[np.ndarray, np.ndarray]]:
        pose = self.poses
        found = []
        for m in self._sides(va):
            for n in self._sides(vb):
                R = pose.rotation[va, m] @ pose.rotation[vb, n].T
                found.append((R, pose.position[va, m] - R @ pose.position[vb, n]))
        return found

    def _sides(self, v: int) -> list[int]:
        rms = self.poses.rms_px[v]
        return [0, 1] if self.poses.ok[v, 1] and rms[1] < ALIKE * max(rms[0], LEAST_RMS_PX) else [0]


def _agreed(votes: list[list[tuple[np.ndarray, np.ndarray]]]) -> tuple[np.ndarray, np.ndarray]:
    """The pose that the images agree on most: distances to each image's nearest candidate, each bounded, are least."""
    R = np.array([R for pair in votes for R, _ in pair])
    p = np.array([p for pair in votes for _, p in pair])
    turn = so3.log_many(np.ascontiguousarray((R[:, None].swapaxes(-1, -2) @ R[None]).reshape(-1, 3, 3)))
    scale = np.maximum(np.linalg.norm(p, axis=1), 1e-3)
    apart = np.linalg.norm(turn, axis=1).reshape(len(R), -1)
    apart += np.linalg.norm(p[:, None] - p[None], axis=2) / np.maximum(scale[:, None], scale[None])
    first = np.cumsum([0] + [len(pair) for pair in votes[:-1]])
    nearest = np.minimum.reduceat(apart, first, axis=1)
    best = int(np.argmin(np.minimum(nearest, VOTE_SCALE).sum(axis=1)))
    return R[best], p[best]
