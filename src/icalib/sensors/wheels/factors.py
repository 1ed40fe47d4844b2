"""The factors of wheels in one pass: what they turn or report, and the ground that they stand on."""

from __future__ import annotations

from collections.abc import Iterator

from icalib.data.measurements import WheelPoses, WheelStream
from icalib.motion.clocks import instants
from icalib.motion.clouds import Clouds
from icalib.motion.sweep import Motion
from icalib.optim.state import Key, Layout
from icalib.rig import Rig, Settings, Wheels
from icalib.sensors.wheels.ground_factor import GroundFactor, floors
from icalib.sensors.wheels.residual import IncrementFactor, RelativePoseFactor, WheelNoise
from icalib.sensors.wheels.wheel_angles import integrals_of


def wheel_factor(
    wheels: Wheels, settings: Settings, stream: WheelStream | WheelPoses, motion: Motion, layout: Layout
) -> IncrementFactor | RelativePoseFactor:
    noise = WheelNoise(
        wheels.wheel_noise, wheels.lateral_slip, wheels.vertical_slip, settings.loss, settings.loss_scale,
        wheels.speed_noise, wheels.yaw_noise, wheels.steering_noise,
    )  # fmt: skip
    if isinstance(stream, WheelPoses):
        return RelativePoseFactor.of_poses(stream, motion.imu, motion.gravity, noise, layout, motion.state)
    own = wheels.name, stream.seconds, integrals_of(stream), motion.imu, motion.gravity, noise, layout, motion.state
    times = instants(stream, motion.state.values)
    if wheels.factor == "relative-poses":
        return RelativePoseFactor.build(*own, times)
    return IncrementFactor.build(*own, stream.kind, times)


def ground_factors(rig: Rig, clouds: Clouds, motion: Motion, layout: Layout) -> Iterator[GroundFactor]:
    """Of wheels that stand on a plane; of the floor once it is seen."""
    for wheels in rig.wheels:
        if wheels.ground is not None:
            state = motion.state
            floor: tuple[Key | None, ...] = (None,) * len(state.recordings)
            if wheels.ground.plane == "floor" and clouds.count:
                floor = floors(state, clouds.keys, clouds.points, clouds.recording)
            yield GroundFactor.build(wheels.name, wheels.ground, floor, state, motion.imu, layout)
