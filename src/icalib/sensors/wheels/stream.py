"""Streams of wheels: rates, or relative planar poses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal, Self

import numpy as np

from icalib.errors import RecordingError
from icalib.sensors.stream import Stream, check


@dataclass(frozen=True)
class WheelStream(Stream):
    """Rates or velocities that wheels or the driver of a vehicle report.

    stamps_ns (N,) int64, strictly increasing. rate (N, 2) depends on `kind`. "pair": rates of the left and the right
    wheel [rad/s], positive forwards. "steered": rate of the driven wheel [rad/s] and steering angle [rad], positive to
    the left. "twist": forward speed [m/s] and yaw rate [rad/s], positive to the left.

    sampling "interval-mean": reading i is the mean from stamp i-1 to stamp i, as computed from a difference of encoder
    counts; the start of the first interval is unknown. "instantaneous": reading i is the value at stamp i. Steering
    angles are always instantaneous.
    """

    sensor_type: ClassVar[str] = "wheels"
    rate: np.ndarray
    sampling: Literal["interval-mean", "instantaneous"] = "interval-mean"
    kind: Literal["pair", "steered", "twist"] = "pair"

    def __post_init__(self) -> None:
        super().__post_init__()
        n = len(self.stamps_ns)
        check(self.rate.shape == (n, 2), f"{self.name}: rate must have shape ({n}, 2), not {self.rate.shape}.")


@dataclass(frozen=True)
class WheelPoses(Stream):
    """Relative planar poses of the wheels' frame between consecutive stamps (z_W in equation (27) of the
    iCalib paper).

    stamps_ns (K + 1,) int64, strictly increasing; pose (K, 3): yaw [rad], x, y [m] of the frame at stamp k+1 in the
    frame at stamp k; covariance (K, 3, 3) of these.
    """

    sensor_type: ClassVar[str] = "wheels"
    pose: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        super().__post_init__()
        k = len(self.stamps_ns) - 1
        check(self.pose.shape == (k, 3), f"{self.name}: pose must have shape ({k}, 3), not {self.pose.shape}.")
        shape = self.covariance.shape
        check(shape == (k, 3, 3), f"{self.name}: covariance must have shape ({k}, 3, 3), not {shape}.")

    @classmethod
    def joined(cls, streams: Sequence[Any], shifts_ns: Sequence[int] | None = None) -> Self:
        """Always raises RecordingError: there is no relative pose between two recordings."""
        raise RecordingError(
            f"{streams[0].name} measures relative poses, and there is none between two recordings; give one "
            "recording, or wheels that measure rates, angles or ticks."
        )
