"""The motion of the IMU as a state has it: keyframes of measurements, and the poses and twists of a LiDAR."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit
from icalib.data.measurements import Stream
from icalib.geometry.small import mul3
from icalib.motion.imu_data import ImuData
from icalib.motion.keyframe_placement import usable
from icalib.motion.poses import assign_keyframes, poses_without_jacobians
from icalib.motion.time_offsets import instants
from icalib.optim.state import State


@dataclass(frozen=True)
class EstimatedMotion:
    """The IMU's motion as a state has it. gravity [m/s^2]; IMU gaps up to max_gap_s are bridged."""

    state: State
    imu: ImuData
    gravity: float
    max_gap_s: float

    def near_keyframes(self, stream: Stream, within_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Numbers (n,) of the stream's measurements that lie within `within_s` of a keyframe and in no gap of the IMU
        that is not bridged, in the order of their keyframes; and these keyframes (n,)."""
        times = instants(stream, self.state.values)
        keyframe = assign_keyframes("inertial", self.state.seconds, times, self.imu.forwards)
        near = np.abs(times - self.state.seconds[keyframe]) <= within_s
        own = np.flatnonzero(near & usable(self.imu, times, self.max_gap_s))
        own = own[np.argsort(keyframe[own], kind="stable")]
        return own, keyframe[own]


class Sweep(NamedTuple):
    """The LiDAR at the centres of bins: R_world_lidar, p_world_lidar, and the twist in its own axes: rad/s, m/s."""

    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray


@njit(cache=True, nogil=True)
def _to_lidar(R_il, p_il, R, p, rate, velocity):
    """From the IMU's pose, rate and velocity to the LiDAR's, in place: its twist in its own axes."""
    for i in range(len(R)):
        w0, w1, w2 = rate[i, 0], rate[i, 1], rate[i, 2]
        lever = (w1 * p_il[2] - w2 * p_il[1], w2 * p_il[0] - w0 * p_il[2], w0 * p_il[1] - w1 * p_il[0])
        moving = np.empty(3)
        for a in range(3):
            moving[a] = lever[a]
            for c in range(3):
                moving[a] += R[i, c, a] * velocity[i, c]
                p[i, a] += R[i, a, c] * p_il[c]
        for a in range(3):
            rate[i, a] = R_il[0, a] * w0 + R_il[1, a] * w1 + R_il[2, a] * w2
            velocity[i, a] = R_il[0, a] * moving[0] + R_il[1, a] * moving[1] + R_il[2, a] * moving[2]
        turned = mul3(R[i], R_il)
        for a in range(3):
            for c in range(3):
                R[i, a, c] = turned[a, c]


def sweep(drive: EstimatedMotion, name: str, times: np.ndarray, near: np.ndarray | None = None) -> Sweep:
    """Where LiDAR `name` is and how it moves at `times` (n,) on the IMU's clock, by the IMU's readings from the
    keyframes next to them, or next to `near` (n,)."""
    state, imu = drive.state, drive.imu
    keyframe = assign_keyframes("inertial", state.seconds, times if near is None else near)
    imu_at = poses_without_jacobians(times, keyframe, state, imu, drive.gravity)
    R_il, p_il = state.values[name, "rotation"], state.values[name, "translation"]
    found = Sweep(imu_at.rotation, imu_at.position, imu_at.rate, imu_at.velocity)
    _to_lidar(np.ascontiguousarray(R_il), p_il, *found)
    return found
