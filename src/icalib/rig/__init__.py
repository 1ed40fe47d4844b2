"""What is calibrated: sensors and their parameters, target, settings."""

from icalib.rig.camera import (
    LENS,
    TRACK_IMAGES,
    Camera,
)
from icalib.rig.imu import (
    BY_CLASS,
    AccelUnit,
    GyroUnit,
    ImuSensor,
    TwoSources,
)
from icalib.rig.imu_classes import (
    ImuNoise,
)
from icalib.rig.lidar import (
    Lidar,
    PointTime,
)
from icalib.rig.parameter import (
    Parameter,
)
from icalib.rig.parameter_spec import (
    ParameterSpec,
)
from icalib.rig.pose import (
    PoseKind,
    PoseSensor,
)
from icalib.rig.rig import (
    Rig,
    by_name,
)
from icalib.rig.sensor import (
    PLAIN_TABLE,
    Axes,
    Sensor,
    TableLayout,
    TimeUnit,
)
from icalib.rig.settings import (
    Loss,
    Scheme,
    Settings,
)
from icalib.rig.wheels import (
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
    "by_name",
]
