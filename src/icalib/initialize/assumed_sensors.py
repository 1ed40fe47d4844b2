"""Sensors that stand for an assumption: an IMU for smooth motion, and a pose sensor for dead reckoning."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from icalib.data.measurements import ImuStream, Measurements, PoseStream
from icalib.initialize.steps.smooth_trajectory import BodyPoses, SmoothTrajectory
from icalib.rig import ImuNoise, ImuSensor, Parameter, PoseSensor

# Names of the assumed IMU, and of the pose sensor that stands for motion without the IMU. No sensor has a space in it.
ASSUMED_IMU, ASSUMED_POSES = "assumed motion", "assumed poses"
# s: ratio of the assumed IMU's white noise density to its random walk density; keeps covariances regular
REGULARISING_STEP_S = 5e-3


def assumed_imu(turning: float, jerking: float) -> ImuSensor:
    """The IMU that stands for smooth motion. turning, jerking: densities of the motion's angular acceleration
    [rad/s^2/sqrt(Hz)] and jerk [m/s^3/sqrt(Hz)]."""
    noise = ImuNoise(REGULARISING_STEP_S * turning, turning, REGULARISING_STEP_S * jerking, jerking, ASSUMED_IMU)
    return ImuSensor(ASSUMED_IMU, "", noise, Parameter("fixed"), assumed=True)


def with_assumed_readings(
    recordings: Sequence[Measurements], paths: Sequence[SmoothTrajectory], max_gap_s: float | None = None
) -> list[Measurements]:
    """The recordings with readings of the assumed IMU. With `max_gap_s`: zeros, except in gaps between poses that are
    longer [s]. Without: ideal readings at the instants with poses nearby."""
    out = []
    for m, path in zip(recordings, paths, strict=True):
        stamps = m.origin_ns + np.round(path.seconds * 1e9).astype(np.int64)
        used = path.near.copy() if max_gap_s is None else _within_short_gaps(path, max_gap_s)
        used[:1] = True  # its clock begins where the body's does
        gyro, accel = (x[used] * float(max_gap_s is None) for x in (path.rate, path.acceleration))
        out.append(m.with_streams(ImuStream(ASSUMED_IMU, stamps[used], gyro, accel)))
    return out


def _within_short_gaps(path: SmoothTrajectory, max_gap_s: float) -> np.ndarray:
    """(m,) whether poses are nearby, or the gap between poses is at most `max_gap_s`. Over longer gaps the assumption
    does not constrain the motion."""
    pose_s = path.seconds[path.near]
    if not len(pose_s):
        return np.zeros(len(path.seconds), dtype=bool)
    after, ends = np.searchsorted(pose_s, path.seconds), np.concatenate([[-np.inf], pose_s, [np.inf]])
    previous_s, next_s = ends[after], ends[after + 1]
    return path.near | (next_s - previous_s <= max_gap_s)


def pose_sensor_for(odometry: str) -> PoseSensor:
    """The pose sensor that stands for the sensor `odometry`."""
    return PoseSensor(odometry, "", "absolute")


def pose_streams(recordings: Sequence[Measurements], odometry: str, paths: Sequence[BodyPoses]) -> list[PoseStream]:
    """The trajectories `paths` of `odometry`, one for each recording, as measurements of a pose sensor."""
    stamps = [m.streams[odometry].stamps_ns for m in recordings]
    return [PoseStream(odometry, t, p.rotation, p.position) for t, p in zip(stamps, paths, strict=True)]
