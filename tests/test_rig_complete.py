"""Rigs made in Python whose sensors cannot be calibrated together are refused as rig files are."""

from __future__ import annotations

import pytest

from icalib.data.measurements import Measurements
from icalib.errors import RigError
from icalib.pipeline import calibrate_measurements
from icalib.rig import ImuNoise, ImuSensor, Lidar, PoseSensor, Rig, Wheels
from icalib.rig.complete import lack_of

IMU = ImuSensor("imu0", "", ImuNoise(1e-4, 1e-5, 1e-3, 1e-4))
LIDAR, WHEELS = Lidar("lidar0", ""), Wheels("wheel0", "", "differential")
MOCAP, ODOMETRY = PoseSensor("mocap0", ""), PoseSensor("odom0", "", "relative")
EMPTY = Measurements(None, ())


@pytest.mark.parametrize(
    ("rig", "sentence"),
    [
        (Rig(IMU, ()), "there is no camera, no LiDAR and no pose sensor"),
        (
            Rig(IMU, (), wheels=(WHEELS,)),
            "wheel0 and imu0 do not determine the motion, and there is no camera",
        ),
        (Rig(None, (), wheels=(WHEELS,)), "there is no camera, no LiDAR and no pose sensor"),
        (Rig(None, (), lidars=(LIDAR,)), "lidar0 needs an IMU"),
        (Rig(None, (), lidars=(LIDAR,), poses=(MOCAP,)), "lidar0 needs an IMU"),
        (Rig(None, (), lidars=(LIDAR,), wheels=(WHEELS,)), "lidar0 needs an IMU"),
        (Rig(None, (), poses=(MOCAP,)), "mocap0 is the only sensor"),
        (Rig(None, (), wheels=(WHEELS,), poses=(ODOMETRY,)), "odom0 without camera and IMU"),
    ],
    ids=lambda value: "" if isinstance(value, Rig) else value,
)
def test_what_cannot_be_calibrated_is_refused(rig: Rig, sentence: str):
    with pytest.raises(RigError, match=sentence):
        calibrate_measurements(rig, EMPTY)


@pytest.mark.parametrize(
    "rig",
    [Rig(IMU, (), lidars=(LIDAR,)), Rig(IMU, (), poses=(ODOMETRY,)), Rig(None, (), wheels=(WHEELS,), poses=(MOCAP,))],
)
def test_what_can_be_calibrated(rig: Rig):
    assert lack_of(rig) is None
