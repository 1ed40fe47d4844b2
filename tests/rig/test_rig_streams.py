"""Measurements in memory that are not those of the rig are refused by name, before anything is estimated from them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import (
    CornerStream,
    ImuStream,
    LidarStream,
    Measurements,
    PoseStream,
    TrackStream,
    WheelStream,
    streams_of_rig,
)
from icalib.errors import RecordingError
from icalib.pipeline import calibrate_measurements
from icalib.rig import ImuNoise, ImuSensor, Lidar, PoseSensor, Rig, Wheels, by_name
from icalib.sensors.position.spec import PositionSensor
from icalib.sensors.position.stream import PositionStream

STAMPS, NONE = np.arange(3), np.zeros(4, np.int64)
IMU = ImuStream("imu0", STAMPS, np.zeros((3, 3)), np.zeros((3, 3)))


def lidar(name: str) -> LidarStream:
    nothing = np.empty(0, np.float32)
    return LidarStream(name, STAMPS, NONE, nothing, np.empty((0, 3), np.float32), np.empty(0, np.int32))


RIG = Rig(
    by_name(
        ImuSensor("imu0", "", ImuNoise(1e-4, 1e-5, 1e-3, 1e-4)),
        Lidar("front", ""),
        Lidar("rear", ""),
        Wheels("w", ""),
        PoseSensor("mocap", ""),
    )
)
WHOLE = Measurements.of_streams(
    IMU,
    lidar("rear"),
    lidar("front"),
    WheelStream("w", STAMPS, np.zeros((3, 2))),
    PoseStream("mocap", STAMPS, np.zeros((3, 3, 3)), np.zeros((3, 3))),
    name="drive",
)
TRACKS = TrackStream("cam7", STAMPS, NONE, np.empty(0, np.int64), np.empty((0, 2)))


def test_streams_come_in_the_order_of_the_rig():
    found = streams_of_rig(RIG, WHOLE)
    assert [s.name for s in found.lidars] == ["front", "rear"]
    assert (found.imu, found.wheels, found.poses) == (WHOLE.imu, WHOLE.wheels, WHOLE.poses)


@each(
    ("rig", "measured", "words"),
    [
        (RIG, WHOLE.without("imu0"), "drive has no data of imu0"),
        (RIG, WHOLE.with_streams(replace(IMU, name="imu1")), "a stream called imu1, but the rig has imu0 of its kind"),
        (
            RIG.only("w", "mocap"),
            WHOLE.without("front", "rear"),
            "a stream called imu0, but the rig has none of its kind",
        ),
        (RIG, WHOLE.only("imu0", "front", "w", "mocap"), "drive has no data of rear"),
        (RIG, WHOLE.without("w", "mocap"), "drive has no data of w and mocap"),
        (RIG, WHOLE.with_streams(lidar("roof")), "a stream called roof, but the rig has front and rear"),
        (RIG, WHOLE.with_streams(TRACKS), "a stream called cam7, but the rig has none of its kind"),
    ],
)
def test_others_are_refused_by_name(rig: Rig, measured: Measurements, words: str):
    with pytest.raises(RecordingError, match=words):
        calibrate_measurements(rig, measured)


def test_a_sensor_has_one_stream_of_a_kind_but_a_camera_corners_and_tracks():
    corners = CornerStream("cam7", STAMPS, NONE, np.empty(0, np.int64), np.empty((0, 2)))
    assert [*Measurements.of_streams(corners, TRACKS).streams] == ["cam7", "cam7/tracks"]
    with pytest.raises(RecordingError, match="drive has two streams of front; give one"):
        Measurements.of_streams(lidar("front"), lidar("rear"), lidar("front"), name="drive")


@each("far", [[465_875.0, 5_248_232.0, 413.0], [-7e6, 0.0, 0.0], [0.0, 50.0, 0.0]])
def test_positions_far_from_their_origin_get_a_near_one_with_all_sensors_of_the_frame(far):
    """No digit is lost: the new origin and a new position add up to the old one exactly."""
    position = far + np.random.default_rng(0).normal(size=(9, 3))
    poses = PoseStream("mocap", np.arange(9), np.zeros((9, 3, 3)), position)
    marker, other = (PositionStream(name, np.arange(9), position, np.zeros((0, 3, 3))) for name in ("marker", "gnss"))
    sensors = PoseSensor("mocap", ""), PositionSensor("marker", "", frame="mocap"), PositionSensor("gnss", "")
    m = streams_of_rig(Rig(by_name(*sensors)), Measurements.of_streams(poses, marker, other))
    assert m.streams["gnss"] is other
    if np.linalg.norm(far) < 100.0:
        assert m.streams["mocap"] is poses and m.streams["marker"] is marker and m.notes == ()
        return
    origin = np.round(np.median(position, axis=0))
    for stream, note in zip(m.of(PoseStream) + m.of(PositionStream)[:1], m.notes, strict=True):
        np.testing.assert_array_equal(stream.position + origin, position)
        assert np.abs(stream.position).max() < 5.0
        assert f"{stream.name}: " in note and f"({origin[0]:.0f}, {origin[1]:.0f}, {origin[2]:.0f}) m" in note
