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
    """How the estimate is made. The defaults suit every rig."""

    scheme: Scheme = "inertial"  # how poses between keyframes follow from these
    keyframes: Keyframes = "every-image"  # images that are keyframes; first-camera is the paper's choice
    loss: Loss = "huber"  # robust loss on corners
    loss_scale: float = 2.5  # in standard deviations: residuals beyond have less weight
    outlier_std: float = 4.0  # reject corners so many standard deviations beyond their image's mean error; 0: none
    outlier_min_px: float = 1.0  # smaller errors are never rejected
    bloom: bool = True  # estimate edge bloom: dark edges shifted by blur and response, one size per camera
    board_shape: bool = True  # estimate how the target deviates from its design
    blur_noise: bool = True  # motion blur: sigma grows with image speed
    common_error: bool = False  # corners of one image share a random shift, whose sigma is estimated
    cache_corners: bool = True  # keep detected corners in the user's cache folder for the next run
    segments: int = 8  # of the block jackknife (empirical factor); 0: none
    max_gap_s: float = 0.5  # IMU gaps up to this are bridged; longer ones split the recording
    keyframe_spacing_s: float = 0.05  # longest interval between neighbouring keyframes
    # Tracked points lie on the planes that LiDARs see, with this standard deviation; 0: this is not assumed.
    points_on_planes_m: float = 0.0
    # A parameter is determined if its standard deviation is at most its tolerance.
    rotation_tolerance_deg: float = 0.1
    translation_tolerance_m: float = 5e-3
    time_tolerance_s: float = 1e-3
    pixel_tolerance: float = 1.0  # of fx, fy, cx, cy

    def tolerance(self, name: ToleranceSetting) -> float:
        """One of the tolerances, angles in rad."""
        value = float(getattr(self, name))
        return math.radians(value) if name.endswith("_deg") else value
