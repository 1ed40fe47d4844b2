"""The first guess of cameras alone: each one's place beside the first, from images of the target taken together."""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.steps.target_poses import TargetPoses
from icalib.optim.state import Key
from icalib.rig import Rig
from icalib.sensors.camera.connected_bodies import taken_at_once
from icalib.sensors.camera.initialize.guess import CameraGuess, Guess, relative_offset

MOST_PAIRS = 200  # of images taken together; more do not make a first guess better
Scene = dict[Key, np.ndarray]
Pose = tuple[np.ndarray, np.ndarray]  # R (3, 3), p (3,)


def guess_without_imu(
    rig: Rig, measurements: Measurements, params: list[np.ndarray], poses: list[TargetPoses], scene: Scene
) -> Guess:
    """Raises EstimationError naming a camera that has a pose in no image, or that no images taken together tie to the
    first one."""
    for camera, own in zip(rig.cameras, poses, strict=True):
        if not own.ok.any():
            raise EstimationError(
                f"{camera.name}: its lens explains the corners in none of its {len(own.ok)} images; check its "
                "model and resolution in the rig file, and remove intrinsics and distortion so that they are "
                "estimated."
            )
    offsets = [
        relative_offset(np.zeros(1) if c.time_offset.value is None else c.time_offset.value, s, measurements)
        for c, s in zip(rig.cameras, measurements.cameras, strict=True)
    ]
    times = [s.seconds + o for s, o in zip(measurements.cameras, offsets, strict=True)]
    places = _places(rig, times, poses)
    cameras = {c.name: CameraGuess(params[i], offsets[i], *places[i], poses[i]) for i, c in enumerate(rig.cameras)}
    return Guess(cameras, np.zeros(3), np.zeros(3), np.eye(3), scene)


def trajectory_without_imu(
    guess: Guess, measurements: Measurements, keyframes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_world_body (K, 3, 3), position and velocity (K, 3) at `keyframes`: the pose of the nearest image, at rest."""
    t, R, p = guess.body_poses(measurements)
    nearest = np.searchsorted(0.5 * (t[1:] + t[:-1]), keyframes)
    return np.ascontiguousarray(R[nearest]), p[nearest], np.zeros((len(keyframes), 3))


def _places(rig: Rig, times: list[np.ndarray], poses: list[TargetPoses]) -> list[Pose]:
    """T_body_cam of every camera: given, or along images taken together, from the first camera outwards."""
    found: dict[int, Pose] = {0: (np.eye(3), np.zeros(3))}
    for i, c in enumerate(rig.cameras[1:], 1):
        if c.rotation.value is not None and c.translation.value is not None:
            found[i] = c.rotation.value, c.translation.value
    while len(found) < len(rig.cameras):
        reached = [(a, b) for a in found for b in range(len(rig.cameras)) if b not in found]
        beside = {(a, b): _beside(times[a], poses[a], times[b], poses[b]) for a, b in reached}
        (a, b), relative = max(beside.items(), key=lambda item: len(item[1]))
        if not relative:
            _nothing_shared(rig, found)
        R, p = _middle(relative)
        found[b] = found[a][0] @ R, found[a][1] + found[a][0] @ p
    for i, c in enumerate(rig.cameras[1:], 1):
        R, p = c.rotation.value, c.translation.value
        found[i] = (found[i][0] if R is None else R, found[i][1] if p is None else p)
    return [found[i] for i in range(len(rig.cameras))]


def _beside(ta: np.ndarray, a: TargetPoses, tb: np.ndarray, b: TargetPoses) -> list[Pose]:
    """T_a_b of each pair of images taken together."""
    together = np.column_stack(taken_at_once(ta, tb))
    together = together[a.ok[together[:, 0]] & b.ok[together[:, 1]]]
    if len(together) > MOST_PAIRS:
        together = together[np.linspace(0, len(together) - 1, MOST_PAIRS).astype(int)]
    return [(a.rotation[i].T @ b.rotation[j], a.rotation[i].T @ (b.position[j] - a.position[i])) for i, j in together]


def _middle(poses: list[Pose]) -> Pose:
    """The one whose median distance to the others is least; a radian counts as much as a metre."""
    R, p = np.array([R for R, _ in poses]), np.array([p for _, p in poses])
    turns = np.linalg.norm(so3.log_many((R[:, None].swapaxes(-1, -2) @ R[None]).reshape(-1, 3, 3)), axis=1)
    apart = turns.reshape(len(R), -1) + np.linalg.norm(p[:, None] - p[None], axis=2)
    return poses[int(np.argmin(np.median(apart, axis=1)))]


def _nothing_shared(rig: Rig, found: dict[int, Pose]) -> None:
    lost = ", ".join(c.name for i, c in enumerate(rig.cameras) if i not in found)
    known = ", ".join(c.name for i, c in enumerate(rig.cameras) if i in found)
    raise EstimationError(
        f"{lost} and {known} never saw the target at the same instant, and there is no IMU to connect them; "
        "show it to both at once with synchronised stamps, add the IMU, or give rotation and translation in "
        "the rig file."
    )
