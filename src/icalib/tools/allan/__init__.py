"""The noise of an IMU, from a recording of it at rest."""

from icalib.allan.analysis import ImuNoiseStudy, SensorNoise, study_imu, study_recording
from icalib.allan.deviation import Deviation, allan_deviation
from icalib.allan.files import write_study
from icalib.allan.fit import NoiseFit

__all__ = [
    "Deviation",
    "ImuNoiseStudy",
    "NoiseFit",
    "SensorNoise",
    "allan_deviation",
    "study_imu",
    "study_recording",
    "write_study",
]
