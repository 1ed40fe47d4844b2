"""How an IMU enters the problem: its intrinsics. Its readings tie the keyframes together, see `residual`."""

from __future__ import annotations

from icalib.model.sensor_model import SensorModel
from icalib.rig import ImuNoise, ImuSensor, Settings


class ImuModel(SensorModel[ImuSensor, ImuNoise]):
    """The IMU is the body: it has neither pose nor clock."""

    def first_noise(self, sensor: ImuSensor, settings: Settings) -> ImuNoise:
        """As stated."""
        del settings
        return sensor.noise


MODEL = ImuModel()
