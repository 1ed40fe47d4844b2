"""What a LiDAR reports: points of the room, each seen from where the sensor was at the point's own instant."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from icalib.data.measurements import LidarStream
from icalib.tools.simulation.scenario.instants import LEAD_S, stamped
from icalib.tools.simulation.scenario.robot import SimLidar
from icalib.tools.simulation.scenario.room import Room, RoomSurfaces, nearest
from icalib.tools.simulation.scenario.scenario import Scenario
from icalib.tools.simulation.sensors.motion import TrueTrajectory

_FIRING_S = 2.304e-6


class _Sweep(NamedTuple):
    """One turn of A columns of K lasers. The pose in the room is that of each column's beginning and of the end."""

    rotation: np.ndarray  # (A + 1, 3, 3) R_world_lidar
    position: np.ndarray  # (A + 1, 3)
    beam: np.ndarray  # (A, K, 3) unit directions in the LiDAR's frame
    firing: np.ndarray  # (K,) instants within a column, as a share of it
    noise: np.ndarray  # (A, K) m
    reach: tuple[float, float]  # m


class _Points(NamedTuple):
    """Where a sweep's points go, at most A K."""

    xyz: np.ndarray
    offset_s: np.ndarray
    plane: np.ndarray


def scan_room(
    room: Room,
    lidar: SimLidar,
    trajectory: TrueTrajectory,
    scenario: Scenario,
    seed: list[int],
    progress: Callable[[float], None],
) -> LidarStream:
    """All scans that one LiDAR takes of the room; each scan's noise is a random stream of its own."""
    stamps, seconds = stamped(lidar, scenario.duration_s - LEAD_S - 1.0 / lidar.rate_hz)
    noise_m = lidar.range_noise_m * float(scenario.robot_noise_enabled)
    capacity = lidar.azimuth_steps * lidar.rings
    start = np.zeros(len(stamps) + 1, dtype=np.int64)
    xyz = np.empty((len(stamps) * capacity, 3), dtype=np.float32)  # what stays empty takes no memory
    offset, plane = np.empty(len(xyz), dtype=np.float32), np.empty(len(xyz), dtype=np.int32)
    for i, begin in enumerate(seconds):
        noise = noise_m * np.random.default_rng([*seed, i]).standard_normal((lidar.azimuth_steps, lidar.rings))
        sweep = _sweep(lidar, trajectory, begin, noise)
        free = slice(start[i], None)
        column_s = 1.0 / (lidar.rate_hz * lidar.azimuth_steps)
        start[i + 1] = start[i] + _shoot(room.surfaces, sweep, column_s, _Points(xyz[free], offset[free], plane[free]))
        progress((i + 1) / len(seconds))
    n = start[-1]
    return LidarStream(lidar.name, stamps, start, offset[:n], xyz[:n], plane[:n])


def _sweep(lidar: SimLidar, trajectory: TrueTrajectory, begin: float, noise: np.ndarray) -> _Sweep:
    steps, rings = lidar.azimuth_steps, lidar.rings
    column_s = 1.0 / (lidar.rate_hz * steps)
    rotation, position, _ = trajectory.pose_at(begin + column_s * np.arange(steps + 1))
    firing = np.arange(rings) * min(_FIRING_S / column_s, 1.0 / rings)
    return _Sweep(
        rotation @ lidar.T_imu_lidar[:3, :3],
        position + rotation @ lidar.T_imu_lidar[:3, 3],
        _beams(lidar),
        firing,
        noise,
        lidar.range_m,
    )


def _beams(lidar: SimLidar) -> np.ndarray:
    azimuth = 2.0 * np.pi * np.arange(lidar.azimuth_steps)[:, None] / lidar.azimuth_steps
    elevation = np.deg2rad(np.linspace(*lidar.elevation_deg, lidar.rings))
    level, up = np.cos(elevation), np.sin(elevation)
    return np.stack([level * np.cos(azimuth), level * np.sin(azimuth), up + 0.0 * azimuth], axis=2)


@njit(cache=True, nogil=True, error_model="numpy")
def _shoot(surfaces: RoomSurfaces, sweep: _Sweep, column_s: float, points: _Points) -> int:
    """Fills the points in the order of their instants; returns how many there are.

    Within a column, of some 0.1 ms, the pose runs straight: 5 m/s^2 and 2 rad/s bend it by 1e-8 m and rad.
    """
    count = 0
    d, p = np.empty(3), np.empty(3)
    for a in range(len(sweep.beam)):
        R0, R1, p0, p1 = sweep.rotation[a], sweep.rotation[a + 1], sweep.position[a], sweep.position[a + 1]
        for k in range(len(sweep.firing)):
            s, x, y, z = sweep.firing[k], sweep.beam[a, k, 0], sweep.beam[a, k, 1], sweep.beam[a, k, 2]
            for i in range(3):
                before = R0[i, 0] * x + R0[i, 1] * y + R0[i, 2] * z
                after = R1[i, 0] * x + R1[i, 1] * y + R1[i, 2] * z
                d[i] = before + s * (after - before)
                p[i] = p0[i] + s * (p1[i] - p0[i])
            distance, face = nearest(surfaces, p[0], p[1], p[2], d[0], d[1], d[2])
            if not (sweep.reach[0] <= distance <= sweep.reach[1]):
                continue
            measured = distance + sweep.noise[a, k]
            points.xyz[count, 0] = measured * x
            points.xyz[count, 1] = measured * y
            points.xyz[count, 2] = measured * z
            points.offset_s[count] = (a + s) * column_s
            points.plane[count] = face
            count += 1
    return count
