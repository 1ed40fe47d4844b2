"""The result of a calibration: values with standard deviations and verdicts, saved and loaded whole."""

from icalib.result.calibration import (
    Calibration,
    Iteration,
    ParameterGroup,
    RecordingSpan,
    SensorFit,
    Trajectory,
    Verdict,
    Visited,
    by_key,
)
from icalib.result.cross_validation import CrossValidation, PredictedFit
from icalib.result.planes import Plane
from icalib.result.projection import ProjectionMap, projection_uncertainty, working_distance
from icalib.result.relative import RelativePose, joint_covariance, relative_pose, relative_poses
from icalib.result.saving import calibration_files, load_calibration
from icalib.sensors.records import Residuals, RowResiduals

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
