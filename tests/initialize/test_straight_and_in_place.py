"""Vehicles that drive straight most of the time, or turn in place, contradict no sensor."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from icalib.data.measurements import ImuStream
from icalib.initialize.rate_alignment import align_rates
from icalib.initialize.rate_correlation import SensorRates
from icalib.initialize.trajectories import system_from_trajectory, unexplained_displacement
from icalib.motion.imu_data import ImuData
from icalib.sensors.imu.spec import class_noise


def test_the_heading_of_two_antennas_on_a_straight_drive():
    """Three turns of 2 s in 60 s. Between them the rates of the heading are noise."""
    seconds = np.arange(0.0, 60.0, 0.01)

    def yaw_rate(t: np.ndarray) -> np.ndarray:
        turns = [a * np.exp(-(((t - c) / 0.8) ** 2)) for a, c in ((1.3, 12.0), (-1.2, 31.0), (1.1, 52.0))]
        return np.sum(turns, axis=0)

    rng = np.random.default_rng(0)
    gyro = np.outer(yaw_rate(seconds), [0.0, 0.0, 1.0]) + 1e-3 * rng.normal(size=(len(seconds), 3))
    accel = np.tile([0.0, 0.0, 9.81], (len(seconds), 1))
    imu = ImuData.build(
        ImuStream("imu0", np.round(1e9 * seconds).astype(np.int64), gyro, accel), class_noise("industrial")
    )
    t = np.arange(0.1, 59.0, 0.1)
    heading_noise = np.diff(np.radians(0.23) * rng.normal(size=len(t) + 1)) / 0.1
    rate = np.outer(yaw_rate(t + 0.05) + heading_noise, [0.0, 0.0, 1.0])
    start = t - 0.07  # its clock is 70 ms behind
    alignment = align_rates(imu, "ins", SensorRates(start, start + 0.1, rate), None)
    assert alignment.offset == pytest.approx(0.07, abs=0.02)


def test_inverted_poses_of_a_turn_in_place_explain_nothing():
    """The inverse of a pose far from the origin moves in a circle about it, which a lever arm explains."""
    t = np.arange(0.0, 20.0, 0.05)
    R = Rotation.from_rotvec(np.outer(1.5 * np.sin(0.5 * t), [0.0, 0.0, 1.0])).as_matrix()
    noise = 2e-3 * np.random.default_rng(1).normal(size=(len(t), 3))
    position, arm = np.array([3.0, 2.0, 0.0]) + noise, np.array([0.02, 0.0, 0.0])
    inverse = R.transpose(0, 2, 1), -np.einsum("nji,nj->ni", R, position)
    shares = []
    for turned, moved in ((R, position), inverse):
        system = system_from_trajectory(turned, turned @ arm, t, turned, moved)
        A, b, _ = system(np.eye(3), np.zeros(3))
        p = np.linalg.lstsq(A[:, :, 3:].reshape(-1, 3), b.ravel(), rcond=None)[0]
        shares.append(unexplained_displacement(system, np.eye(3), np.concatenate([np.zeros(3), p])))
    assert shares[1] > 0.5 * shares[0]
