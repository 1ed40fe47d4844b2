"""Rejects sets of images whose stamps are equal, but which were not exposed at the same time on a moving rig.

Without an IMU, simultaneous images of several cameras share a keyframe, and so a pose of the rig. If the rig moved
between their exposures, no pose fits all of them, even if each image alone fits the target. The median residual of an
image is then far above that of the camera's other images.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.optim.medians import grouped_quantiles
from icalib.rig import Settings
from icalib.sensors.camera.corner_factor import CornerFactor, CornerOutput

MAX_MEDIAN_RATIO = 8.0  # median residual of an image over that of the median image; blur and lens misfit reach a few
MAX_REJECTED_SHARE = 0.2  # of the shared keyframes; if more do not fit, there is another cause, and none is rejected


def not_simultaneous(
    cameras: Sequence[CornerFactor], outputs: Sequence[CornerOutput], settings: Settings
) -> list[np.ndarray]:
    """For each camera (M,) bool: its images at shared keyframes with an image that does not fit.

    An image does not fit if its median residual is above `outlier_min_px` and above `MAX_MEDIAN_RATIO` times that of
    the camera's median image. All images of its keyframe are rejected, because the late one is not known.
    """
    shared = _shared_keyframes(cameras)
    bad = np.zeros(len(shared), dtype=bool)
    for camera, out in zip(cameras, outputs, strict=True):
        size = np.linalg.norm(out.residual, axis=1)  # a common error would compensate the shift of a late image
        medians = grouped_quantiles(size, camera.stream.image, len(camera.keyframe), 0.5)
        tested = shared[camera.keyframe] & np.isfinite(medians)
        if tested.any():
            limit = max(MAX_MEDIAN_RATIO * float(np.median(medians[tested])), settings.outlier_min_px)
            bad[camera.keyframe[tested & (medians > limit)]] = True
    if bad.sum() > MAX_REJECTED_SHARE * shared.sum():
        bad[:] = False
    return [bad[camera.keyframe] for camera in cameras]


def _shared_keyframes(cameras: Sequence[CornerFactor]) -> np.ndarray:
    """(K,) bool: keyframes with images of two or more cameras; keyframe K - 1 is the last one with an image."""
    count = np.zeros(1 + max(int(c.keyframe.max(initial=-1)) for c in cameras), dtype=np.int64)
    for camera in cameras:
        count[np.unique(camera.keyframe)] += 1
    return count > 1
