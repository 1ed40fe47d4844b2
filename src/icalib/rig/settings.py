"""How the estimate is made."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from icalib.sensors.parameter_spec import ToleranceSetting

Scheme = Literal["inertial", "pose", "kinematic"]
Loss = Literal["none", "huber", "cauchy"]
Keyframes = Literal["every-image", "first-camera"]


@dataclass(frozen=True)
class Settings:
    """How the estimate is made; every field has a default that just works."""

    scheme: Scheme = "inertial"  # where a sensor was between nodes
    keyframes: Keyframes = "every-image"  # images that have a keyframe of their own; the paper: the first camera's
    loss: Loss = "huber"  # robust loss on corners
    loss_scale: float = 2.5  # in standard deviations, where the loss starts to bend
    outlier_std: float = 4.0  # drop corners this many standard deviations beyond their image's mean error; 0: none
    outlier_min_px: float = 1.0  # but never one with a smaller error
    bloom: bool = True  # corners pulled towards their tag's centre, one size a camera
    board_shape: bool = True  # the target is not flat: estimate how it bends
    blur_noise: bool = True  # corners of fast images weigh less
    common_error: bool = False  # corners of one image share an error: a shift, its size estimated
    cache_corners: bool = True  # keep detected corners in the user's cache folder for the next run
    segments: int = 8  # segments of the block jackknife (empirical factor), 0: none
    max_gap_s: float = 0.5  # IMU gaps up to this are bridged; longer ones split the recording
    keyframe_spacing_s: float = 0.05  # largest distance of neighbouring keyframes
    # Points that cameras follow lie on the planes that LiDARs see, to within this; 0: nothing is said of that.
    points_on_planes_m: float = 0.0
    # What is known to better than these is determined.
    rotation_tolerance_deg: float = 0.1
    translation_tolerance_m: float = 5e-3
    time_tolerance_s: float = 1e-3
    pixel_tolerance: float = 1.0  # of fx, fy, cx, cy

    def tolerance(self, name: ToleranceSetting) -> float:
        """One of the tolerances, angles in rad."""
        value = float(getattr(self, name))
        return math.radians(value) if name.endswith("_deg") else value
