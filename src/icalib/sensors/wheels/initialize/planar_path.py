"""Trajectory of a rig without an IMU: dead reckoning by wheels on a flat floor."""

from __future__ import annotations

import numpy as np

from icalib.data.measurements import WheelPoses, WheelStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.rig import Wheels
from icalib.sensors.wheels.integrals import integrals_of


def wheel_path(wheels: Wheels, stream: WheelStream | WheelPoses) -> BodyPoses:
    """Poses of the wheel frame at the stamps, relative to the first pose, in the plane z = 0.

    Raises EstimationError if the rig file does not state the sizes of the wheels.
    """
    if isinstance(stream, WheelPoses):
        turn, along = stream.pose[:, 0], stream.pose[:, 1:]
    else:
        turn, along = _increments(wheels, stream)
    yaw = np.concatenate([[0.0], np.cumsum(turn)])
    c, s = np.cos(yaw[:-1]), np.sin(yaw[:-1])
    steps = np.stack([c * along[:, 0] - s * along[:, 1], s * along[:, 0] + c * along[:, 1]], axis=1)
    position = np.zeros((len(yaw), 3))
    position[1:, :2] = np.cumsum(steps, axis=0)
    return BodyPoses(stream.seconds, so3.exp_many(yaw[:, None] * [0.0, 0.0, 1.0]), position)


def _increments(wheels: Wheels, stream: WheelStream) -> tuple[np.ndarray, np.ndarray]:
    """Yaw (n,) [rad] from each reading to the next, and displacement (n, 2) [m] in the wheel frame at the earlier
    one."""
    turned = np.diff(integrals_of(stream), axis=0)
    if stream.kind == "pair":
        path = turned * _size(wheels, "radii")
        ahead, yaw = path.mean(axis=1), (path[:, 1] - path[:, 0]) / _size(wheels, "baseline")[0]
    elif stream.kind == "twist":
        scales = np.ones(2) if wheels.scales.value is None else wheels.scales.value
        ahead, yaw = (turned * scales).T
    else:
        offset = 0.0 if wheels.steering_offset.value is None else float(wheels.steering_offset.value[0])
        ahead = turned[:, 0] * _size(wheels, "radius")[0]
        steer = np.arctan2(turned[:, 2], turned[:, 1]) + offset
        yaw = ahead * np.tan(steer) / _size(wheels, "wheelbase")[0]
    half = 0.5 * yaw  # the displacement is the chord of an arc
    return yaw, (ahead * np.sinc(half / np.pi))[:, None] * np.stack([np.cos(half), np.sin(half)], axis=1)


def _size(wheels: Wheels, name: str) -> np.ndarray:
    """The stated value of the parameter `name`. Raises EstimationError if the rig file has none."""
    value = getattr(wheels, name).value
    if value is None:
        raise EstimationError(
            f"without IMU, target and pose sensor only {wheels.name} determines the scale; give its "
            f"{' and '.join(spec.name for spec in wheels.drive_specs)} in the rig file, or add one of these sensors."
        )
    return np.asarray(value, dtype=np.float64)
