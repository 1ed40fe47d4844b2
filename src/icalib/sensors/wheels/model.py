"""The sensor model of wheels, with a factor for their readings and one for the ground."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from icalib.data.measurements import Measurements, WheelPoses, WheelStream
from icalib.model.sensor_model import Pass, SensorModel
from icalib.motion.factor import Factor
from icalib.motion.poses import EstimatedMotion, instants, spaced
from icalib.optim.state import Key, Layout
from icalib.rig import Rig, Wheels
from icalib.sensors.wheels.ground_factor import GroundFactor, floors
from icalib.sensors.wheels.residual import IncrementFactor, RelativePoseFactor, WheelFactor, WheelNoise, integrals_of


class WheelModel(SensorModel[Wheels, WheelNoise]):
    """Sensor model of wheels; their noise is stated in the rig file."""

    def keyframe_times(
        self, sensors: Sequence[Wheels], rig: Rig, streams: Mapping[str, Any], values: Mapping[Key, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """Times of readings at about the keyframe spacing, of the wheels whose frame is the body, if the motion is
        assumed to be smooth."""
        if rig.imu is None or not rig.assumes_motion:
            return {}
        placing = [streams[s.name] for s in sensors if s.name == rig.reference_without_imu]
        return {s.name: instants(s, values, spaced(s.seconds, rig.imu.pose_keyframes_s)) for s in placing}

    def first_noise(self, sensors: Sequence[Wheels], rig: Rig, measurements: Measurements) -> dict[str, WheelNoise]:
        loss, scale = rig.settings.loss, rig.settings.loss_scale
        return {
            s.name: WheelNoise(
                s.wheel_noise, s.lateral_slip, s.vertical_slip, loss, scale, s.speed_noise, s.yaw_noise,
                s.steering_noise,
            )
            for s in sensors
        }  # fmt: skip

    def factors(
        self, sensor: Wheels, stream: WheelStream | WheelPoses, noise: WheelNoise, at: Pass
    ) -> Iterator[Factor]:
        """The factor of the readings, and the ground factor if the rig file states a ground."""
        assert at.motion is not None
        yield wheel_factor(sensor, stream, noise, at.motion, at.layout)
        if sensor.ground is not None:
            floor: tuple[Key | None, ...] = (None,) * len(at.state.recordings)
            if sensor.ground.plane == "floor" and at.association.count:
                floor = floors(at.state, at.association.keys, at.association.points, at.association.recording)
            yield GroundFactor.build(sensor.name, sensor.ground, floor, at.state, at.layout)


def wheel_factor(
    wheels: Wheels, stream: WheelStream | WheelPoses, noise: WheelNoise, motion: EstimatedMotion, layout: Layout
) -> WheelFactor:
    """The factor of the readings; the fields `measures` and `factor` of the rig file choose its type."""
    if isinstance(stream, WheelPoses):
        return RelativePoseFactor.of_poses(stream, motion, noise, layout)
    arguments = wheels.name, stream.seconds, integrals_of(stream), motion, noise, layout
    times = instants(stream, motion.state.values)
    if wheels.factor == "relative-poses":
        return RelativePoseFactor.build(*arguments, times)
    return IncrementFactor.build(*arguments, stream.kind, times)


MODEL = WheelModel()
