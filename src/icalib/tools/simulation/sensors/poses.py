"""What a pose sensor reports: where it is in a frame of its own, as motion capture or an odometry does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import PoseStream
from icalib.tools.simulation.scenario.instants import LEAD_S, stamped
from icalib.tools.simulation.scenario.robot import SimPoses
from icalib.tools.simulation.sensors.imu import rotation_from_vector
from icalib.tools.simulation.sensors.motion import TrueTrajectory


@dataclass(frozen=True, eq=False)
class PoseTruth:
    """seconds (N,) on the IMU's clock of each stamp; rotation (N, 3, 3), position (N, 3) m: what is reported, without
    noise."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray


def report_poses(
    sensor: SimPoses, trajectory: TrueTrajectory, imu_seconds: np.ndarray, noisy: bool, rng: np.random.Generator
) -> tuple[PoseStream, PoseTruth]:
    """The poses of one sensor within the readings of the IMU, at imu_seconds (N,)."""
    stamps, seconds = stamped(sensor, imu_seconds[-1] - LEAD_S)
    R, p, _ = trajectory.pose_at(seconds)
    T = np.tile(np.eye(4), (len(seconds), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, p
    seen = np.linalg.inv(sensor.T_world_frame) @ T @ sensor.T_imu_sensor
    seen[:, :3, 3] /= sensor.scale
    truth = PoseTruth(seconds, seen[:, :3, :3].copy(), seen[:, :3, 3].copy())
    if noisy:
        seen = _scattered(sensor, seen, rng) if sensor.kind == "absolute" else _drifting(sensor, seen, seconds, rng)
    return PoseStream(sensor.name, stamps, seen[:, :3, :3].copy(), seen[:, :3, 3].copy()), truth


def _scattered(sensor: SimPoses, seen: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Each pose (N, 4, 4) with an error of its own: its rotation in the sensor's axes, its position in the frame's."""
    out = seen.copy()
    for T in out:
        T[:3, :3] = T[:3, :3] @ rotation_from_vector(sensor.rotation_noise * rng.standard_normal(3))
        T[:3, 3] += sensor.position_noise * rng.standard_normal(3)
    return out


def _drifting(sensor: SimPoses, seen: np.ndarray, seconds: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Poses (N, 4, 4) whose steps have an error each, that adds up."""
    out = seen.copy()
    for k in range(1, len(seen)):
        step, root = np.linalg.inv(seen[k - 1]) @ seen[k], np.sqrt(seconds[k] - seconds[k - 1])
        step[:3, :3] = step[:3, :3] @ rotation_from_vector(sensor.rotation_noise * root * rng.standard_normal(3))
        step[:3, 3] += sensor.position_noise * root * rng.standard_normal(3)
        out[k] = out[k - 1] @ step
    return out


def quaternion(R: np.ndarray) -> np.ndarray:
    """(4,) x, y, z, w of a rotation (3, 3): the eigenvector of Bar-Itzhack's matrix, which has no bad angles."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = [[a - e - i, b + d, c + g, h - f], [b + d, e - a - i, f + h, c - g], [c + g, f + h, i - a - e, d - b]]
    return np.linalg.eigh(np.array([*K, [h - f, c - g, d - b, a + e + i]]) / 3.0)[1][:, -1]
