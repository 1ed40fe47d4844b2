"""How a camera enters the problem: its parameters, and the keyframes that its images want."""

from __future__ import annotations

import numpy as np

from icalib.model.sensor_model import SensorModel
from icalib.rig import Camera, ParameterSpec, Rig
from icalib.sensors.camera.corner_factor import CornerNoise
from icalib.sensors.camera.spec import BLOOM
from icalib.sensors.sensor import MOUNTED, TIME_OFFSET


class CameraSensorModel(SensorModel[Camera, CornerNoise]):
    """Without an IMU images at one stamp are simultaneous, and the first camera that sees a target is the body."""

    keyframes = "images"

    def is_estimated(self, sensor: Camera, spec: ParameterSpec, rig: Rig) -> bool:
        """See `SensorModel`; bloom only where the target has edges that it moves."""
        if rig.imu is None and (spec == TIME_OFFSET or (sensor.name == rig.reference and spec in MOUNTED)):
            return False
        return sensor.is_estimated(spec) and (spec != BLOOM or rig.blooms)

    def start_value(self, sensor: Camera, spec: ParameterSpec, rig: Rig) -> np.ndarray | None:
        """See `SensorModel`; no bloom where it is not modelled."""
        if spec == BLOOM and not rig.blooms:
            return np.zeros(BLOOM.size)
        return super().start_value(sensor, spec, rig)


MODEL = CameraSensorModel()
