"""Initial guess from feature tracks and an IMU, without a target.

Epipolar geometry gives the rotations of each camera between images. Their alignment with the gyroscope gives time
offsets, extrinsic rotations and the gyroscope bias. With known rotations, velocities, gravity, accelerometer bias and
lever arms are the solution of a linear problem (`linear_motion`).
"""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import Measurements, TrackStream
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.contradicted_guesses import merged_value
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.rate_alignment import RateAlignment
from icalib.motion.imu_data import ImuData, imu_data
from icalib.rig import Camera, Rig
from icalib.sensors.camera.initialize.align_camera import align_camera, chosen_offset, known_value
from icalib.sensors.camera.initialize.boards.target_poses import TargetPoses
from icalib.sensors.camera.initialize.guess import CameraGuess, Guess, relative_offset
from icalib.sensors.camera.initialize.tracks.joint_alignment import align_jointly, shared_rays
from icalib.sensors.camera.initialize.tracks.linear_motion import Rays, WindowMotion, solve_linear_motion
from icalib.sensors.camera.initialize.tracks.track_intrinsics import find_intrinsics
from icalib.sensors.camera.initialize.tracks.track_rates import matching_track_rates
from icalib.sensors.sensor import ROTATION

MAX_IMAGE_STEP_S = 0.15  # s between the images that the linear problem uses; others add little information
MIN_TRACK_IMAGES = 3  # selected images that a typical track spans; the linear problem uses no shorter tracks
MIN_GRAVITY_RATIO = 0.7  # median specific force over gravity; typical rigs accelerate by less than 3 m/s^2


def guess_from_tracks(rig: Rig, measurements: Measurements) -> Guess:
    """The initial guess of one recording; its camera poses are in the world frame.

    Raises EstimationError if the tracks do not determine the guess, or the intrinsics of a camera.
    """
    imu = imu_data(rig, measurements)
    assert imu is not None  # the rig file reader refuses tracks without an IMU
    params = [start_intrinsics(c, t, imu, measurements) for c, t in zip(rig.cameras, measurements.tracks, strict=True)]
    rates = [
        matching_track_rates(imu, t, camera_model(c.model), p)
        for c, t, p in zip(rig.cameras, measurements.tracks, params, strict=True)
    ]
    aligned = [
        align_camera(c, s, r, imu, measurements)
        for c, s, r in zip(rig.cameras, measurements.cameras, rates, strict=True)
    ]
    aligned = _aligned_together(rig, measurements, imu, params, aligned)
    gyro = GyroRotation.integrate(imu, aligned[0].gyro_bias)
    rays = _rays(rig, measurements, imu, params, [a.offset for a in aligned])
    arms = [known_value(c.translation) for c in rig.cameras]
    _check_units(imu, rig.gravity)
    motion = solve_linear_motion(gyro, rays, [a.rotation for a in aligned], arms, rig.gravity)
    cameras = {}
    for k, (camera, stream, alignment) in enumerate(zip(rig.cameras, measurements.cameras, aligned, strict=True)):
        raw = camera.time_offset.value
        given = None if raw is None else relative_offset(raw, stream, measurements)
        offset = chosen_offset(camera, rates[k], imu, given, alignment)
        R = merged_value(ROTATION, camera.rotation, camera.rotation.value, alignment.rotation)
        p = motion.arms[k] if camera.translation.value is None else camera.translation.value
        cameras[camera.name] = CameraGuess(params[k], offset, R, p, _poses(motion, stream.seconds + offset, R, p))
    return Guess(cameras, gyro_bias=aligned[0].gyro_bias, accel_bias=motion.accel_bias, R_world_board=np.eye(3))


def _aligned_together(
    rig: Rig, measurements: Measurements, imu: ImuData, params: list[np.ndarray], aligned: list[RateAlignment]
) -> list[RateAlignment]:
    """The alignments of all cameras, refined together with one gyroscope bias; see `joint_alignment`.

    params: (P,) intrinsics and distortion of each camera; aligned: alignments of single cameras."""
    pairs = []
    for k, (camera, stream) in enumerate(zip(rig.cameras, measurements.tracks, strict=True)):
        pairs += shared_rays(k, stream, camera_model(camera.model), params[k])
    fixed = [(known_value(c.rotation) is not None, known_value(c.time_offset) is not None) for c in rig.cameras]
    return align_jointly(GyroRotation.integrate(imu, aligned[0].gyro_bias), pairs, aligned, fixed)


def _check_units(imu: ImuData, gravity: float) -> None:
    """Raises EstimationError if the ratio of median specific force and `gravity` [m/s^2] is far from 1."""
    force = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    if not MIN_GRAVITY_RATIO < force / gravity < 1.0 / MIN_GRAVITY_RATIO:
        raise EstimationError(
            f"{imu.name} measures {force:.3g} m/s^2 most of the time instead of about {gravity:.3g}; check that "
            "the accelerometer is in m/s^2, not in g."
        )


def start_intrinsics(camera: Camera, stream: TrackStream, imu: ImuData, measurements: Measurements) -> np.ndarray:
    """(P,) intrinsics and distortion: those of the rig file, else those estimated from the tracks.

    If the rig file has intrinsics but no distortion, the distortion is the first start value of the camera model.
    Raises EstimationError as `find_intrinsics` does.
    """
    if camera.intrinsics.value is None:
        fixed = known_value(camera.time_offset)
        offset = None if fixed is None else relative_offset(fixed, stream, measurements)
        return find_intrinsics(camera, stream, imu, offset)
    distortion = camera.distortion.value
    if distortion is None:
        distortion = np.array(camera_model(camera.model).start_distortions[0])
    return np.concatenate([camera.intrinsics.value, distortion])


def _rays(rig: Rig, measurements: Measurements, imu: ImuData, params: list[np.ndarray], offsets: list[float]) -> Rays:
    """Rays of all cameras in the selected images within the IMU's recording.

    params: (P,) by camera; offsets: time offsets [s] by camera, clocks counted from their first stamps."""
    parts = []
    for k, (camera, stream) in enumerate(zip(rig.cameras, measurements.tracks, strict=True)):
        direction, valid = camera_model(camera.model).unproject(params[k], stream.uv)
        t = (stream.seconds + offsets[k])[stream.image]
        used = valid & (t >= imu.seconds[0]) & (t <= imu.seconds[-1]) & _selected_images(stream)[stream.image]
        parts.append((t[used], np.full(int(used.sum()), k), stream.feature[used], direction[used]))
    return Rays(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _selected_images(stream: TrackStream) -> np.ndarray:
    """(M,) bool: selects the first image in each interval of `MAX_IMAGE_STEP_S`.

    The interval is shorter if the median track is too short for `MIN_TRACK_IMAGES` such images.
    """
    t = stream.seconds
    numbers, track = np.unique(stream.feature, return_inverse=True)
    first, last = np.full(len(numbers), np.inf), np.full(len(numbers), -np.inf)
    np.minimum.at(first, track, t[stream.image])
    np.maximum.at(last, track, t[stream.image])
    duration = float(np.median((last - first)[track]))  # weighted by observations, so that short tracks count little
    step = min(MAX_IMAGE_STEP_S, duration / MIN_TRACK_IMAGES)
    return np.diff(np.floor((t - t[0]) / max(step, 1e-3) + 1e-6), prepend=-1.0) > 0.0


def _poses(motion: WindowMotion, times: np.ndarray, R_imu_cam: np.ndarray, p_imu_cam: np.ndarray) -> TargetPoses:
    """Poses of a camera in the world at `times` (M,) [s] on the IMU's clock; `ok` within the IMU's recording."""
    imu = motion.gyro.imu
    R, p = motion.poses(times)
    inside = (times >= imu.seconds[0]) & (times <= imu.seconds[-1])
    return TargetPoses(R @ R_imu_cam, p + R @ p_imu_cam, inside, np.zeros(len(times)))
