"""What wheels have turned, and what else is summed up of their readings: integrals from rates."""

from __future__ import annotations

from typing import Literal

import numpy as np

from icalib.data.measurements import WheelStream

RateReading = Literal["interval-mean", "instantaneous"]
STEEPEST_RAD = 1.55  # beyond it a wheel stands across the vehicle


def angles_from_rates(seconds: np.ndarray, rates: np.ndarray, reading: RateReading) -> np.ndarray:
    """(N, m) integrals since the first stamp of rates (N, m) at seconds (N,): of wheels [rad/s] the angles turned.

    reading: "interval-mean": a rate is the mean over the period that ends at its stamp, as drivers that difference
    ticks publish it; "instantaneous": the value at its stamp (trapezoid). The wrong one shifts time by half a period.
    """
    mean = rates[1:] if reading == "interval-mean" else 0.5 * (rates[1:] + rates[:-1])
    angles = np.zeros_like(rates, dtype=np.float64)
    np.cumsum(mean * np.diff(seconds)[:, None], axis=0, out=angles[1:])
    return angles


def integrals_of(stream: WheelStream) -> np.ndarray:
    """What the increment factor asks of a stream, since the first stamp. pair: (N, 2) rad that both wheels have turned;
    twist: (N, 2) path [m] and yaw [rad]; steered: (N, 4) rad that the driven wheel has turned, and the integrals of
    cos and sin of the steering angle [s] and of the square of the rate at which the wheel turns over cos [rad^2/s]."""
    whole = angles_from_rates(stream.seconds, stream.rate, stream.sampling)
    if stream.kind != "steered":
        return whole
    rate, steer = stream.rate[:, 0], np.clip(stream.rate[:, 1], -STEEPEST_RAD, STEEPEST_RAD)
    others = np.stack([np.cos(steer), np.sin(steer), (rate / np.cos(steer)) ** 2], axis=1)
    return np.concatenate([whole[:, :1], angles_from_rates(stream.seconds, others, "instantaneous")], axis=1)
