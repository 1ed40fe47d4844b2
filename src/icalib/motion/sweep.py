"""Motion of the IMU between the keyframes of a state: nearest keyframes of measurements, poses and twists of a
LiDAR."""

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
from icalib.rig.scene import GRAVITY, WORLD


def gravity_of(state: State, stated: float) -> float:
    """Magnitude of gravity [m/s^2] at `state`; `stated` where a state of the first guess has none."""
    return float(state.values.get((WORLD, GRAVITY.name), [stated])[0])


@dataclass(frozen=True)
class EstimatedMotion:
    """Motion of the IMU between the keyframes of `state`.

    gravity [m/s^2]: a constant within a pass, unlike that of the IMU factor. Sensors are 25 ms from a keyframe at most;
    its standard deviation of 0.02 m/s^2 moves them by 6 um before the next pass. IMU gaps up to max_gap_s are
    bridged.
    """

    state: State
    imu: ImuData
    gravity: float
    max_gap_s: float

    def near_keyframes(self, stream: Stream, within_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Measurements of `stream` within `within_s` of a keyframe and outside long gaps of the IMU: their indices
        (n,), sorted by keyframe, and the keyframes (n,)."""
        times = instants(stream, self.state.values)
        keyframe = assign_keyframes("inertial", self.state.seconds, times, self.imu.forwards)
        near = np.abs(times - self.state.seconds[keyframe]) <= within_s
        indices = np.flatnonzero(near & usable(self.imu, times, self.max_gap_s))
        indices = indices[np.argsort(keyframe[indices], kind="stable")]
        return indices, keyframe[indices]


class Sweep(NamedTuple):
    """Poses and twists of a LiDAR at n instants: R_world_lidar (n, 3, 3), p_world_lidar (n, 3) [m], rate [rad/s] and
    velocity [m/s] (n, 3) in LiDAR axes."""

    rotation: np.ndarray
    position: np.ndarray
    rate: np.ndarray
    velocity: np.ndarray


@njit(cache=True, nogil=True)
def _to_lidar(R_il, p_il, R, p, rate, velocity):
    """Transforms poses, rates and velocities of the IMU to those of the LiDAR, in place. R_il, p_il: T_imu_lidar. Rates
    and velocities end in LiDAR axes."""
    for i in range(len(R)):
        w0, w1, w2 = rate[i, 0], rate[i, 1], rate[i, 2]
        lever = (w1 * p_il[2] - w2 * p_il[1], w2 * p_il[0] - w0 * p_il[2], w0 * p_il[1] - w1 * p_il[0])
        velocity_i = np.empty(3)
        for a in range(3):
            velocity_i[a] = lever[a]
            for c in range(3):
                velocity_i[a] += R[i, c, a] * velocity[i, c]
                p[i, a] += R[i, a, c] * p_il[c]
        for a in range(3):
            rate[i, a] = R_il[0, a] * w0 + R_il[1, a] * w1 + R_il[2, a] * w2
            velocity[i, a] = R_il[0, a] * velocity_i[0] + R_il[1, a] * velocity_i[1] + R_il[2, a] * velocity_i[2]
        rotation = mul3(R[i], R_il)
        for a in range(3):
            for c in range(3):
                R[i, a, c] = rotation[a, c]


def sweep(drive: EstimatedMotion, name: str, times: np.ndarray, near: np.ndarray | None = None) -> Sweep:
    """Poses and twists of LiDAR `name` at `times` (n,) on the IMU clock, integrated from the keyframes nearest to
    these, or to `near` (n,)."""
    state, imu = drive.state, drive.imu
    keyframe = assign_keyframes("inertial", state.seconds, times if near is None else near)
    imu_at = poses_without_jacobians(times, keyframe, state, imu, drive.gravity)
    R_il, p_il = state.values[name, "rotation"], state.values[name, "translation"]
    poses = Sweep(imu_at.rotation, imu_at.position, imu_at.rate, imu_at.velocity)
    _to_lidar(np.ascontiguousarray(R_il), p_il, *poses)
    return poses
