"""The first guess, from nothing: intrinsics, poses, clocks, rotation, gravity, lever arms. What the rig gives is
used."""

from __future__ import annotations

import numpy as np

from icalib.estimation.bodies import choose_bodies, restrict
from icalib.estimation.imu_data import imu_data
from icalib.first_guess.align_camera import align_camera, trusted
from icalib.first_guess.clocks import Alignment, camera_rates
from icalib.first_guess.contradicted import chosen, chosen_along
from icalib.first_guess.guess import CameraGuess, Guess, relative_offset
from icalib.first_guess.gyro import GyroRotation
from icalib.first_guess.lever_arm import LeverArm, check_gravity, check_size, lever_arm
from icalib.first_guess.scene import Placed, scene_poses
from icalib.first_guess.scene_lens import find_scene, lens_of
from icalib.first_guess.target_poses import TargetPoses
from icalib.first_guess.without_imu import guess_without_imu, trajectory_without_imu
from icalib.geometry.cameras import camera_model
from icalib.measurements import CornerStream, Measurements
from icalib.rig import Camera, Rig

__all__ = ["CameraGuess", "Guess", "initial_guess", "initial_trajectory"]

VELOCITY_STEP_S = 0.04


def initial_guess(rig: Rig, measurements: Measurements, scene: Placed | None = None) -> Guess:
    """`scene`: where the bodies of the target stand, if that is known already, and all streams hold only theirs.

    Raises EstimationError, one sentence, where the recording does not carry a guess.
    """
    if scene is None:
        bodies = choose_bodies(rig.target, [measurements], bent=False)
        measurements = restrict(bodies, measurements)
        scene = find_scene(rig, bodies, [measurements])
    params = [lens_of(c, s, rig.target, scene) for c, s in zip(rig.cameras, measurements.cameras, strict=True)]
    poses = [
        scene_poses(s, camera_model(c.model), p, scene)
        for c, s, p in zip(rig.cameras, measurements.cameras, params, strict=True)
    ]
    imu = imu_data(rig, measurements)
    if imu is None:
        return guess_without_imu(rig, measurements, params, poses, scene.values)
    aligned = [
        align_camera(c, s, camera_rates(s, q), imu, measurements)
        for c, s, q in zip(rig.cameras, measurements.cameras, poses, strict=True)
    ]
    best = int(np.argmax([q.ok.sum() for q in poses]))
    gyro_bias = aligned[best].gyro_bias
    gyro = GyroRotation.integrate(imu, gyro_bias)
    arms = [
        lever_arm(imu, s.seconds + a.offset, q, a.rotation, gyro, trusted(c.translation))
        for c, s, q, a in zip(rig.cameras, measurements.cameras, poses, aligned, strict=True)
    ]
    gravity = arms[best].gravity
    check_gravity(float(np.linalg.norm(gravity)), rig.gravity, imu.name, aligned[best].given)
    for c, m, a in zip(rig.cameras, arms, aligned, strict=True):
        check_size(m, c.name, a.given)
    cameras = {
        c.name: _camera_guess(c, s, p, a, m, q, measurements)
        for c, s, p, a, m, q in zip(rig.cameras, measurements.cameras, params, aligned, arms, poses, strict=True)
    }
    return Guess(cameras, gyro_bias, _mean_bias(arms), _level(gravity), scene.values)


def _camera_guess(
    camera: Camera,
    stream: CornerStream,
    params: np.ndarray,
    aligned: Alignment,
    arm: LeverArm,
    poses: TargetPoses,
    measurements: Measurements,
) -> CameraGuess:
    """What was found, and in its place what the rig gives, but guesses that it contradicts."""
    raw, p = camera.time_offset.value, camera.translation.value
    offset = None if raw is None else np.array([relative_offset(raw, stream, measurements)])
    if p is not None and camera.translation.mode == "free":
        p = chosen_along(p, arm.position, arm.covariance)
    return CameraGuess(
        params,
        float(chosen("time_offset", camera.time_offset, offset, np.array([aligned.offset]))[0]),
        chosen("rotation", camera.rotation, camera.rotation.value, aligned.rotation),
        arm.position if p is None else p,
        poses,
    )


def _mean_bias(arms: list[LeverArm]) -> np.ndarray:
    return np.mean([a.accel_bias for a in arms], axis=0)


def _level(gravity_board: np.ndarray) -> np.ndarray:
    """R_world_board with z against gravity and x along the horizontal direction nearest to the board's x (or y)."""
    up = -gravity_board / np.linalg.norm(gravity_board)
    reference = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    x = reference - (reference @ up) * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def initial_trajectory(
    guess: Guess, rig: Rig, measurements: Measurements, nodes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_world_imu (K, 3, 3), position and velocity (K, 3) at `nodes` [s on the imu clock since its first stamp].

    From the nearest camera pose, rotation carried by the gyroscope, position interpolated.
    """
    imu = imu_data(rig, measurements)
    if imu is None:
        return trajectory_without_imu(guess, measurements, nodes)
    t, R, p = guess.body_poses(measurements)

    def position(s: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(s, t, p[:, k]) for k in range(3)], axis=1)

    rotation = GyroRotation.integrate(imu, guess.gyro_bias).carry(t, R, nodes)
    velocity = (position(nodes + VELOCITY_STEP_S) - position(nodes - VELOCITY_STEP_S)) / (2.0 * VELOCITY_STEP_S)
    return np.ascontiguousarray(rotation), position(nodes), velocity
