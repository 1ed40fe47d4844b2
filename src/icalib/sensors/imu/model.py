"""The model of an IMU: its parameters are the intrinsics; the factor of its readings is in `residual`."""

from __future__ import annotations

from icalib.model.sensor_model import SensorModel
from icalib.rig import ImuNoise, ImuSensor, Settings


class ImuModel(SensorModel[ImuSensor, ImuNoise]):
    """The IMU is the reference of poses and clocks, so that it has neither extrinsics nor a time offset."""

    def first_noise(self, sensor: ImuSensor, settings: Settings) -> ImuNoise:
        """See `SensorModel`; the noise of the rig file."""
        del settings
        return sensor.noise


MODEL = ImuModel()
