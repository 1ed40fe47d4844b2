"""Whether tracked points move as they would if the rig only rotated: then nothing shows how far away they are."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.initialize.steps.epipolar_rotation import refine_relative_pose, rotation_error, rotation_without_translation
from icalib.motion.imu_data import imu_data
from icalib.rig import Rig
from icalib.sensors.camera.initialize.tracks.from_tracks import start_intrinsics
from icalib.sensors.camera.initialize.tracks.joint_alignment import SharedRays, shared_rays

# Times the error of rays: what is left of two images by rotation alone is two errors on two axes, and that by epipolar
# geometry one on one axis, so that noise alone makes up to 2.3.
NO_MORE_THAN_NOISE = 3.0


def no_parallax(rig: Rig, recordings: Sequence[Measurements]) -> EstimationError | None:
    """The sentence about the camera that sees most parallax, where even that is no more than noise; else None."""
    found = []
    for m in recordings:
        imu = imu_data(rig, m)
        for k, (camera, stream) in enumerate(zip(rig.cameras, m.tracks, strict=True)):
            if imu is None:
                return None
            try:
                lens = start_intrinsics(camera, stream, imu, m)
            except EstimationError:
                return None
            shown = [_parallax(pair) for pair in shared_rays(k, stream, camera_model(camera.model), lens)]
            if shown:
                found.append((*np.median(shown, axis=0).tolist(), camera.name))
    if not found:
        return None
    parallax, error, name = max(found, key=lambda x: x[0] / x[1])
    if parallax > NO_MORE_THAN_NOISE * error:
        return None
    return EstimationError(
        f"{name}: the tracked points move as in a pure rotation (parallax {np.rad2deg(parallax):.2g} deg, "
        f"noise {np.rad2deg(error):.2g} deg), so its translation is unobservable. Move the rig by a "
        "tenth of the distance to the scene or more, and turn it about all axes."
    )


def _parallax(pair: SharedRays) -> tuple[float, float]:
    """By how much the rays of two images differ beside a rotation, and by how much they miss their epipolar planes
    [rad]."""
    R, t = rotation_without_translation(pair.f, pair.h)
    beside = float(np.median(np.linalg.norm(pair.f @ R.T - pair.h, axis=1)))
    refine_relative_pose(pair.f, pair.h, R, t)
    return beside, rotation_error(pair.f, pair.h, R, t)[1] + 1e-12
