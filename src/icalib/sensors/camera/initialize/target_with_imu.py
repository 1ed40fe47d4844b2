"""Initial guess of cameras that see a target, of the IMU's biases, and of the attitude of the target.

Steps: intrinsics; camera poses; time offset and rotation by angular rates; gravity, accelerometer bias and lever arm by
double-integrated accelerations. Each step uses the values of the rig file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.contradicted_guesses import merged_translation, merged_value
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.lever_arm import LeverArm, check_gravity, check_target_size, solve_camera_lever_arm
from icalib.initialize.steps.rate_alignment import RateAlignment
from icalib.motion.imu_data import ImuData, imu_data
from icalib.optim.state import Key
from icalib.rig import Camera, Rig
from icalib.sensors.camera.connected_bodies import choose_bodies, restrict
from icalib.sensors.camera.initialize.align_camera import align_camera, chosen_offset, known_value
from icalib.sensors.camera.initialize.boards.scene_intrinsics import find_scene, intrinsics_of
from icalib.sensors.camera.initialize.boards.target_poses import TargetPoses, camera_rates
from icalib.sensors.camera.initialize.boards.target_scene import TargetScene, scene_poses
from icalib.sensors.camera.initialize.guess import CameraGuess, Guess, relative_offset
from icalib.sensors.camera.initialize.imu_axes import refuse_other_axes
from icalib.sensors.camera.initialize.target_without_imu import guess_without_imu, trajectory_without_imu
from icalib.sensors.sensor import ROTATION

__all__ = ["CameraGuess", "Guess", "initial_guess", "initial_trajectory"]

# s, half the interval of the central difference for velocities; the interval is two image periods at 25 Hz. Over
# shorter intervals the noise of poses dominates, over longer ones the acceleration.
VELOCITY_HALF_STEP_S = 0.04


def initial_guess(rig: Rig, measurements: Measurements, scene: TargetScene | None = None) -> Guess:
    """The initial guess of one recording.

    scene: poses of the target's bodies, if known; streams must then have corners of these bodies only. If None, it is
    estimated from this recording. Raises EstimationError if the recording does not determine a guess.
    """
    if scene is None:
        bodies = choose_bodies(rig.target, [measurements], bent=False, rig=rig)
        measurements = restrict(bodies, measurements)
        scene = find_scene(rig, bodies, [measurements])
    params = [intrinsics_of(c, s, rig.target, scene) for c, s in zip(rig.cameras, measurements.cameras, strict=True)]
    poses = [
        scene_poses(s, camera_model(c.model), p, scene)
        for c, s, p in zip(rig.cameras, measurements.cameras, params, strict=True)
    ]
    imu = imu_data(rig, measurements)
    if imu is None:
        return guess_without_imu(rig, measurements, params, poses, scene.values)
    assert rig.imu is not None
    views = _TargetViews(rig, measurements, params, poses, scene.values)
    try:
        guess, is_contradicted = views.guess(imu)
    except EstimationError as error:
        refuse_other_axes(rig.imu, imu, views.unexplained_acceleration, error)
        raise
    if is_contradicted:
        refuse_other_axes(rig.imu, imu, views.unexplained_acceleration, None)
    return guess


@dataclass(frozen=True)
class _TargetViews:
    """Camera poses from images of the target, in one recording.

    params: (P,) intrinsics and distortion of each camera; poses: T_target_cam of the images of each camera. scene:
    poses T_target_body of the bodies as in a state, keyed by body and parameter.
    """

    rig: Rig
    measurements: Measurements
    params: list[np.ndarray]
    poses: list[TargetPoses]
    scene: dict[Key, np.ndarray]

    def guess(self, imu: ImuData) -> tuple[Guess, bool]:
        """The guess from camera poses and `imu`, and whether the accelerometer contradicts the camera poses.

        Raises EstimationError if the measurements do not determine the guess.
        """
        best = self._best_camera
        aligned = [self._aligned(imu, k) for k in range(len(self.poses))]
        gyro = GyroRotation.integrate(imu, aligned[best].gyro_bias)
        arms = [self._arm(imu, k, a, gyro) for k, a in enumerate(aligned)]
        self._check_gravity(imu, arms[best], aligned[best])
        for c, arm, a in zip(self.rig.cameras, arms, aligned, strict=True):
            check_target_size(arm, c.name, a.given)
        cameras = {
            c.name: _camera_guess(c, self._offset(imu, k, a), self.params[k], a, arm, self.poses[k])
            for k, (c, a, arm) in enumerate(zip(self.rig.cameras, aligned, arms, strict=True))
        }
        guess = Guess(
            cameras, aligned[best].gyro_bias, _mean_bias(arms), _attitude_of_board(arms[best].gravity), self.scene
        )
        return guess, arms[best].contradicts_camera

    def unexplained_acceleration(self, imu: ImuData) -> float:
        """Share of the acceleration of the camera with most poses that the accelerometer readings do not explain.

        Raises EstimationError if their alignment fails, or gravity is implausible.
        """
        a = self._aligned(imu, self._best_camera)
        arm = self._arm(imu, self._best_camera, a, GyroRotation.integrate(imu, a.gyro_bias))
        self._check_gravity(imu, arm, a)
        return arm.unexplained

    @property
    def _best_camera(self) -> int:
        """Index of the camera with most poses."""
        return int(np.argmax([q.ok.sum() for q in self.poses]))

    def _aligned(self, imu: ImuData, k: int) -> RateAlignment:
        """Time offset, rotation and gyroscope bias from the poses of camera `k`."""
        stream = self.measurements.cameras[k]
        return align_camera(self.rig.cameras[k], stream, camera_rates(stream, self.poses[k]), imu, self.measurements)

    def _offset(self, imu: ImuData, k: int, aligned: RateAlignment) -> float:
        """The time offset [s] of camera `k` from the rig file or `aligned`, with clocks counted from first stamps."""
        camera, stream = self.rig.cameras[k], self.measurements.cameras[k]
        raw = camera.time_offset.value
        given = None if raw is None else relative_offset(raw, stream, self.measurements)
        return chosen_offset(camera, camera_rates(stream, self.poses[k]), imu, given, aligned)

    def _arm(self, imu: ImuData, k: int, aligned: RateAlignment, gyro: GyroRotation) -> LeverArm:
        """Lever arm, gravity and accelerometer bias from the poses of camera `k`."""
        poses, known = self.poses[k], known_value(self.rig.cameras[k].translation)
        t = self.measurements.cameras[k].seconds[poses.ok] + aligned.offset
        R_board_imu = poses.rotation[poses.ok] @ aligned.rotation.T
        return solve_camera_lever_arm(imu, t, R_board_imu, poses.position[poses.ok], gyro, known)

    def _check_gravity(self, imu: ImuData, arm: LeverArm, aligned: RateAlignment) -> None:
        """Raises EstimationError if the length of gravity in `arm` is implausible."""
        check_gravity(float(np.linalg.norm(arm.gravity)), self.rig.gravity, imu.name, aligned.given)


def _camera_guess(
    camera: Camera, offset: float, params: np.ndarray, aligned: RateAlignment, arm: LeverArm, poses: TargetPoses
) -> CameraGuess:
    """The guess of one camera: values of the rig file, else the estimates `aligned` and `arm`.

    An estimate replaces an initial guess of the rig file if it contradicts it.
    """
    p = camera.translation.value
    if p is not None and camera.translation.mode == "free":
        p = merged_translation(p, arm.position, arm.covariance)
    return CameraGuess(
        params,
        offset,
        merged_value(ROTATION, camera.rotation, camera.rotation.value, aligned.rotation),
        arm.position if p is None else p,
        poses,
    )


def _mean_bias(arms: list[LeverArm]) -> np.ndarray:
    """(3,) [m/s^2] accelerometer bias: mean of the estimates from each camera."""
    return np.mean([a.accel_bias for a in arms], axis=0)


def _attitude_of_board(gravity_board: np.ndarray) -> np.ndarray:
    """R_world_board (3, 3) from gravity (3,) [m/s^2], which points down, in the board's frame; world z is up.

    World x is the projection of the board's x axis on the horizontal plane, or of its y axis if x is nearly vertical.
    """
    up = -gravity_board / np.linalg.norm(gravity_board)
    reference = np.eye(3)[0] if abs(up[0]) < 0.9 else np.eye(3)[1]
    x = reference - (reference @ up) * up
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(up, x), up])


def initial_trajectory(
    guess: Guess, rig: Rig, measurements: Measurements, keyframes: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_world_imu (K, 3, 3), position [m] and velocity [m/s] (K, 3) at `keyframes` (K,).

    keyframes: [s] on the IMU's clock since its first stamp. The gyroscope propagates the rotation from the nearest
    camera pose; positions are interpolated linearly; velocities are their central differences.
    """
    imu = imu_data(rig, measurements)
    if imu is None:
        return trajectory_without_imu(guess, measurements, keyframes)
    t, R, p = guess.body_poses(measurements)

    def position(s: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(s, t, p[:, k]) for k in range(3)], axis=1)

    rotation = GyroRotation.integrate(imu, guess.gyro_bias).carry(t, R, keyframes)
    step = VELOCITY_HALF_STEP_S
    velocity = (position(keyframes + step) - position(keyframes - step)) / (2.0 * step)
    return np.ascontiguousarray(rotation), position(keyframes), velocity
