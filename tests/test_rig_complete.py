"""Rigs made in Python whose sensors cannot be calibrated together are refused as rig files are."""

from __future__ import annotations

import pytest

from icalib.data.measurements import Measurements
from icalib.errors import RigError
from icalib.pipeline import calibrate_measurements
from icalib.rig import ImuNoise, ImuSensor, Lidar, PoseSensor, Rig, Wheels, by_name
from icalib.rig.complete import lack_of

IMU = ImuSensor("imu0", "", ImuNoise(1e-4, 1e-5, 1e-3, 1e-4))
LIDAR, WHEELS = Lidar("lidar0", ""), Wheels("wheel0", "", "differential")
MOCAP, ODOMETRY = PoseSensor("mocap0", ""), PoseSensor("odom0", "", "relative")
EMPTY = Measurements(None, ())


@pytest.mark.parametrize(
    ("rig", "sentence"),
    [
        (Rig(by_name(IMU)), "there is no camera, no LiDAR and no pose sensor"),
        (
            Rig(by_name(IMU, WHEELS)),
            "wheel0 and imu0 do not determine the motion, and there is no camera",
        ),
        (Rig(by_name(WHEELS)), "there is no camera, no LiDAR and no pose sensor"),
        (Rig(by_name(LIDAR)), "lidar0 needs an IMU"),
        (Rig(by_name(LIDAR, MOCAP)), "lidar0 needs an IMU"),
        (Rig(by_name(LIDAR, WHEELS)), "lidar0 needs an IMU"),
        (Rig(by_name(MOCAP)), "mocap0 is the only sensor"),
        (Rig(by_name(WHEELS, ODOMETRY)), "odom0 without camera and IMU"),
    ],
    ids=lambda value: "" if isinstance(value, Rig) else value,
)
def test_what_cannot_be_calibrated_is_refused(rig: Rig, sentence: str):
    with pytest.raises(RigError, match=sentence):
        calibrate_measurements(rig, EMPTY)


@pytest.mark.parametrize(
    "rig",
    [Rig(by_name(IMU, LIDAR)), Rig(by_name(IMU, ODOMETRY)), Rig(by_name(WHEELS, MOCAP))],
)
def test_what_can_be_calibrated(rig: Rig):
    assert lack_of(rig) is None
