"""Detects feature tracks without parallax, which leave the translation of cameras unobservable."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.motion.imu_data import imu_data
from icalib.rig import Rig
from icalib.sensors.camera.initialize.tracks.epipolar_rotation import (
    refine_relative_pose,
    rotation_error,
    rotation_without_translation,
)
from icalib.sensors.camera.initialize.tracks.from_tracks import start_intrinsics
from icalib.sensors.camera.initialize.tracks.joint_alignment import SharedRays, shared_rays

# Parallax over the median epipolar error. Noise alone gives up to 2.3, because parallax contains the errors of both
# rays in two axes, and the epipolar error those in one axis. Twice the value would refuse motion with usable parallax.
MIN_PARALLAX_RATIO = 3.0


def no_parallax(rig: Rig, recordings: Sequence[Measurements]) -> EstimationError | None:
    """An EstimationError, not raised, if no camera in any recording has parallax beyond noise; else None.

    It names the camera with the largest ratio of parallax to noise. Also None if a recording has no IMU data, or the
    intrinsics of a camera are not found.
    """
    ratios: list[tuple[float, float, str]] = []
    for m in recordings:
        imu = imu_data(rig, m)
        for k, (camera, stream) in enumerate(zip(rig.cameras, m.tracks, strict=True)):
            if imu is None:
                return None
            try:
                lens = start_intrinsics(camera, stream, imu, m)
            except EstimationError:
                return None
            pairs = [_parallax(pair) for pair in shared_rays(k, stream, camera_model(camera.model), lens)]
            if pairs:
                parallax, error = np.median(pairs, axis=0).tolist()
                ratios.append((parallax, error, camera.name))
    if not ratios:
        return None
    parallax, error, name = max(ratios, key=lambda x: x[0] / x[1])
    if parallax > MIN_PARALLAX_RATIO * error:
        return None
    return EstimationError(
        f"{name}: the tracked points move as in a pure rotation (parallax {np.rad2deg(parallax):.2g} deg, "
        f"noise {np.rad2deg(error):.2g} deg), so its translation is unobservable. Move the rig by a "
        "tenth of the distance to the scene or more, and turn it about all axes."
    )


def _parallax(pair: SharedRays) -> tuple[float, float]:
    """Parallax and epipolar error of two images, medians over their shared points [rad].

    The parallax is the distance between corresponding unit rays after the best rotation. The epipolar error is the
    angle between a ray and its epipolar plane.
    """
    R, t = rotation_without_translation(pair.f, pair.h)
    parallax = float(np.median(np.linalg.norm(pair.f @ R.T - pair.h, axis=1)))
    refine_relative_pose(pair.f, pair.h, R, t)
    return parallax, rotation_error(pair.f, pair.h, R, t)[1] + 1e-12
