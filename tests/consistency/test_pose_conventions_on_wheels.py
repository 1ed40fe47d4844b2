"""Poses written another way, without an IMU: a vehicle would slip sideways, and the way that wheels fit is named."""

from __future__ import annotations

import pytest
from tests.consistency.recordings import without_imu
from tests.consistency.test_level_frame import level
from tests.sensors.pose.test_pose_conventions import conjugated, inverted, w_first, y_up

from icalib.errors import EstimationError
from icalib.initialize.assumed_motion import guess_with_assumed_motion

WRONG = [
    (inverted, "the poses of mocap0 are inverted"),
    (conjugated, "the poses of mocap0 have inverted rotations"),
    (w_first, "the poses of mocap0 have quaternions with w first"),
    (y_up, "mocap0 have positions and rotations in different frames.*set its position_axes to .x, z, -y."),
]


@pytest.fixture(scope="module", params=["planar", pytest.param("ramp", marks=pytest.mark.full)])
def recorded(request, robot):
    return without_imu(robot(request.param, 12.0, "w").with_sensors(level()))


@pytest.mark.parametrize(
    ("way", "words"), [pytest.param(*x, marks=() if x[0] is inverted else pytest.mark.full) for x in WRONG]
)
def test_the_way_that_wheels_fit_is_named(recorded, way, words):
    rig, measurements, _ = recorded
    written = measurements.with_streams(*(way(x) for x in measurements.poses))
    with pytest.raises(EstimationError, match=words):
        guess_with_assumed_motion(rig, [written])


def test_poses_as_they_should_be(recorded):
    rig, measurements, _ = recorded
    guess_with_assumed_motion(rig, [measurements])
