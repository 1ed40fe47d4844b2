"""The sensor model of an IMU, whose only parameters are its intrinsics."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.model.sensor_model import Pass, SensorModel
from icalib.rig import ImuNoise, ImuSensor, Settings
from icalib.sensors.imu.residual import ImuFactor


class ImuModel(SensorModel[ImuSensor, ImuNoise]):
    """Sensor model of the IMU. Being the reference of poses and time, it has no extrinsics and no time offset."""

    def first_noise(self, sensor: ImuSensor, settings: Settings) -> ImuNoise:
        """See `SensorModel`; the noise in the rig file."""
        del settings
        return sensor.noise

    def factors(self, sensor: ImuSensor, stream: ImuStream, noise: ImuNoise, at: Pass) -> Iterator[ImuFactor]:
        """Yields the factor of all intervals between keyframes. The readings of `at` already contain the noise."""
        del stream, noise
        assert at.imu is not None
        columns = at.layout.columns(sensor.name, "intrinsics")
        columns = np.concatenate([columns[columns >= 0], at.imu.unit_columns(at.layout)])
        yield ImuFactor.build(at.imu, at.state, at.rig.gravity, columns)


MODEL = ImuModel()
