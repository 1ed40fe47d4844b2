"""Integrals of the rates that wheels report: angles, distance and yaw since the first stamp."""

from __future__ import annotations

from typing import Literal

import numpy as np

from icalib.data.measurements import WheelStream

Sampling = Literal["interval-mean", "instantaneous"]
MAX_STEERING_RAD = 1.55  # 89 deg: at 90 deg the wheels point across the vehicle, and 1 / cos is infinite


def integrated(seconds: np.ndarray, rates: np.ndarray, sampling: Sampling) -> np.ndarray:
    """(N, m) integrals since the first stamp of rates (N, m) at seconds (N,); of wheels [rad/s] the angles turned.

    sampling: "interval-mean": a rate is the mean over the interval that ends at its stamp, as drivers that difference
    ticks publish it; "instantaneous": the value at its stamp (trapezoidal rule). The wrong one shifts time by half an
    interval.
    """
    mean = rates[1:] if sampling == "interval-mean" else 0.5 * (rates[1:] + rates[:-1])
    integrals = np.zeros_like(rates, dtype=np.float64)
    np.cumsum(mean * np.diff(seconds)[:, None], axis=0, out=integrals[1:])
    return integrals


def integrals_of(stream: WheelStream) -> np.ndarray:
    """What the increment factor needs of a stream: integrals since the first stamp, by kind.

    pair (N, 2): angles that both wheels turned [rad]. twist (N, 2): distance [m], yaw [rad]. steered (N, 4): angle that
    the driven wheel turned [rad], integrals of cos and sin of the steering angle [s], and of
    (rate of the wheel / cos)^2 [rad^2/s], to which the variance of the steering row is proportional.
    """
    whole = integrated(stream.seconds, stream.rate, stream.sampling)
    if stream.kind != "steered":
        return whole
    rate, steer = stream.rate[:, 0], np.clip(stream.rate[:, 1], -MAX_STEERING_RAD, MAX_STEERING_RAD)
    others = np.stack([np.cos(steer), np.sin(steer), (rate / np.cos(steer)) ** 2], axis=1)
    return np.concatenate([whole[:, :1], integrated(stream.seconds, others, "instantaneous")], axis=1)
