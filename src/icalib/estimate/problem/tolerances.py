"""What a user would call the same number: the scale against which a parameter is determined or not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.geometry.cameras import camera_model
from icalib.optim.state import Layout
from icalib.rig import Rig, Settings

# What a guess without a standard deviation is taken to be worth: rad, m, s, px, 1. Nobody guesses where the walls
# and frames of poses and which way the board are: if these moved with a sensor at some worth, little of a direction's
# would be left to it.
GUESS_SIGMA = {
    "rotation": 0.1, "translation": 0.1, "time_offset": 0.02, "intrinsics": 15.0, "distortion": 0.3, "bloom": 1.0,
    "shape": 1e-3, "tilt": 10.0, "radii": 0.01, "baseline": 0.05, "plane": 10.0, "radius": 0.01,
    "wheelbase": 0.1, "steering_offset": 0.1, "scales": 0.1, "ground_height": 0.1,
    "frame_rotation": 10.0, "frame_translation": 10.0,
}  # fmt: skip
UNGUESSED = 0.03  # rad or m: how well the start knows what nobody guessed, such as which way is up
FROM_NOTHING_M = 0.5  # what a translation is worth that nobody guessed: where the program took it to be
OTHER_SIGMA = 0.1  # of nuisance parameters without a prior


@dataclass(frozen=True)
class Tolerances:
    """Standard deviations below these are `determined`. Angles rad, lengths m, times s, image quantities px."""

    rotation: float = np.deg2rad(0.1)
    translation: float = 5e-3
    time_offset: float = 1e-3
    intrinsics: float = 1.0  # px; IMU intrinsics have their own
    distortion: float = 1e-2
    bloom: float = 0.1
    shape: float = 1e-3
    tilt: float = np.deg2rad(0.1)
    radii: float = 1e-4
    baseline: float = 1e-3
    radius: float = 1e-4
    wheelbase: float = 2e-3
    steering_offset: float = np.deg2rad(0.1)
    ground_height: float = 5e-3
    scales: float = 1e-3
    # Of normal and distance: wide, so that what is open is told in words of the sensors that it is open for.
    plane: tuple[float, float, float] = (np.deg2rad(10.0), np.deg2rad(10.0), 0.5)
    # Of where the frame of a pose sensor stands: wide, too.
    frame_rotation: float = np.deg2rad(10.0)
    frame_translation: float = 0.5
    size: float = 1e-2  # relative
    scale: float = 1e-2
    imu_intrinsics: float = 1e-2  # scale, misalignment [rad]; g-sensitivity rad/s per m/s^2

    @classmethod
    def asked_for(cls, settings: Settings) -> Tolerances:
        """Those of the rig file."""
        turn = np.deg2rad(settings.rotation_tolerance_deg)
        return cls(
            rotation=turn,
            translation=settings.translation_tolerance_m,
            time_offset=settings.time_tolerance_s,
            intrinsics=settings.pixel_tolerance,
        )

    def of(self, layout: Layout, imu: str | None) -> np.ndarray:
        """(B,) tolerance of each border column."""
        out = np.zeros(layout.size)
        for b in layout.free:
            name = "imu_intrinsics" if b.sensor == imu else b.name
            out[b.columns] = getattr(self, name)
        return out


def distortion_scales(rig: Rig, layout: Layout) -> np.ndarray:
    """(B,) what tolerances and guesses of each border column are to be multiplied with: `distortion_scale` of the
    camera's model for its distortion, 1 for all else."""
    scales = {c.name: camera_model(c.model).distortion_scale for c in rig.cameras}
    out = np.ones(layout.size)
    for b in layout.free:
        if b.name == "distortion":
            out[b.columns] = scales[b.sensor]
    return out
