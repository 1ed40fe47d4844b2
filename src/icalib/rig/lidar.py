"""A LiDAR."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

from icalib.rig.parameter import Parameter
from icalib.rig.sensor import Sensor, TimeUnit

PointTime = Literal["auto", "start", "end", "azimuth", "snapshot"]


@dataclass(frozen=True)
class Lidar(Sensor):
    """One LiDAR. Points nearer than min_range_m or farther than max_range_m are left out.

    point_time: what a point's time is counted from; see `data.messages.point_times`. point_time_field, point_time_unit:
    where the time of a point stands, and in what unit; None: told from the data.
    """

    sensor_type: ClassVar[str] = "lidar"

    path: str
    range_noise_m: float | None = None  # along the beam; None: estimated from the residuals
    rotation: Parameter = Parameter()
    translation: Parameter = Parameter()
    time_offset: Parameter = Parameter()
    clock_restarts: bool = False  # from recording to recording: each has a time offset of its own
    min_range_m: float = 0.5
    max_range_m: float = 100.0
    point_time: PointTime = "auto"
    topic: str | None = None  # of its clouds; None: the one with the LiDAR's name, or the only one
    point_time_field: str | None = None
    point_time_unit: TimeUnit | None = None
