"""What is a gap between readings: told by seconds and periods, not by the steps within bursts."""

from __future__ import annotations

import numpy as np
from tests.cases import each

from icalib.data.measurements import ImuStream
from icalib.motion.imu_data import ImuData
from icalib.sensors.imu.spec import class_noise


def gaps(seconds: np.ndarray) -> int:
    rng = np.random.default_rng(0)
    n = len(seconds)
    stream = ImuStream(
        "imu0", (seconds * 1e9).round().astype(np.int64), rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    )
    return len(ImuData.build(stream, class_noise("consumer")).gaps)


@each("rate", [20.0, 200.0, 2000.0])
def test_even_readings_have_none(rate):
    assert gaps(np.arange(400) / rate) == 0


@each(("rate", "pause", "count"), [(200.0, 0.012, 0), (200.0, 0.02, 1), (2000.0, 0.008, 0), (2000.0, 0.02, 1)])
def test_a_pause(rate, pause, count):
    t = np.arange(400) / rate
    assert gaps(np.where(t >= t[200], t + pause - 1.0 / rate, t)) == count


def test_steps_within_bursts_are_not_the_measure():
    """Ten readings 0.2 ms apart, each 11 ms: three median steps are 0.6 ms, three periods 3.3 ms."""
    k = np.arange(1000)
    assert gaps(k // 10 * 0.011 + k % 10 * 2e-4) == 0
