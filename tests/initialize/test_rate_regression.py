"""Shifts of clocks by regression: whatever the rotation and the scale of the axes, and not by chance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.data.measurements import ImuStream
from icalib.initialize.rate_correlation import SensorRates
from icalib.initialize.rate_regression import MIN_REGRESSION_SCORE, best_regressions, no_match_error
from icalib.motion.imu_data import ImuData
from icalib.rig import ImuNoise
from icalib.tools.simulation.motion import rotation_from_vector

M = rotation_from_vector(np.array([0.4, -1.1, 0.7])) @ np.diag([0.4, 0.4, 1.0])  # a lens far too long
OFFSET = 12.3


def _rate(seconds: np.ndarray, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    omega, phase = rng.uniform(0.5, 5.0, (3, 10)), rng.uniform(0.0, 6.0, (3, 10))
    return 0.1 * np.sin(seconds[:, None, None] * omega + phase).sum(axis=2)


def _imu(scale: float = 1.0, gaps: bool = False) -> ImuData:
    seconds = np.arange(0.0, 40.0, 0.005)
    if gaps:
        seconds = seconds[(seconds < 20.0) | (seconds > 21.0)]
    gyro = scale * _rate(seconds) + [0.02, -0.3, 0.1]
    stream = ImuStream("imu0", (1e9 * seconds).astype(np.int64), gyro, np.zeros((len(seconds), 3)))
    return ImuData.build(stream, ImuNoise(1e-3, 1e-2, 1e-5, 1e-4))


def _camera(seed: int = 0, noise: float = 0.05, scale: float = 1.0) -> SensorRates:
    seconds = np.arange(0.5, 20.0, 0.1)
    rate = scale * _rate(seconds + OFFSET + 0.2, seed) @ np.linalg.inv(M).T
    rate += np.random.default_rng(9).normal(scale=noise, size=rate.shape)
    return SensorRates(seconds, seconds + 0.4, rate, noise=noise)


@pytest.mark.parametrize("gaps", [False, True])
def test_the_shift_is_found(gaps: bool):
    found = best_regressions(_imu(gaps=gaps), _camera())
    assert found[0].offset == pytest.approx(OFFSET, abs=0.03)
    assert found[0].score > max(3.0 * found[1].score, MIN_REGRESSION_SCORE)


def test_noise_goes_with_no_motion():
    found = best_regressions(_imu(), replace(_camera(), rate=np.random.default_rng(1).normal(size=(195, 3))))
    assert found[0].score < MIN_REGRESSION_SCORE


def test_an_imu_that_has_gaps_all_over_gives_no_shift():
    imu = replace(_imu(), gaps=((0.0, 40.0),))
    assert best_regressions(imu, _camera()) == []


def test_slow_motion_is_named_and_another_motion_is_not_called_slow():
    assert "turn too slowly or too steadily" in str(no_match_error(_imu(0.1), "cam0", _camera(scale=0.1)))
    words = str(no_match_error(_imu(), "cam0", _camera(seed=1)))
    assert "does not match that of imu0" in words and "rad/s" not in words, (
        "a scale of the rates changes no correlation"
    )
