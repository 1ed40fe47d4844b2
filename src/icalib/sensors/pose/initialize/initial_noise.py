"""The noise of poses, before any estimate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.data.measurements import PoseStream
from icalib.geometry import so3
from icalib.initialize.steps.smooth_trajectory import smooth_trajectory

MAD_SIGMA = 1.4826  # standard deviation of normal noise over its median absolute value


def pose_noise(streams: Sequence[PoseStream]) -> tuple[float, float]:
    """Of rotation [rad] and position [m], of the noisiest axis: the scatter of poses about a smooth path."""
    turns, offsets = [], []
    for s in streams:
        path = smooth_trajectory(s.seconds, s.rotation, s.position, s.seconds, narrow=True)
        turns.append(so3.log_many(np.ascontiguousarray(path.rotation.transpose(0, 2, 1) @ s.rotation)))
        offsets.append(s.position - path.position)
    turn, way = (MAD_SIGMA * np.median(np.abs(np.concatenate(x)), axis=0).max() for x in (turns, offsets))
    return float(turn), float(way)
