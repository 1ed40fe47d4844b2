"""The rig: definitions of its sensors, their parameters, the target and the settings of the estimator."""

from icalib.rig.rig import Loss, Rig, Scheme, Settings, by_name
from icalib.sensors.camera.spec import LENS, TRACK_IMAGES, Camera
from icalib.sensors.imu.spec import (
    BY_CLASS,
    UNFILTERED,
    AccelUnit,
    GyroUnit,
    ImuNoise,
    ImuSensor,
    TwoSources,
    prior_words,
)
from icalib.sensors.lidar.spec import Lidar, PointTime
from icalib.sensors.parameter import Parameter, ParameterSpec
from icalib.sensors.pose.spec import PoseKind, PoseSensor
from icalib.sensors.sensor import PLAIN_TABLE, Axes, Sensor, TableLayout, TimeUnit
from icalib.sensors.wheels.spec import (
    DRIVES,
    RATE_UNITS,
    Ground,
    GroundPlane,
    RateUnit,
    WheelDrive,
    WheelFactor,
    WheelKind,
    WheelMeasure,
    Wheels,
    drive_names,
)

__all__ = [
    "AccelUnit",
    "Axes",
    "BY_CLASS",
    "UNFILTERED",
    "Camera",
    "DRIVES",
    "Ground",
    "GroundPlane",
    "GyroUnit",
    "ImuNoise",
    "ImuSensor",
    "LENS",
    "Lidar",
    "Loss",
    "PLAIN_TABLE",
    "Parameter",
    "ParameterSpec",
    "PointTime",
    "PoseKind",
    "PoseSensor",
    "RATE_UNITS",
    "RateUnit",
    "Rig",
    "Scheme",
    "Sensor",
    "Settings",
    "TRACK_IMAGES",
    "TableLayout",
    "TimeUnit",
    "TwoSources",
    "WheelDrive",
    "WheelFactor",
    "WheelKind",
    "WheelMeasure",
    "Wheels",
    "drive_names",
    "prior_words",
    "by_name",
]
