"""Stamps whose rate tells that they are not nanoseconds."""

from __future__ import annotations

import numpy as np

_UNITS = {"microseconds": 1e3, "milliseconds": 1e6, "seconds": 1e9}  # nanoseconds in each


def other_unit(median_step: float, slowest_hz: float, fastest_hz: float) -> str | None:
    """The unit in which a median step between stamps gives a rate inside the bounds, None if there is none."""
    for unit, ns in _UNITS.items():
        if median_step > 0 and slowest_hz <= 1e9 / (median_step * ns) <= fastest_hz:
            return unit
    return "seconds" if median_step == 0 else None


def rate_sentence(what: str, stamps_ns: np.ndarray, slowest_hz: float, fastest_hz: float) -> str | None:
    """A sentence saying that the median rate of the stamps (N,) lies outside the bounds, None if it lies inside."""
    step = float(np.median(np.diff(stamps_ns)))
    if step > 0 and slowest_hz <= 1e9 / step <= fastest_hz:
        return None
    unit = other_unit(step, slowest_hz, fastest_hz)
    rate = "more than one reading an instant" if step == 0 else f"{1e9 / step:.4g} readings a second"
    advice = f"they look like {unit}; export them in nanoseconds" if unit else "write the stamps in nanoseconds"
    return f"{what}: the stamps mean {rate} ({slowest_hz:g} to {fastest_hz:g} expected); {advice}."
