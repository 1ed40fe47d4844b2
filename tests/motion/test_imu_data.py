"""How far the gyroscope's noise turns what its readings carry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.data.measurements import ImuStream
from icalib.motion.imu_data import MIN_GAP_PERIODS, ImuData
from icalib.rig import ImuNoise

DENSITY = 1e-3  # rad/s/sqrt(Hz)
NOISE = ImuNoise(DENSITY, 1e-2, 1e-5, 1e-4)


def stream(stamps_ns):
    n = len(stamps_ns)
    still = np.tile([0.0, 0.0, 9.81], (n, 1))
    return ImuStream("imu0", stamps_ns, np.zeros((n, 3)), still)


@pytest.fixture
def imu():
    return ImuData.build(stream(np.arange(0, 10**9, 5 * 10**6)), NOISE)


def test_noise_walks_with_the_root_of_time(imu):
    begin, end = np.array([0.1, 0.1, 0.1]), np.array([0.1, 0.14, 0.0975])
    expected = DENSITY * np.array([0.0, np.sqrt(0.04), -np.sqrt(0.0025)])
    np.testing.assert_allclose(imu.rotation_sigma(begin, end), expected, rtol=1e-9, atol=1e-12)


def test_drawn_noise_turns_as_far(imu):
    """The mean reading of an interval errs by its density over the root of its length."""
    rng, dt = np.random.default_rng(0), 5e-3
    turns = (DENSITY / np.sqrt(dt) * rng.standard_normal((20000, 8))).sum(axis=1) * dt
    assert turns.std() == pytest.approx(imu.rotation_sigma(np.array([0.2]), np.array([0.24]))[0], rel=0.02)


def test_in_a_gap_it_is_the_unseen_motion_that_turns():
    stamps = np.arange(0, 10**9, 5 * 10**6)
    moving = stream(stamps[(stamps < 4 * 10**8) | (stamps > 5 * 10**8)])
    moving = replace(moving, gyro=np.sin(9.0 * moving.seconds)[:, None] * np.ones(3))
    imu = ImuData.build(moving, NOISE)
    assert np.diff(imu.seconds).max() > MIN_GAP_PERIODS * 5e-3
    across, beside = imu.rotation_sigma(np.array([0.39, 0.29]), np.array([0.45, 0.35]))
    assert beside == pytest.approx(DENSITY * np.sqrt(0.06), rel=1e-3)
    assert across > 30.0 * beside
