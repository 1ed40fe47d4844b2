"""Keyframes of a motion without an IMU are as far apart as noise hides what they leave out."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from icalib.data.measurements import Measurements, PoseStream, WheelStream
from icalib.geometry import so3
from icalib.initialize.assumed_motion import MIN_KEYFRAME_SPACING_S, keyframe_spacing
from icalib.initialize.initializer import SmoothMotion
from icalib.initialize.smooth_trajectory import smooth_trajectory
from icalib.rig import PoseSensor, Rig, Settings, Wheels, by_name
from icalib.sensors.pose.initialize import pose_noise

TURN, WAY = 2e-3, 1e-3
DENSITIES = (0.05, 0.2)  # rad/s^2/sqrt(Hz), m/s^3/sqrt(Hz)
RADIUS, BASELINE = 0.1, 0.5


def recorded(seconds: float = 20.0) -> Measurements:
    """A circle at 0.5 m/s and 0.4 rad/s that speeds up and slows down, poses at 100 Hz, wheels at 50 Hz."""
    rng, t = np.random.default_rng(0), np.arange(0.0, seconds, 0.01)
    yaw = 0.4 * t + 0.3 * np.sin(t)
    speed = 0.5 + 0.2 * np.cos(t)
    p = np.cumsum(np.stack([speed * np.cos(yaw), speed * np.sin(yaw), 0.0 * t], axis=1), axis=0) * 0.01
    R = so3.exp_many(np.stack([0.0 * t, 0.0 * t, yaw], axis=1)) @ so3.exp_many(rng.normal(0.0, TURN, (len(t), 3)))
    stamps = np.round(1e9 * t).astype(np.int64)
    poses = PoseStream("mocap0", stamps, R, p + rng.normal(0.0, WAY, p.shape))
    turn = (0.4 + 0.3 * np.cos(t)) * BASELINE / 2.0
    rate = np.stack([speed - turn, speed + turn], axis=1) / RADIUS
    return Measurements.of_streams(WheelStream("wheel0", stamps[::2], rate[::2]), poses)


def spacing(noise: float | None, densities=DENSITIES, **settings: Any) -> float:
    m = recorded()
    s = m.poses[0]
    path = smooth_trajectory(s.seconds, s.rotation, s.position, np.arange(0.0, s.seconds[-1], 0.01))
    rig = Rig(by_name(PoseSensor("mocap0", "")), settings=Settings(**settings))
    if noise is not None:
        rig = rig.with_(wheels=(Wheels("wheel0", "", wheel_noise=noise),))
    return keyframe_spacing(rig, [m], SmoothMotion([path], *densities))


def test_the_noise_of_poses_is_their_scatter_about_a_smooth_path():
    turn, way = pose_noise([recorded().poses[0]])
    assert turn == pytest.approx(TURN, rel=0.15)
    assert way == pytest.approx(WAY, rel=0.15)


def test_poses_alone_limit_the_spacing_by_what_motion_does_in_half_of_it():
    """Solved again by trying: the largest spacing whose neglected motion is a quarter of the noise."""
    turn, way = pose_noise([recorded().poses[0]])
    tried = np.arange(0.02, 1.0, 1e-4)
    half = 0.5 * tried
    hidden = (DENSITIES[0] * np.sqrt(half**3 / 3.0) < 0.25 * turn) & (
        DENSITIES[1] * np.sqrt(half**5 / 20.0) < 0.25 * way
    )
    assert spacing(None, keyframe_spacing_s=2.0) == pytest.approx(tried[hidden][-1], abs=2e-4)
    assert spacing(None) == 0.05  # what the rig file allows


def test_good_encoders_ask_for_closer_keyframes():
    noise, densities = 0.1, (0.3, 0.2)
    yaw = noise * np.sqrt(2.0) * RADIUS / BASELINE
    assert spacing(noise, densities, keyframe_spacing_s=2.0) == pytest.approx(np.sqrt(3.0) * 0.25 * yaw / 0.3, rel=0.05)
    assert spacing(0.1 * noise, densities) == MIN_KEYFRAME_SPACING_S
