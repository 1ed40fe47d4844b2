"""The result of a calibration: values with standard deviations and verdicts, saved and loaded whole."""

from icalib.result.calibration import (
    Calibration,
    ImuResiduals,
    Iteration,
    ParameterGroup,
    RecordingSpan,
    SensorFit,
    Trajectory,
    Verdict,
    Visited,
)
from icalib.result.cross_validation import CrossValidation, PredictedFit
from icalib.result.images import CornerResiduals, ImageResiduals, TrackResiduals, image_of, rms_of_images
from icalib.result.projection import ProjectionMap, projection_uncertainty, working_distance
from icalib.result.relative import RelativePose, joint_covariance, relative_pose, relative_poses
from icalib.result.robot import LidarResiduals, Plane, PoseResiduals, WheelResiduals
from icalib.result.saving import calibration_files, load_calibration

__all__ = [
    "Calibration",
    "CornerResiduals",
    "CrossValidation",
    "ImageResiduals",
    "ImuResiduals",
    "Iteration",
    "LidarResiduals",
    "ParameterGroup",
    "Plane",
    "PoseResiduals",
    "PredictedFit",
    "ProjectionMap",
    "RecordingSpan",
    "RelativePose",
    "SensorFit",
    "TrackResiduals",
    "Trajectory",
    "Verdict",
    "Visited",
    "WheelResiduals",
    "calibration_files",
    "image_of",
    "joint_covariance",
    "load_calibration",
    "projection_uncertainty",
    "relative_pose",
    "relative_poses",
    "rms_of_images",
    "working_distance",
]
