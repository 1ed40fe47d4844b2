"""What a recording shows of its IMUs, as plain data."""

from __future__ import annotations

from dataclasses import dataclass

from icalib.data.recordings import TopicInfo
from icalib.sensors.imu.read.checks import Saturation
from icalib.sensors.imu.spec import TwoSources
from icalib.tools.inspection.facts import SensorSource, Vector


@dataclass(frozen=True)
class ImuFacts:
    """Readings of one IMU, x y z in its axes: gyro [rad/s], accel [m/s^2], in the recorded units.

    frame: frame id. mean_accel: mean of |accel|. gyro_rms: RMS of each axis; accel_std: RMS about the mean.
    principal_rms: RMS rate about the directions `principal` (unit vectors), largest first. gravity_spread: result of
    `gravity_turns.gravity_spread` for rates taken as rad/s, as deg/s, and as zero. scatter: `quiet_scatter` of
    gyro and accel. problem: why `calibrate` would refuse the readings, else "".
    """

    frame: str
    gyro_min: Vector
    gyro_max: Vector
    accel_min: Vector
    accel_max: Vector
    mean_accel: float
    gyro_rms: Vector
    accel_std: Vector
    principal_rms: Vector
    principal: tuple[Vector, Vector, Vector]
    gravity_spread: Vector | None
    scatter: tuple[float, float]
    saturated: tuple[Saturation, ...]
    notes: tuple[str, ...]
    problem: str = ""


@dataclass(frozen=True)
class ImuSource(SensorSource):
    """One IMU. halves: its two topics if gyroscope and accelerometer have a topic each; `topic` is the gyroscope's."""

    halves: TwoSources | None = None

    @property
    def read_topic(self) -> TopicInfo:
        """See `SensorSource`."""
        return self.topic
