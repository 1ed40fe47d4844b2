"""The algorithm of the first guess, on one page."""

from __future__ import annotations

import numpy as np

from icalib.estimation.imu_data import ImuData
from icalib.initialization.alignment import absolute_offset, align, mean_bias
from icalib.initialization.dead_reckoning import DeadReckoning
from icalib.initialization.gravity import camera_triples, check_accelerometer, fit_gravity, world_from_gravity
from icalib.initialization.guess import CameraGuess, Guess
from icalib.initialization.intrinsics import find_intrinsics
from icalib.initialization.poses import find_poses
from icalib.initialization.rates import GyroMeans
from icalib.initialization.single_axis import turn_about_axis
from icalib.measurements import Measurements
from icalib.rig import Rig


def initial_guess(rig: Rig, measurements: Measurements) -> Guess:
    """First guess of everything that is calibrated; what the rig gives a value for (fixed, prior, guess) keeps it.

    Raises EstimationError, one sentence naming the sensor and what to do, where the recording cannot give one: no
    usable images, no motion, clocks that never overlap, wrong units, a wrong size of the target.
    """
    imu = ImuData.build(measurements.imu, rig.imu.noise)
    pairs = list(zip(rig.cameras, measurements.cameras, strict=True))

    params = [find_intrinsics(camera, stream, rig.target) for camera, stream in pairs]
    poses = [find_poses(s, c.model, x, rig.target) for (c, s), x in zip(pairs, params, strict=True)]

    gyro = GyroMeans(imu)
    fits = [align(c, s, measurements.imu, gyro, p) for (c, s), p in zip(pairs, poses, strict=True)]
    gyro_bias = mean_bias(fits)
    reckoning = DeadReckoning.integrate(imu, gyro_bias)

    rotations, triples, notes = [], [], []
    for (camera, stream), pose, fit in zip(pairs, poses, fits, strict=True):
        seconds = stream.seconds + fit.offset
        rotation = fit.R_imu_cam
        if fit.axis is not None:
            rotation = turn_about_axis(seconds, pose, fit, camera.translation.value, reckoning, camera.name)
            notes.append(
                f"{camera.name} turned about one axis only, so its rotation about this axis could be guessed from "
                "accelerations alone; turn the sensors about all axes."
            )
        rotations.append(rotation)
        triples.append(camera_triples(seconds, pose, rotation, camera.translation.value, reckoning, camera.name))
    check_accelerometer(triples, rig.gravity, rig.imu.name)
    found = fit_gravity(triples)

    cameras = {}
    for i, (camera, stream) in enumerate(pairs):
        time_offset = camera.time_offset.value
        cameras[camera.name] = CameraGuess(
            intrinsics=params[i][:4],
            distortion=params[i][4:],
            R_imu_cam=rotations[i],
            p_imu_cam=found.levers[i],
            time_offset_s=absolute_offset(fits[i].offset, stream.origin_ns, measurements.imu.origin_ns)
            if time_offset is None
            else float(time_offset[0]),
            relative_offset=fits[i].offset,
            poses=poses[i],
        )
    return Guess(cameras, gyro_bias, found.accel_bias, world_from_gravity(found.gravity), tuple(notes))
