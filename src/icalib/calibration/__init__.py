"""The result of a calibration: values with standard deviations and verdicts, saved and loaded whole."""

from icalib.calibration.result import (
    Calibration,
    CornerResiduals,
    ImuResiduals,
    Iteration,
    ParameterGroup,
    RecordingSpan,
    SensorFit,
    Trajectory,
    Verdict,
    Visited,
)
from icalib.calibration.saving import calibration_files, load_calibration

__all__ = [
    "Calibration",
    "CornerResiduals",
    "ImuResiduals",
    "Iteration",
    "ParameterGroup",
    "RecordingSpan",
    "SensorFit",
    "Trajectory",
    "Verdict",
    "Visited",
    "calibration_files",
    "load_calibration",
]
