"""Integrals of the rates that wheels report: angles, distance and yaw since the first stamp."""

from __future__ import annotations

from typing import Literal

import numpy as np

from icalib.data.measurements import WheelStream

Sampling = Literal["interval-mean", "instantaneous"]
MAX_STEERING_RAD = 1.55  # 89 deg: limit of steering angles; 1 / cos is infinite at 90 deg


def integrated(seconds: np.ndarray, rates: np.ndarray, sampling: Sampling) -> np.ndarray:
    """Integrals (N, m) since the first stamp of rates (N, m) at seconds (N,).

    sampling "interval-mean": a rate is the mean over the interval that ends at its stamp, as computed from differences
    of ticks. "instantaneous": a rate is the value at its stamp (trapezoidal rule). The wrong choice shifts time by half
    an interval.
    """
    mean = rates[1:] if sampling == "interval-mean" else 0.5 * (rates[1:] + rates[:-1])
    integrals = np.zeros_like(rates, dtype=np.float64)
    np.cumsum(mean * np.diff(seconds)[:, None], axis=0, out=integrals[1:])
    return integrals


def integrals_of(stream: WheelStream) -> np.ndarray:
    """Integrals since the first stamp from which the increment factor takes its measurements, for each kind of wheels.

    pair (N, 2): angles that both wheels turned [rad]. twist (N, 2): distance [m], yaw [rad]. steered (N, 4): angle that
    the driven wheel turned [rad], integrals of cos and sin of the steering angle [s], and the integral of
    (rate of the wheel / cos)^2 [rad^2/s]. The variance of the steering row is proportional to the last.
    """
    integrals = integrated(stream.seconds, stream.rate, stream.sampling)
    if stream.kind != "steered":
        return integrals
    rate, steer = stream.rate[:, 0], np.clip(stream.rate[:, 1], -MAX_STEERING_RAD, MAX_STEERING_RAD)
    others = np.stack([np.cos(steer), np.sin(steer), (rate / np.cos(steer)) ** 2], axis=1)
    return np.concatenate([integrals[:, :1], integrated(stream.seconds, others, "instantaneous")], axis=1)
