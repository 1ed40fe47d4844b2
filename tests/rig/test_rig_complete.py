"""Rigs made in Python whose sensors cannot be calibrated together are refused as rig files are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import Measurements
from icalib.errors import RigError
from icalib.geometry.targets import Checkerboard
from icalib.pipeline import calibrate_measurements
from icalib.rig import Camera, Ground, ImuNoise, ImuSensor, Lidar, Parameter, PoseSensor, Rig, Settings, Wheels, by_name
from icalib.rig.file import check_complete, lack_of, rig_from_dict, rig_to_dict
from icalib.sensors.position.spec import PositionSensor

GNSS = PositionSensor("gnss0", "")
IMU = ImuSensor("imu0", "", ImuNoise(1e-4, 1e-5, 1e-3, 1e-4))
LIDAR, WHEELS = Lidar("lidar0", ""), Wheels("wheel0", "", "differential")
MOCAP, ODOMETRY = PoseSensor("mocap0", ""), PoseSensor("odom0", "", "relative")
FOLLOWER = Camera("cam0", "", "eucm", (9, 9), tracks="images")
EMPTY = Measurements.of_streams()


@each(
    ("rig", "sentence"),
    [
        (Rig(by_name(IMU)), "there is no camera, no LiDAR, no pose sensor and no position sensor"),
        (
            Rig(by_name(IMU, WHEELS)),
            "wheel0 and imu0 do not determine the motion, and there is no camera",
        ),
        (Rig(by_name(WHEELS)), "there is no camera, no LiDAR, no pose sensor and no position sensor"),
        (Rig(by_name(LIDAR)), "lidar0 is the only sensor"),
        (Rig(by_name(MOCAP)), "mocap0 is the only sensor"),
        (Rig(by_name(GNSS)), "gnss0 positions do not determine rotations; add an IMU, a camera that sees a target"),
        (
            Rig(by_name(GNSS, WHEELS)),
            "gnss0 positions and wheel0 do not determine roll and pitch; if the floor",
        ),
        (Rig(by_name(GNSS, ODOMETRY)), "odom0 without an IMU, a LiDAR, or a camera that sees a target"),
        (Rig(by_name(WHEELS, ODOMETRY)), "odom0 without an IMU, a LiDAR, or a camera that sees a target"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(rig: Rig, sentence: str):
    with pytest.raises(RigError, match=sentence):
        calibrate_measurements(rig, EMPTY)


def test_a_camera_that_sees_a_target_stands_in_for_absolute_poses():
    rig = Rig(by_name(Camera("cam0", "", "eucm", (9, 9)), ODOMETRY), Checkerboard(6, 7, 0.1))
    assert lack_of(rig) is None and rig.reference == "cam0"
    assert rig_from_dict(rig_to_dict(rig), "rig.yaml").reference == "cam0"


@each(
    ("rig", "words"),
    [
        (
            Rig(by_name(replace(IMU, time_offset=Parameter("fixed", np.zeros(1))), LIDAR)),
            "^imu0.time_offset: imu0 is the body",
        ),
        (Rig(by_name(IMU, Camera("cam0", "", "eucm", (9, 9)))), "^target is missing; .* of cam0"),
        (Rig(by_name(IMU, MOCAP, Wheels("w", "", ground=Ground("floor", 0.1)))), "^w.ground.plane: a LiDAR determines"),
        (
            Rig(by_name(IMU, LIDAR), body="lidar"),
            "^there is no sensor lidar, did you mean 'lidar0'; available",
        ),
        (Rig(by_name(IMU, LIDAR), settings=Settings(points_on_planes_m=0.1)), "^points_on_planes_m needs a LiDAR"),
    ],
)
def test_rigs_made_in_python_are_checked_as_rig_files_are(rig: Rig, words: str):
    with pytest.raises(RigError, match=words):
        check_complete(rig)


@each(
    ("rig", "body"),
    [
        (Rig(by_name(LIDAR, MOCAP)), "lidar0"),
        (Rig(by_name(LIDAR, ODOMETRY)), "lidar0"),
        (Rig(by_name(WHEELS, GNSS, LIDAR)), "lidar0"),
        (Rig(by_name(LIDAR, FOLLOWER)), "lidar0"),
        (Rig(by_name(LIDAR, FOLLOWER), Checkerboard(6, 7, 0.1)), "cam0"),
    ],
)
def test_a_lidar_is_the_body_unless_a_camera_sees_a_target(rig: Rig, body: str):
    assert lack_of(rig) is None and rig.reference == body


@each(
    "rig",
    [Rig(by_name(IMU, LIDAR)), Rig(by_name(IMU, ODOMETRY)), Rig(by_name(WHEELS, MOCAP)), Rig(by_name(GNSS, MOCAP))],
)
def test_what_can_be_calibrated(rig: Rig):
    assert lack_of(rig) is None
