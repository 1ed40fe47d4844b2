"""LiDARs from nothing: simulated robots that move freely, over ramps and on a floor, and what cannot be found."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from tests.cases import each
from tests.typed import not_none, random_rotations

from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.initializer import KnownExtrinsics
from icalib.sensors.lidar.initialize.extrinsics import lidar_and_motion, lidar_on_motion

pytestmark = pytest.mark.slow

KEYFRAME_S = 0.05


def within(robot, found, degrees, metres, seconds, k=0, but=None):
    """Whether the guess is as good as this; but (3,): a direction in the IMU in which its position is open."""
    turn, way, offset = robot.errors(found, k)
    if but is not None:
        way = way - but * (but @ way)
    print(np.linalg.norm(turn), np.linalg.norm(way), offset)
    return np.linalg.norm(turn) < degrees and np.linalg.norm(way) < metres and abs(offset) < seconds


def same_world(motion, robot, t):
    """(n,) turn [rad] and way [m] between the motion found and the truth, their worlds' yaw and origin made alike."""
    R, p, v = motion.at(t)
    R_true, p_true, v_true = robot.pose_at(t)
    M = (R @ R_true.transpose(0, 2, 1)).mean(axis=0)
    Q = so3.exp(np.array([0.0, 0.0, np.arctan2(M[1, 0] - M[0, 1], M[0, 0] + M[1, 1])]))
    way = p - p_true @ Q.T
    turn = so3.log_many(np.ascontiguousarray((Q @ R_true).transpose(0, 2, 1) @ R))
    speed = np.linalg.norm(v - v_true @ Q.T, axis=1)
    return np.linalg.norm(turn, axis=1), np.linalg.norm(way - way.mean(axis=0), axis=1), speed


def test_lidar_and_imu_alone(free_robot):
    found, motion = lidar_and_motion(free_robot.imu, free_robot.streams[0], 9.81)
    assert within(free_robot, found, 0.3, 0.03, 5e-4)
    turn, way, speed = same_world(motion, free_robot, np.linspace(0.2, 15.5, 300))
    assert turn.max() < 5e-3 and way.max() < 0.03 and np.sqrt((speed**2).mean()) < 0.02
    np.testing.assert_allclose(motion.accel_bias, free_robot.sim.truth.accel_bias.mean(axis=0), atol=0.2)
    np.testing.assert_allclose(motion.gyro_bias, free_robot.sim.truth.gyro_bias.mean(axis=0), atol=1e-3)


def test_a_lidar_on_a_motion_that_is_known(free_robot):
    known = free_robot.state(np.arange(0.0, free_robot.imu.seconds[-1], KEYFRAME_S))
    found = lidar_on_motion(free_robot.imu, free_robot.streams[0], known)
    assert within(free_robot, found, 0.2, 0.02, 5e-4)


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.full)])
def test_any_orientation_and_clocks_far_apart(robot, seed):
    T = np.eye(4)
    T[:3, :3] = random_rotations(None, seed=seed).as_matrix()
    T[:3, 3] = np.random.default_rng(seed).uniform(-0.3, 0.3, 3)
    r = robot(16.0, 3, {"T_imu_sensor": T, "time_offset_s": 0.7 - seed, "clock_origin_ns": 5 * 10**18})
    assert within(r, lidar_and_motion(r.imu, r.streams[0], 9.81)[0], 2.0, 0.15, 5e-3)
    known = r.state(np.arange(0.0, r.imu.seconds[-1], KEYFRAME_S))
    assert within(r, lidar_on_motion(r.imu, r.streams[0], known), 2.0, 0.15, 5e-3)


@each("lidar", [{"rate_hz": 5.0}, {"range_m": (0.5, 5.0)}], full=[{"rate_hz": 20.0, "azimuth_steps": 400}])
def test_other_lidars(robot, lidar):
    r = robot(16.0, 2, lidar)
    assert within(r, lidar_and_motion(r.imu, r.streams[0], 9.81)[0], 0.5, 0.05, 1e-3)


def test_on_ramps(robot):
    r = robot(20.0, 4, example="table2-ramp")
    assert within(r, lidar_and_motion(r.imu, r.streams[0], 9.81)[0], 0.5, 0.05, 1e-3)


def test_on_a_floor_the_turn_about_its_axis_comes_from_accelerations(robot):
    r = robot(20.0, 5, example="table2-planar")
    up = r.state(np.zeros(1)).rotation[0, 2]
    assert within(r, lidar_and_motion(r.imu, r.streams[0], 9.81)[0], 1.0, 0.05, 1e-3, but=up)


@each(("seconds", "seed"), [(8.0, 96), (12.0, 6), (12.0, 19)])
def test_a_long_turn_to_one_side_shows_the_clocks(robot, seconds, seed):
    """About its median such a turn is another motion, which goes best with the LiDAR's seconds away or nowhere."""
    r = robot(seconds, seed, {"azimuth_steps": 300}, example="table2-planar")
    held = KnownExtrinsics(r.truth().rotation, r.truth().position)
    found = lidar_and_motion(r.imu, r.streams[0], 9.81, held)[0]
    assert abs(found.offset - r.truth().offset) < 5e-3


@each("seed", [5, 11], full=[6, 12])
def test_on_a_floor_the_turn_about_its_axis_comes_from_the_known_motion(robot, seed):
    """Which way that motion is for the LiDAR must not be taken from the turn that is looked for."""
    r = robot(20.0, seed, example="table2-planar")
    known, up = r.state(np.arange(0.0, r.imu.seconds[-1], KEYFRAME_S)), r.state(np.zeros(1)).rotation[0, 2]
    assert within(r, lidar_on_motion(r.imu, r.streams[0], known), 0.1, 0.005, 1e-3, but=up)


def test_what_is_held_stays(free_robot):
    true = free_robot.truth()
    held = KnownExtrinsics(true.rotation, true.position + [0.1, 0.0, 0.0], true.offset + 1e-3)
    known = free_robot.state(np.arange(0.0, free_robot.imu.seconds[-1], KEYFRAME_S))
    for found in (
        lidar_and_motion(free_robot.imu, free_robot.streams[0], 9.81, held)[0],
        lidar_on_motion(free_robot.imu, free_robot.streams[0], known, held),
    ):
        np.testing.assert_allclose(found.rotation, not_none(held.rotation), atol=1e-6)
        np.testing.assert_allclose(found.position, not_none(held.position), atol=1e-4)
        assert found.offset == held.offset
    rotation = KnownExtrinsics(rotation=true.rotation)
    assert within(
        free_robot, lidar_and_motion(free_robot.imu, free_robot.streams[0], 9.81, rotation)[0], 1e-4, 0.03, 1e-3
    )


def changed(stream, xyz, keep: Any = slice(None)):
    """The stream with other points, of which `keep` (N,) bool stay."""
    scan = np.repeat(np.arange(len(stream.stamps_ns)), np.diff(stream.start))[keep]
    start = np.searchsorted(scan, np.arange(len(stream.stamps_ns) + 1))
    return replace(stream, start=start, offset_s=stream.offset_s[keep], xyz=xyz[keep], plane=stream.plane[keep])


def refused(robot, stream, imu=None):
    with pytest.raises(EstimationError) as error:
        lidar_and_motion(imu or robot.imu, stream, 9.81)
    sentence = str(error.value)
    assert "\n" not in sentence and sentence.endswith(".")
    return sentence


def test_leaves_all_around_are_no_surfaces(free_robot):
    stream = free_robot.streams[0]
    anywhere = np.random.default_rng(0).uniform(-20.0, 20.0, stream.xyz.shape).astype(np.float32)
    assert "flat surfaces" in refused(free_robot, changed(stream, anywhere))


def test_too_few_scans_are_refused(free_robot):
    stream = free_robot.streams[0]
    few = np.arange(len(stream.xyz)) < stream.start[15]
    assert "15 of 127 usable scans" in refused(free_robot, changed(stream, stream.xyz, few))


def test_an_imu_of_another_recording_is_refused(robot, free_robot):
    other = robot(16.0, 8)
    assert "does not match" in refused(free_robot, free_robot.streams[0], other.imu)


def test_no_turning_is_refused(robot):
    r = robot(10.0, 1, example="straight-line")
    assert "hardly turn" in refused(r, r.streams[0])


def test_an_accelerometer_in_g_is_refused(free_robot):
    imu = replace(free_robot.imu, accel=free_robot.imu.accel / 9.81)
    assert "not in g" in refused(free_robot, free_robot.streams[0], imu)


def test_points_that_are_nothing_change_nothing_much(free_robot):
    """Zeros, NaN, returns of the robot itself, and scans that were lost."""
    stream, rng = free_robot.streams[0], np.random.default_rng(0)
    xyz, draw = stream.xyz.copy(), rng.random(len(stream.xyz))
    xyz[draw < 0.05], xyz[(draw > 0.05) & (draw < 0.1)] = 0.0, np.nan
    own = (draw > 0.1) & (draw < 0.2)
    xyz[own] = [0.6, 0.1, -0.3] + rng.normal(size=(own.sum(), 3)) * 0.02
    lost = np.ones(len(xyz), dtype=bool)
    lost[stream.start[40] : stream.start[44]] = False
    found, _ = lidar_and_motion(free_robot.imu, changed(stream, xyz, lost), 9.81)
    assert within(free_robot, found, 0.5, 0.05, 1e-3)


def test_one_wall_does_not_crash(free_robot):
    """Held where nothing shows it: what one wall leaves open is for the observability stage to say."""
    stream, true = free_robot.streams[0], free_robot.truth()
    largest = np.bincount(stream.plane[stream.plane >= 0]).argmax()
    wall = changed(stream, stream.xyz, stream.plane == largest)
    known = free_robot.state(np.arange(0.0, free_robot.imu.seconds[-1], KEYFRAME_S))
    held = KnownExtrinsics(true.rotation, true.position, true.offset)
    try:
        found = lidar_on_motion(free_robot.imu, wall, known, held)
    except EstimationError as error:
        assert str(error).endswith(".")
    else:
        assert within(free_robot, found, 1e-3, 1e-3, 1e-9)


@pytest.mark.full
@pytest.mark.parametrize("example", ["table2-3d", "table2-ramp"])
def test_many_recordings(robot, example):
    for seed in range(20):
        r = robot(40.0, seed, example=example)
        assert within(r, lidar_and_motion(r.imu, r.streams[0], 9.81)[0], 0.5, 0.05, 1e-3)
