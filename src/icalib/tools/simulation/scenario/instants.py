"""Instants and stamps of a sensor's measurements."""

from __future__ import annotations

from typing import Protocol

import numpy as np

from icalib.errors import RigError

LEAD_S = 0.05  # sensors start this long after the IMU, and end this long before it


class Clocked(Protocol):
    """A simulated sensor with a separate clock; the attributes are explained in `SimCamera`."""

    @property
    def name(self) -> str: ...
    @property
    def time_offset_s(self) -> float: ...
    @property
    def rate_hz(self) -> float: ...
    @property
    def phase_s(self) -> float: ...
    @property
    def clock_origin_ns(self) -> int: ...


def stamped(sensor: Clocked, end_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (M,) int64 [ns] on the sensor's clock of its measurements up to end_s, and their true instants (M,) [s] on
    the IMU's clock since its origin. Raises RigError if there are fewer than two."""
    begin = LEAD_S + sensor.phase_s
    nominal = begin + np.arange(int((end_s - begin) * sensor.rate_hz + 1e-9) + 1) / sensor.rate_hz
    check_enough(sensor.name, nominal)
    since_origin = np.round((nominal - sensor.time_offset_s) * 1e9).astype(np.int64)
    seconds = since_origin.astype(np.float64) * 1e-9 + sensor.time_offset_s
    return since_origin + np.int64(sensor.clock_origin_ns), seconds


def check_enough(name: str, instants: np.ndarray) -> None:
    """Raises RigError if the sensor `name` has fewer than two instants of measurement."""
    if len(instants) < 2:
        raise RigError(
            f"{name} has fewer than two measurements in this time; make the scenario longer, or its rate higher."
        )
