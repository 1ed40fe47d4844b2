"""People in front of a camera: upright boxes that follow it with a delay, and sway from side to side."""

from __future__ import annotations

import numpy as np

from icalib.tools.simulation.scenario.room import Obstacle
from icalib.tools.simulation.scenario.scenario import SimCamera
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory

_SIZE_M = (0.5, 0.3, 1.75)
_AWAY_M, _NEARER_M = 1.8, 0.4  # mean distance from the camera, and amplitude of its change
_APART_RAD, _SWAY_RAD = 0.5, 0.35  # angle between neighbours, and amplitude of the sway
_LATE_S = 0.5  # delay with which people follow the camera
_HZ = 0.13  # frequency of the first person's sway; that of each further person is a tenth higher


def standing(count: int) -> tuple[Obstacle, ...]:
    """`count` people at the origin; `walking` gives their places."""
    return tuple(Obstacle((0.0, 0.0), _SIZE_M) for _ in range(count))


def walking(count: int, camera: SimCamera, trajectory: TrueTrajectory, seconds: float) -> tuple[Obstacle, ...]:
    """`count` people at an instant [s] on the IMU's clock, in front of `camera`."""
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
