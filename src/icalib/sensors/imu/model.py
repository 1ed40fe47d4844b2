"""The sensor model of an IMU, whose only parameters are its intrinsics. Its factor is in `residual`."""

from __future__ import annotations

from icalib.model.sensor_model import SensorModel
from icalib.rig import ImuNoise, ImuSensor, Settings


class ImuModel(SensorModel[ImuSensor, ImuNoise]):
    """Sensor model of the IMU. Being the reference of poses and time, it has no extrinsics and no time offset."""

    def first_noise(self, sensor: ImuSensor, settings: Settings) -> ImuNoise:
        """See `SensorModel`; the noise in the rig file."""
        del settings
        return sensor.noise


MODEL = ImuModel()
