"""The first guess where there is no target: rotations from the gyroscope, everything else linearly from tracks.

Cameras turn as the epipolar geometry of their tracks says; what the gyroscope says of the same turns gives time
offsets, rotations and its bias. With the gyroscope's rotations the rest is linear (`solve_linear_motion`).
"""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import Measurements, TrackStream
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.contradicted_guesses import merged_value
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.rate_alignment import RateAlignment
from icalib.initialize.steps.rate_regression import matching_track_rates
from icalib.initialize.steps.target_poses import TargetPoses
from icalib.motion.imu_data import ImuData, imu_data
from icalib.rig import Camera, Rig
from icalib.sensors.camera.initialize.align_camera import align_camera, chosen_offset, known_value
from icalib.sensors.camera.initialize.guess import CameraGuess, Guess, relative_offset
from icalib.sensors.camera.initialize.tracks.joint_alignment import align_jointly, shared_rays
from icalib.sensors.camera.initialize.tracks.linear_motion import Rays, WindowMotion, solve_linear_motion
from icalib.sensors.camera.initialize.tracks.track_intrinsics import find_intrinsics
from icalib.sensors.sensor import ROTATION

APART_S, FEWEST_SEEN = 0.15, 3
LEAST_FELT = 0.7  # of gravity; half the time a rig is not thrown about


def guess_from_tracks(rig: Rig, measurements: Measurements) -> Guess:
    """Raises EstimationError, one sentence, where the tracks do not carry a guess, or do not show the lens."""
    imu = imu_data(rig, measurements)
    assert imu is not None  # tracks without an IMU are refused before
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
    for k, (camera, stream, found) in enumerate(zip(rig.cameras, measurements.cameras, aligned, strict=True)):
        raw = camera.time_offset.value
        given = None if raw is None else relative_offset(raw, stream, measurements)
        offset = chosen_offset(camera, rates[k], imu, given, found)
        R = merged_value(ROTATION, camera.rotation, camera.rotation.value, found.rotation)
        p = motion.arms[k] if camera.translation.value is None else camera.translation.value
        cameras[camera.name] = CameraGuess(params[k], offset, R, p, _poses(motion, stream.seconds + offset, R, p))
    return Guess(cameras, gyro_bias=aligned[0].gyro_bias, accel_bias=motion.accel_bias, R_world_board=np.eye(3))


def _aligned_together(
    rig: Rig, measurements: Measurements, imu: ImuData, params: list[np.ndarray], aligned: list[RateAlignment]
) -> list[RateAlignment]:
    pairs = []
    for k, (camera, stream) in enumerate(zip(rig.cameras, measurements.tracks, strict=True)):
        pairs += shared_rays(k, stream, camera_model(camera.model), params[k])
    held = [(known_value(c.rotation) is not None, known_value(c.time_offset) is not None) for c in rig.cameras]
    return align_jointly(GyroRotation.integrate(imu, aligned[0].gyro_bias), pairs, aligned, held)


def _check_units(imu: ImuData, gravity: float) -> None:
    """Raises EstimationError where the accelerometer does not feel about `gravity` m/s^2."""
    felt = float(np.median(np.linalg.norm(imu.accel, axis=1)))
    if not LEAST_FELT < felt / gravity < 1.0 / LEAST_FELT:
        raise EstimationError(
            f"{imu.name} measures {felt:.3g} m/s^2 most of the time instead of about {gravity:.3g}; check that "
            "the accelerometer is in m/s^2, not in g."
        )


def start_intrinsics(camera: Camera, stream: TrackStream, imu: ImuData, measurements: Measurements) -> np.ndarray:
    """(P,) intrinsics and distortion: those of the rig file, else those estimated from the tracks.

    If the rig file gives intrinsics without distortion, the distortion is the first start value of the camera model.
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
    """What was seen while the IMU was running, in images some way apart: those between say little more."""
    parts = []
    for k, (camera, stream) in enumerate(zip(rig.cameras, measurements.tracks, strict=True)):
        direction, valid = camera_model(camera.model).unproject(params[k], stream.uv)
        t = (stream.seconds + offsets[k])[stream.image]
        own = valid & (t >= imu.seconds[0]) & (t <= imu.seconds[-1]) & _apart(stream)[stream.image]
        parts.append((t[own], np.full(int(own.sum()), k), stream.feature[own], direction[own]))
    return Rays(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _apart(stream: TrackStream) -> np.ndarray:
    """(n,) whether images are used: the first of each stretch of APART_S that has any, or of less where most points
    are seen too shortly for FEWEST_SEEN of these."""
    t = stream.seconds
    numbers, track = np.unique(stream.feature, return_inverse=True)
    first, last = np.full(len(numbers), np.inf), np.full(len(numbers), -np.inf)
    np.minimum.at(first, track, t[stream.image])
    np.maximum.at(last, track, t[stream.image])
    lasted = float(np.median((last - first)[track]))  # by observation, of which short tracks have few
    apart = min(APART_S, lasted / FEWEST_SEEN)
    return np.diff(np.floor((t - t[0]) / max(apart, 1e-3) + 1e-6), prepend=-1.0) > 0.0


def _poses(motion: WindowMotion, times: np.ndarray, R_imu_cam: np.ndarray, p_imu_cam: np.ndarray) -> TargetPoses:
    """A camera's poses in the world at `times` (M,)."""
    imu = motion.gyro.imu
    R, p = motion.poses(times)
    inside = (times >= imu.seconds[0]) & (times <= imu.seconds[-1])
    return TargetPoses(R @ R_imu_cam, p + R @ p_imu_cam, inside, np.zeros(len(times)))
