"""Initial guess of a rig without an IMU: relative poses of cameras from simultaneous images of the target."""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.optim.state import Key
from icalib.rig import Rig
from icalib.sensors.camera.connected_bodies import taken_at_once
from icalib.sensors.camera.initialize.boards.target_poses import TargetPoses
from icalib.sensors.camera.initialize.guess import CameraGuess, Guess, relative_offset

# Largest number of image pairs, spread over the recording, that determine the relative pose of two cameras. The cost
# grows with its square, and the initial guess needs no better mean.
MAX_IMAGE_PAIRS = 200
Scene = dict[Key, np.ndarray]
Pose = tuple[np.ndarray, np.ndarray]  # R (3, 3), p (3,) m


def guess_without_imu(
    rig: Rig, measurements: Measurements, params: list[np.ndarray], poses: list[TargetPoses], scene: Scene
) -> Guess:
    """The initial guess of one recording; the first camera is the body, and the world is the target's frame.

    params: (P,) intrinsics and distortion of each camera; poses: T_target_cam of the images of each camera; scene:
    poses of the target's bodies. Raises EstimationError naming a camera without any pose, or cameras that no
    simultaneous images connect to the first one.
    """
    for camera, camera_poses in zip(rig.cameras, poses, strict=True):
        if not camera_poses.ok.any():
            raise EstimationError(
                f"{camera.name}: its lens explains the corners in none of its {len(camera_poses.ok)} images; check its "
                "model and resolution in the rig file, and remove intrinsics and distortion so that they are "
                "estimated."
            )
    offsets = [
        relative_offset(np.zeros(1) if c.time_offset.value is None else c.time_offset.value, s, measurements)
        for c, s in zip(rig.cameras, measurements.cameras, strict=True)
    ]
    times = [s.seconds + o for s, o in zip(measurements.cameras, offsets, strict=True)]
    extrinsics = _extrinsics(rig, times, poses)
    cameras = {c.name: CameraGuess(params[i], offsets[i], *extrinsics[i], poses[i]) for i, c in enumerate(rig.cameras)}
    return Guess(cameras, np.zeros(3), np.zeros(3), np.eye(3), scene)


def trajectory_without_imu(
    guess: Guess, measurements: Measurements, keyframes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_world_body (K, 3, 3), position [m] and velocity [m/s] (K, 3) at `keyframes` (K,) [s].

    Each pose is that of the nearest image; velocities are zero.
    """
    t, R, p = guess.body_poses(measurements)
    nearest = np.searchsorted(0.5 * (t[1:] + t[:-1]), keyframes)
    return np.ascontiguousarray(R[nearest]), p[nearest], np.zeros((len(keyframes), 3))


def _extrinsics(rig: Rig, times: list[np.ndarray], poses: list[TargetPoses]) -> list[Pose]:
    """T_body_cam of each camera: that of the rig file, else by a tree of relative poses from the first camera.

    The tree grows by the pair of cameras with most simultaneous images. times: (M,) [s] instants of the images of each
    camera on the body's clock; poses: T_target_cam. Raises EstimationError if a camera is not connected.
    """
    extrinsics: dict[int, Pose] = {0: (np.eye(3), np.zeros(3))}
    for i, c in enumerate(rig.cameras[1:], 1):
        if c.rotation.value is not None and c.translation.value is not None:
            extrinsics[i] = c.rotation.value, c.translation.value
    while len(extrinsics) < len(rig.cameras):
        pairs = [(a, b) for a in extrinsics for b in range(len(rig.cameras)) if b not in extrinsics]
        relative_poses = {(a, b): _relative_poses(times[a], poses[a], times[b], poses[b]) for a, b in pairs}
        (a, b), relative = max(relative_poses.items(), key=lambda item: len(item[1]))
        if not relative:
            raise _not_connected(rig, extrinsics)
        R, p = _medoid(relative)
        extrinsics[b] = extrinsics[a][0] @ R, extrinsics[a][1] + extrinsics[a][0] @ p
    for i, c in enumerate(rig.cameras[1:], 1):
        R, p = c.rotation.value, c.translation.value
        extrinsics[i] = (extrinsics[i][0] if R is None else R, extrinsics[i][1] if p is None else p)
    return [extrinsics[i] for i in range(len(rig.cameras))]


def _relative_poses(ta: np.ndarray, a: TargetPoses, tb: np.ndarray, b: TargetPoses) -> list[Pose]:
    """T_a_b of two cameras, one for each of up to `MAX_IMAGE_PAIRS` pairs of simultaneous images, at `ta`, `tb` [s]."""
    pairs = np.column_stack(taken_at_once(ta, tb))
    pairs = pairs[a.ok[pairs[:, 0]] & b.ok[pairs[:, 1]]]
    if len(pairs) > MAX_IMAGE_PAIRS:
        pairs = pairs[np.linspace(0, len(pairs) - 1, MAX_IMAGE_PAIRS).astype(int)]
    return [(a.rotation[i].T @ b.rotation[j], a.rotation[i].T @ (b.position[j] - a.position[i])) for i, j in pairs]


def _medoid(poses: list[Pose]) -> Pose:
    """The medoid, a robust mean: the pose with the least median distance to all. One radian counts as one metre."""
    R, p = np.array([R for R, _ in poses]), np.array([p for _, p in poses])
    angles = np.linalg.norm(so3.log_many((R[:, None].swapaxes(-1, -2) @ R[None]).reshape(-1, 3, 3)), axis=1)
    distance = angles.reshape(len(R), -1) + np.linalg.norm(p[:, None] - p[None], axis=2)
    return poses[int(np.argmin(np.median(distance, axis=1)))]


def _not_connected(rig: Rig, connected: dict[int, Pose]) -> EstimationError:
    """The error, not raised, that no simultaneous images connect some cameras to those in `connected`."""
    lost = ", ".join(c.name for i, c in enumerate(rig.cameras) if i not in connected)
    known = ", ".join(c.name for i, c in enumerate(rig.cameras) if i in connected)
    return EstimationError(
        f"{lost} and {known} never saw the target at the same instant, and there is no IMU to connect them; "
        "show it to both at once with synchronised stamps, add the IMU, or give rotation and translation in "
        "the rig file."
    )
