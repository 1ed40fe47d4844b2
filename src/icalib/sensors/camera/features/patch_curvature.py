"""Corrects observations of feature tracks for the curvature that the lens gives to their patches.

A tracker aligns the patch around a feature's first view with the image under an affine map. A lens maps a patch
affinely to first order only. Its second-order terms move the point that the alignment reports away from the image of
the patch's mean ray, by

    b = 1/2 spread (d^2 pi / da^2 + d^2 pi / db^2)

with pi the projection, a and b perpendicular directions on the sphere of rays, scaled to one pixel, and `spread` [px^2]
the second moment of the patch with the weights of the alignment. The displacement b grows towards the border of the
image, and would bias the calibrated distortion. The observation is replaced by the projection of the mean ray.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.data.measurements import TrackStream
from icalib.geometry.cameras.base import CameraModel

# Unit directions in the image from an observation to four points around it.
_AROUND = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def with_curved_patches(stream: TrackStream, model: CameraModel, params: np.ndarray) -> TrackStream:
    """The stream with corrected observations, for lens parameters `params` (P,).

    Unchanged if the stream has no spread. Observations whose patch is outside the range of the lens model stay."""
    if not len(stream.spread):
        return stream
    # Four points at this distance from the observation have the same second moment as the patch.
    reach = np.sqrt(2.0 * stream.spread)[:, None]
    mean, has_rays = np.zeros((len(stream.uv), 3)), np.ones(len(stream.uv), dtype=bool)
    for direction in _AROUND:
        ray, valid = model.unproject(params, stream.uv + reach * direction)
        mean += ray
        has_rays &= valid
    uv, valid = model.project(params, np.where(has_rays[:, None], mean, [0.0, 0.0, 1.0]))
    return replace(stream, uv=np.where((has_rays & valid)[:, None], uv, stream.uv))
