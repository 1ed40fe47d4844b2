"""Initial noise of poses, before any estimation."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.data.measurements import PoseStream
from icalib.geometry import so3
from icalib.initialize.steps.smooth_trajectory import smooth_trajectory

MAD_TO_SIGMA = 1.4826  # ratio of the standard deviation of normal noise to its median absolute value


def pose_noise(streams: Sequence[PoseStream]) -> tuple[float, float]:
    """Standard deviations of rotation [rad] and position [m] from a smooth trajectory, each for the noisiest axis."""
    rotations, offsets = [], []
    for s in streams:
        smooth = smooth_trajectory(s.seconds, s.rotation, s.position, s.seconds, narrow=True)
        rotations.append(so3.log_many(np.ascontiguousarray(smooth.rotation.transpose(0, 2, 1) @ s.rotation)))
        offsets.append(s.position - smooth.position)
    rotation, position = (
        MAD_TO_SIGMA * np.median(np.abs(np.concatenate(x)), axis=0).max() for x in (rotations, offsets)
    )
    return float(rotation), float(position)
