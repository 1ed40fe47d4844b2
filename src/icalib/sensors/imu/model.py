"""The sensor model of an IMU, whose only parameters are its intrinsics."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.data.measurements import ImuStream
from icalib.model.sensor_model import Pass, SensorModel
from icalib.rig import ImuNoise, ImuSensor
from icalib.rig.scene import GRAVITY, WORLD
from icalib.sensors.imu.residual import ImuFactor


class ImuModel(SensorModel[ImuSensor, ImuNoise]):
    """Sensor model of the IMU. Being the reference of poses and time, it has no extrinsics and no time offset."""

    def factors(self, sensor: ImuSensor, stream: ImuStream, noise: ImuNoise, at: Pass) -> Iterator[ImuFactor]:
        """Yields the factor of all intervals between keyframes. The readings of `at` already contain the noise."""
        assert at.motion is not None
        intrinsics, key = at.layout.columns(sensor.name, "intrinsics"), (WORLD, GRAVITY.name)
        gravity = at.layout.columns(*key) if at.layout.has(*key) else intrinsics[:0]
        columns = np.concatenate([intrinsics[intrinsics >= 0], at.motion.imu.unit_columns(at.layout)])
        yield ImuFactor.build(at.motion.imu, at.state, at.motion.gravity, columns, gravity)


MODEL = ImuModel()
