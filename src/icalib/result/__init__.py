"""The result of a calibration: values with standard deviations and verdicts, saved and loaded whole."""

from icalib.result.calibration import (
    Calibration,
    CrossValidation,
    Iteration,
    ParameterGroup,
    Plane,
    PredictedFit,
    RecordingSpan,
    SensorFit,
    Trajectory,
    Verdict,
    Visited,
    by_key,
)
from icalib.result.derived import (
    ProjectionMap,
    RelativePose,
    joint_covariance,
    projection_uncertainty,
    relative_pose,
    relative_poses,
    working_distance,
)
from icalib.result.saving import calibration_files, load_calibration
from icalib.sensors.stream import Residuals, RowResiduals

__all__ = [
    "Calibration",
    "CrossValidation",
    "Iteration",
    "ParameterGroup",
    "Plane",
    "PredictedFit",
    "ProjectionMap",
    "RecordingSpan",
    "RelativePose",
    "Residuals",
    "RowResiduals",
    "SensorFit",
    "Trajectory",
    "Verdict",
    "Visited",
    "by_key",
    "calibration_files",
    "joint_covariance",
    "load_calibration",
    "projection_uncertainty",
    "relative_pose",
    "relative_poses",
    "working_distance",
]
