"""The upward direction: by gravity, or by a level frame of a sensor if gravity is not observed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.estimate.problem.inputs import Inputs
from icalib.initialize.steps.initializer import initializer_of
from icalib.optim.state import State

# Cosine between the vehicle's axis of rotation and z of a frame: a frame more than 45 degrees off is not level
MIN_LEVEL_COSINE = 0.7


@dataclass(frozen=True)
class Verticals:
    """candidates: upward unit vectors (3,) in IMU axes, the more likely one first; level_sensor: the sensor whose level
    frame decides between both directions, or None."""

    candidates: tuple[np.ndarray, ...]
    level_sensor: str | None = None


def possible_verticals(inputs: Inputs, state: State) -> Verticals:
    """Upward directions by gravity. Without an IMU, the main axis of rotation of the vehicle, whose sign follows from
    the level frame of a sensor. Without such a frame both signs are possible: a vehicle whose left and right are
    swapped drives upside down."""
    if not inputs.rig.assumes_motion:
        return Verticals((np.einsum("nji,j->i", state.rotation, [0.0, 0.0, 1.0]),))
    assert inputs.imu is not None
    axis = np.linalg.svd(inputs.imu.gyro.T @ inputs.imu.gyro)[0][:, 0]
    along, level = _vertical_by_frames(inputs, state, axis)
    return Verticals((np.sign(along) * axis,), level) if level else Verticals((axis, -axis))


def level_sensor(inputs: Inputs, state: State) -> str | None:
    """The sensor whose level frame shows the upward direction, for a rig without an IMU. None if there is no such
    sensor."""
    turns = state.bias[:, :3]  # of an assumed motion: minus the angular rate
    return _vertical_by_frames(inputs, state, np.linalg.svd(turns.T @ turns)[0][:, 0])[1]


def _vertical_by_frames(inputs: Inputs, state: State, axis: np.ndarray) -> tuple[float, str | None]:
    """The upward component of the main axis of rotation `axis` (3,) in the IMU's axes, and the sensor whose frame shows
    it."""
    in_world = np.einsum("nij,j->i", state.rotation, axis) / len(state.rotation)
    for sensor in inputs.rig.mounted:
        up = initializer_of(sensor).vertical(state, sensor)
        if up is not None and abs(along := float(in_world @ up)) > MIN_LEVEL_COSINE:
            return along, sensor.name
    return 0.0, None
