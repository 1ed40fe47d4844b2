"""Relative poses of bodies that no image shows together, but that two cameras of a rig see at the same instants.

Cameras a and b of a rig see the bodies A and B, which do not move. At each instant i

    T_A_a(i) T_a_b = T_A_B T_B_b(i),

which is the equation AX = YB of robot-world/hand-eye calibration (Zhuang, Roth, Sudhakar 1994; Shah 2013).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.hand_eye import MAX_UNEXPLAINED_MOTION, PosePairs, hand_eye, unexplained_motion
from icalib.model.bodies import Bodies
from icalib.motion.pose_rows import Extrinsics, Frame
from icalib.optim.state import Key
from icalib.rig import Camera, Rig
from icalib.sensors.camera.connected_bodies import (
    MIN_SHARED_IMAGES,
    camera_times,
    restrict,
    taken_at_once,
    tied_by_images,
)
from icalib.sensors.camera.initialize.boards.incremental_scene import UnconnectedBodiesError, place_bodies
from icalib.sensors.camera.initialize.boards.target_poses import TargetPoses
from icalib.sensors.camera.initialize.boards.target_scene import TargetScene, scene_poses


def register_groups(
    rig: Rig, bodies: Bodies, recordings: Sequence[Measurements], params: dict[str, np.ndarray]
) -> TargetScene:
    """Poses of all bodies: within groups that images connect, then between groups by simultaneous images.

    params: fixed intrinsics and distortion (P,) by camera name. Raises UnconnectedBodiesError naming bodies that are
    not connected to the first group; EstimationError if images are mirrored, or cameras are not rigidly connected.
    """
    used = tied_by_images(bodies, recordings)
    groups = [_Group.of(rig, replace(bodies, used=indices), recordings, params) for indices in used]
    values, frames = dict(groups[0].scene.values), {0: Frame(np.eye(3), np.zeros(3))}
    while len(frames) < len(groups):
        tied = [(g, h, _tied(groups[g], groups[h])) for g in frames for h in range(len(groups)) if h not in frames]
        g, h, best = max(tied, key=lambda item: len(item[2].pairs.p_body))
        if len(best.pairs.p_body) < MIN_SHARED_IMAGES:
            lost = [x.scene.bodies.names for k, x in enumerate(groups) if k not in frames]
            raise UnconnectedBodiesError(tuple(name for names in lost for name in names))
        T_g_h = _solved(best, rig.cameras)
        frames[h] = Frame(frames[g].R @ T_g_h.R, frames[g].p + frames[g].R @ T_g_h.p)
        values |= groups[h].values_at(frames[h])
    return TargetScene(bodies, values, params)


@dataclass(frozen=True)
class _Group:
    """Bodies that images connect, in the frame of the first one.

    times, poses: for each recording and camera, instants (M,) [s] of the images that show these bodies, and the poses
    of the camera in the frame of the group.
    """

    scene: TargetScene
    times: list[list[np.ndarray]]
    poses: list[list[TargetPoses]]

    @classmethod
    def of(cls, rig: Rig, bodies: Bodies, recordings: Sequence[Measurements], params: dict[str, np.ndarray]) -> _Group:
        """The group of `bodies`, with camera poses in all `recordings`.

        params: (P,) intrinsics and distortion by camera name."""
        restricted = [restrict(bodies, r) for r in recordings]
        models = [camera_model(c.model) for c in rig.cameras]
        scene = TargetScene(bodies)
        if bodies.several:
            seeing = [i for i in range(len(models)) if any(len(r.cameras[i].point) for r in restricted)]
            streams = [CornerStream.joined([r.cameras[i] for r in restricted]) for i in seeing]
            scene = place_bodies(bodies, streams, [models[i] for i in seeing], params)
        times = [camera_times(rig, r, recording.origin_ns) for r, recording in zip(restricted, recordings, strict=True)]
        poses = [
            [scene_poses(s, m, params[s.name], scene) for s, m in zip(r.cameras, models, strict=True)]
            for r in restricted
        ]
        return cls(scene, times, poses)

    def values_at(self, frame: Frame) -> dict[Key, np.ndarray]:
        """Poses T_scene_body of the bodies as in a state, for the pose `frame` of the group in the scene."""
        R, p = self.scene.bodies.poses(self.scene.values)
        values: dict[Key, np.ndarray] = {}
        for k, name in zip(self.scene.bodies.used, self.scene.bodies.names, strict=True):
            values[name, "rotation"], values[name, "translation"] = frame.R @ R[k], frame.R @ p[k] + frame.p
        return values


@dataclass(frozen=True)
class _Tied:
    """Poses of camera number `a` in one group, and of camera number `b` in another, at the same instants."""

    a: int
    b: int
    pairs: PosePairs


def _tied(g: _Group, h: _Group) -> _Tied:
    """The poses of the pair of cameras that has most simultaneous images of the groups `g` and `h`."""
    cameras = permutations(range(len(g.poses[0])), 2)
    return max((_Tied(a, b, _pairs(g, h, a, b)) for a, b in cameras), key=lambda t: len(t.pairs.p_body))


def _pairs(g: _Group, h: _Group, a: int, b: int) -> PosePairs:
    """Simultaneous poses of camera `a` in group `g` and of camera `b` in group `h`, from all recordings."""
    poses = []
    for times_g, poses_g, times_h, poses_h in zip(g.times, g.poses, h.times, h.poses, strict=True):
        i, j = taken_at_once(times_g[a], times_h[b])
        good = poses_g[a].ok[i] & poses_h[b].ok[j]
        i, j = i[good], j[good]
        poses.append((poses_g[a].rotation[i], poses_g[a].position[i], poses_h[b].rotation[j], poses_h[b].position[j]))
    return PosePairs(*(np.concatenate(x) for x in zip(*poses, strict=True)))


def _solved(tied: _Tied, cameras: Sequence[Camera]) -> Frame:
    """Pose of the second group in the first, by hand-eye calibration.

    Raises EstimationError if the cameras are not rigidly connected."""
    a, b = cameras[tied.a], cameras[tied.b]
    solution = hand_eye(tied.pairs, _given(a, b, tied.a == 0, tied.b == 0), (False, False))
    if (left := unexplained_motion(tied.pairs, solution)) > MAX_UNEXPLAINED_MOTION:
        raise EstimationError(
            f"{a.name} and {b.name} see different bodies of the target and do not move alike: {left:.0%} of "
            "the motion is unexplained; check that the bodies stand still, and that one clock stamps both "
            "cameras."
        )
    return solution.frame


def _given(a: Camera, b: Camera, a_is_body: bool, b_is_body: bool) -> Extrinsics | None:
    """T_a_b if the rig file has the extrinsics of both cameras, else None. Those of the reference are the identity."""
    mounts = []
    for camera, is_body in ((a, a_is_body), (b, b_is_body)):
        R, p = camera.rotation.value, camera.translation.value
        if is_body:
            R, p = np.eye(3), np.zeros(3)
        if R is None or p is None:
            return None
        mounts.append(Extrinsics(R, p))
    one, other = mounts
    return Extrinsics(one.R.T @ other.R, one.R.T @ (other.p - one.p))
