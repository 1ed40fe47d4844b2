"""The result of a calibration: values with standard deviations and verdicts, saved and loaded whole."""

from icalib.calibration.cross_validation import CrossValidation, PredictedFit
from icalib.calibration.images import CornerResiduals, ImageResiduals, TrackResiduals, image_of, rms_of_images
from icalib.calibration.projection import ProjectionMap, projection_uncertainty, working_distance
from icalib.calibration.relative import RelativePose, joint_covariance, relative_pose, relative_poses
from icalib.calibration.result import (
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
from icalib.calibration.robot import LidarResiduals, Plane, PoseResiduals, WheelResiduals
from icalib.calibration.saving import calibration_files, load_calibration

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
