"""All types of sensors, and all definitions of parameters."""

from __future__ import annotations

from icalib.rig.camera import Camera
from icalib.rig.imu import ImuSensor
from icalib.rig.lidar import Lidar
from icalib.rig.pose import PoseSensor
from icalib.rig.scene import SCENE
from icalib.rig.sensor import Sensor
from icalib.rig.wheels import Wheels

MOUNTED_TYPES: tuple[type[Sensor], ...] = (Camera, Lidar, Wheels, PoseSensor)  # those with a pose on the body
SENSOR_TYPES: dict[str, type[Sensor]] = {t.sensor_type: t for t in (ImuSensor, *MOUNTED_TYPES)}
# By name: the parameters of sensors on the body and of the scene. The IMU is the body; its intrinsics are not here.
SPECS = {spec.name: spec for own in (*(t.parameters for t in MOUNTED_TYPES), SCENE) for spec in own}
# Of groups with a plural name, the name of one number: radius of radii.
ONE = {spec.name: spec.one for spec in SPECS.values() if spec.one}
