"""What is known of a lens before calibration, well enough to tell points that move from those that stand still."""

from __future__ import annotations

import numpy as np

from icalib.geometry.cameras import camera_model
from icalib.rig import Camera

WIDE_MODELS = ("pinhole-equidistant", "double-sphere", "eucm", "omni-radtan")
PX_PER_RAD = {False: 0.6, True: 0.4}  # over the image's width: a usual lens, and one of a model for wide angles


def rough_lens(camera: Camera) -> np.ndarray:
    """(P,) intrinsics and distortion: the rig file's values, or a usual lens of the model."""
    model = camera_model(camera.model)
    distortion = camera.distortion.value
    if distortion is None:
        distortion = np.array(model.start_distortions[0])
    if camera.intrinsics.value is not None:
        return np.concatenate([camera.intrinsics.value, distortion])
    width, height = camera.resolution
    lens = np.concatenate([[1.0, 1.0, (width - 1) / 2.0, (height - 1) / 2.0], distortion])
    lens[:2] = PX_PER_RAD[camera.model in WIDE_MODELS] * width / model.central_scale(lens)
    return lens
