"""Rotations carried by the gyroscope: on a common grid of stamps, rounding decides nothing."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.geometry import so3
from icalib.initialize.rate_correlation import GyroRotation
from icalib.motion.imu_data import ImuData
from icalib.motion.poses import assign_keyframes

OFFSET_S = 0.0299  # between the clocks


@pytest.fixture
def gyro() -> GyroRotation:
    """Readings at 200 Hz of a rig that turns steadily."""
    t = np.arange(0.0, 4.0, 0.005)
    rate = np.tile([0.3, -0.2, 0.5], (len(t), 1))
    imu = ImuData("imu0", t, rate, 0.0 * rate, np.ones((len(t) - 1, 3)), np.ones(2), ())
    return GyroRotation.integrate(imu, np.zeros(3))


@each("offset", [0.0, OFFSET_S])
@each("method", ["carry", "smoothed"])
def test_rounding_of_stamps_moves_nothing(gyro: GyroRotation, method: str, offset: float):
    """Poses at 20 Hz with noise: readings lie halfway between two, and poses at the ends of a window."""
    rng, t = np.random.default_rng(0), offset + np.arange(0.5, 3.5, 0.05)
    poses = gyro.at(t) @ so3.exp_many(1e-2 * rng.standard_normal((len(t), 3)))

    def at(times: np.ndarray) -> np.ndarray:
        if method == "smoothed":
            return gyro.smoothed(times, poses)
        return gyro.carry(times, poses, offset + np.arange(0.6, 3.3, 0.005))

    rounded = t * (1.0 + 2e-15 * rng.choice((-1.0, 1.0), len(t)))
    np.testing.assert_allclose(at(rounded), at(t), atol=1e-9)


@each("scheme", ["inertial", "pose"])
@each("share", [0.5, 1.0])
def test_rounding_assigns_no_other_keyframe(scheme, share: float):
    """Instants halfway between two keyframes, and at keyframes."""
    keyframes = np.arange(0.0, 3.0, 0.05) + OFFSET_S
    times = keyframes[:-2] + share * 0.05
    noise = 2e-15 * np.random.default_rng(0).choice((-1.0, 1.0), len(times))
    found = assign_keyframes(scheme, keyframes, times + noise)
    np.testing.assert_array_equal(found, np.arange(len(times)) + int(share))
