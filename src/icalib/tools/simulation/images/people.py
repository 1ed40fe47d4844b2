"""People who walk before a camera: upright boxes that follow it, somewhat late, and sway from side to side."""

from __future__ import annotations

import numpy as np

from icalib.tools.simulation.scenario.room import Obstacle
from icalib.tools.simulation.scenario.scenario import SimCamera
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory

_SIZE_M = (0.5, 0.3, 1.75)
_AWAY_M, _NEARER_M = 1.8, 0.4  # from the camera, and by how much this changes
_APART_RAD, _SWAY_RAD = 0.5, 0.35  # between two of them, and each from its middle
_LATE_S = 0.5  # where the camera was, this long ago, is what they follow
_HZ = 0.13  # of the first; every other sways by a tenth faster than the one before


def standing(count: int) -> tuple[Obstacle, ...]:
    """As many people, anywhere."""
    return tuple(Obstacle((0.0, 0.0), _SIZE_M) for _ in range(count))


def walking(count: int, camera: SimCamera, trajectory: TrueTrajectory, seconds: float) -> tuple[Obstacle, ...]:
    """Where they are at an instant of the IMU's clock."""
    if not count:
        return ()
    rotation, position, _ = trajectory.pose_at(np.array([seconds - _LATE_S]))
    eye = position[0] + rotation[0] @ camera.T_imu_sensor[:3, 3]
    ahead = rotation[0] @ camera.T_imu_sensor[:3, 2]
    people = []
    for i in range(count):
        phase = 2.0 * np.pi * _HZ * 1.1**i * seconds + 2.0 * i
        angle = np.arctan2(ahead[1], ahead[0]) + _APART_RAD * (i - 0.5 * (count - 1)) + _SWAY_RAD * np.sin(phase)
        away = _AWAY_M + _NEARER_M * np.sin(1.7 * phase)
        place = (float(eye[0] + away * np.cos(angle)), float(eye[1] + away * np.sin(angle)))
        people.append(Obstacle(place, _SIZE_M, float(angle + 0.5 * np.pi + 0.3 * np.sin(2.0 * phase))))
    return tuple(people)
