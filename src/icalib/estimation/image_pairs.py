"""Images that hang on one node but were not taken from there: the rig moved between, or one was exposed later.

The corners of such images are off as a whole, however well each image alone fits the target. Their medians stand out
of those of the other images of the camera.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.estimation.corner_factor import CornerFactor, CornerOutput
from icalib.estimation.medians import grouped_quantiles
from icalib.rig import Settings

STANDS_OUT = 8.0  # times the median of the images' medians: lenses and blur make a few times that
MOST_SHARE = 0.2  # of the pairs: where more do not fit, no single pair is to blame


def moved_between(
    cameras: Sequence[CornerFactor], outputs: Sequence[CornerOutput], settings: Settings
) -> list[np.ndarray]:
    """By camera (M,) bool: images that share their node with one of another camera, where either stands out."""
    shared = _shared_nodes(cameras)
    bad = np.zeros(len(shared), dtype=bool)
    for camera, out in zip(cameras, outputs, strict=True):
        size = np.linalg.norm(out.residual, axis=1)
        medians = grouped_quantiles(size, camera.stream.image, len(camera.node), 0.5)
        own = shared[camera.node] & np.isfinite(medians)
        if own.any():
            limit = max(STANDS_OUT * float(np.median(medians[own])), settings.outlier_min_px)
            bad[camera.node[own & (medians > limit)]] = True
    if bad.sum() > MOST_SHARE * shared.sum():
        bad[:] = False
    return [bad[camera.node] for camera in cameras]


def _shared_nodes(cameras: Sequence[CornerFactor]) -> np.ndarray:
    """(K,) bool: nodes with images of two cameras and more."""
    count = np.zeros(1 + max(int(c.node.max(initial=-1)) for c in cameras), dtype=np.int64)
    for camera in cameras:
        count[np.unique(camera.node)] += 1
    return count > 1
