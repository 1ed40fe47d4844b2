"""Settings of the estimator: the section `settings` of the rig file."""

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
    """Settings of the estimator, as in the rig file (docs/rig-file.md). The defaults suit every rig."""

    scheme: Scheme = "inertial"  # interpolation of poses between keyframes
    keyframes: Keyframes = "every-image"  # which images get a keyframe; first-camera: as in the iCalib paper
    loss: Loss = "huber"  # robust loss on corners
    loss_scale: float = 2.5  # residuals above this many standard deviations are down-weighted
    outlier_std: float = 4.0  # reject corners this many sigmas above the mean error of their image; 0: none
    outlier_min_px: float = 1.0  # corners with smaller errors are never rejected
    bloom: bool = True  # estimate edge bloom (dark edges shifted by blur and response), one value per camera
    board_shape: bool = True  # estimate deviations of the target from its design
    blur_noise: bool = True  # corner sigma grows with image speed (motion blur)
    common_error: bool = False  # corners of an image share a random shift; its sigma is estimated
    cache_corners: bool = True  # cache detected corners in the user's cache folder
    segments: int = 8  # number for the block jackknife (empirical factor); 0: no jackknife
    max_gap_s: float = 0.5  # IMU gaps up to this are bridged; longer ones split the recording
    keyframe_spacing_s: float = 0.05  # longest interval between consecutive keyframes
    # Constraint of tracked points to the planes that LiDARs see, as a standard deviation; 0: no constraint.
    points_on_planes_m: float = 0.0
    # The verdict on a parameter is `determined` if its standard deviation is at most its tolerance.
    rotation_tolerance_deg: float = 0.1
    translation_tolerance_m: float = 5e-3
    time_tolerance_s: float = 1e-3
    pixel_tolerance: float = 1.0  # px, of fx, fy, cx, cy

    def tolerance(self, name: ToleranceSetting) -> float:
        """Value of the setting `name`, a tolerance, in SI units (angles in rad) or px."""
        value = float(getattr(self, name))
        return math.radians(value) if name.endswith("_deg") else value
