"""The noise density that readings show by themselves."""

import numpy as np
import pytest
from tests.cases import each

from icalib.sensors.imu.assess import quiet_scatter

RATE = 200.0


def readings(density: float, seconds: float = 20.0, rate: float = RATE) -> tuple[np.ndarray, np.ndarray]:
    """Motion of up to 3 Hz and white noise of that density."""
    t = np.arange(int(seconds * rate)) / rate
    motion = np.stack([np.sin(2.0 * np.pi * f * t) for f in (0.7, 1.9, 3.0)], axis=1)
    return t, motion + density * np.sqrt(rate) * np.random.default_rng(1).normal(size=motion.shape)


@each("density", [1e-4, 1e-2])
@each("rate", [100.0, 200.0, 1000.0])
def test_it_is_that_of_white_noise_whatever_the_motion(density, rate):
    t, x = readings(density, rate=rate)
    assert 0.8 * density < quiet_scatter(t, x) < 1.05 * density


def test_vibration_in_half_of_the_time_does_not_count():
    t, x = readings(1e-4)
    x[t > 10.0] += 0.05 * np.random.default_rng(2).normal(size=x[t > 10.0].shape)
    assert quiet_scatter(t, x) < 1.1e-4


def test_a_filter_makes_it_smaller():
    t, x = readings(1e-3)
    assert quiet_scatter(t[1:], 0.5 * (x[1:] + x[:-1])) < 0.6e-3


def test_gaps_do_not_count_and_few_readings_show_nothing():
    t, x = readings(1e-4)
    kept = (t < 5.0) | (t > 9.0)
    assert quiet_scatter(t[kept], x[kept]) == pytest.approx(1e-4, rel=0.2)
    assert np.isnan(quiet_scatter(t[:900], x[:900]))
