"""The sensor model of IMUs: the body's, whose only parameters are its intrinsics, and those mounted on it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from icalib.data.measurements import ImuStream, Measurements
from icalib.model.sensor_model import Pass, SensorModel
from icalib.motion.factor import Factor
from icalib.motion.imu_data import further_imu_data
from icalib.optim.state import Key
from icalib.rig import ImuNoise, ImuSensor, Rig
from icalib.sensors.imu.mounted_factor import MountedImuFactor, SlowMotion
from icalib.sensors.imu.residual import ImuFactor


class ImuModel(SensorModel[ImuSensor, ImuNoise]):
    """Sensor model of IMUs. That of the body, the reference of poses and time, has no extrinsics and no time offset."""

    def keyframe_times(
        self, sensors: Sequence[ImuSensor], rig: Rig, streams: Mapping[str, Any], values: Mapping[Key, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """None, unless all sensors are IMUs: then at intervals of `keyframe_spacing_s`."""
        if rig.imu is None or not rig.imus_alone:
            return {}
        seconds = streams[rig.imu.name].seconds
        return {rig.imu.name: np.arange(seconds[0], seconds[-1], rig.settings.keyframe_spacing_s)}

    def first_noise(self, sensors: Sequence[ImuSensor], rig: Rig, measurements: Measurements) -> dict[str, ImuNoise]:
        return {s.name: s.noise for s in sensors}

    def factors(self, sensor: ImuSensor, stream: ImuStream, noise: ImuNoise, at: Pass) -> Iterator[Factor]:
        """Yields the factor of all intervals between keyframes. Noise is in the readings already."""
        assert at.motion is not None
        if sensor.mounted:
            yield MountedImuFactor.build(further_imu_data(sensor, at.parts, at.measurements), at.motion, at.layout)
            return
        yield ImuFactor.build(at.motion.imu, at.state, at.motion.gravity, at.layout)

    def joint_factors(
        self, sensors: Sequence[ImuSensor], factors: Sequence[Factor], noise: Mapping[str, ImuNoise], at: Pass
    ) -> Sequence[Factor]:
        """`SlowMotion`, if all sensors are IMUs."""
        if not at.rig.imus_alone:
            return ()
        return (SlowMotion(at.rig.reference, len(at.state.seconds), at.starts),)


MODEL = ImuModel()
