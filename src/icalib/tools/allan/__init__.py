"""Noise densities, bias walks and bias instabilities of an IMU, from a recording at rest."""

from icalib.tools.allan.analysis import (
    AllanFit,
    Deviation,
    ImuNoiseStudy,
    SensorNoise,
    allan_deviation,
    study_imu,
    study_recording,
)
from icalib.tools.allan.files import write_study

__all__ = [
    "Deviation",
    "ImuNoiseStudy",
    "AllanFit",
    "SensorNoise",
    "allan_deviation",
    "study_imu",
    "study_recording",
    "write_study",
]
