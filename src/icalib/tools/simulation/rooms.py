"""Simulated recordings of several LiDARs that stand still at several places of a room, a street or a corridor.

Surroundings are rectangles. Formulas are the obvious ones, by rays and planes in the world; none is the estimator's.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from icalib.data.measurements import LidarStream, Measurements
from icalib.rig import Lidar, Rig, by_name
from icalib.tools.simulation.motion import rotation_from_vector
from icalib.tools.simulation.stops import ONCE, Pauses, directions, nanoseconds, scans

Box = tuple[tuple[float, float, float], tuple[float, float, float], float]  # centre, size [m], yaw [deg]


def pose(rotation_deg: tuple[float, float, float], translation: tuple[float, float, float]) -> np.ndarray:
    """(4, 4) pose from a rotation vector [deg] and a translation [m]."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_from_vector(np.deg2rad(rotation_deg)), translation
    return T


ROOM: tuple[Box, ...] = (
    ((0.0, 0.0, 1.5), (9.0, 6.5, 3.0), 0.0),  # its walls, seen from inside
    ((3.2, 2.4, 1.0), (1.2, 0.6, 2.0), 10.0),
    ((-2.5, -2.4, 0.4), (1.8, 0.9, 0.8), -5.0),
    ((-3.6, 1.8, 0.9), (0.8, 1.1, 1.8), 25.0),
    ((1.0, -2.7, 0.5), (0.7, 0.7, 1.0), 40.0),
)
STREET: tuple[Box, ...] = (
    ((0.0, 0.0, -5.0), (400.0, 400.0, 10.0), 0.0),  # the ground
    ((-18.0, 14.0, 5.0), (22.0, 10.0, 10.0), 0.0),
    ((9.0, 15.5, 4.0), (24.0, 10.0, 8.0), 0.0),
    ((-8.0, -16.0, 6.0), (30.0, 12.0, 12.0), 2.0),
    ((22.0, -14.0, 4.0), (14.0, 9.0, 8.0), -8.0),
    ((6.0, 6.5, 0.75), (4.4, 1.8, 1.5), 3.0),
    ((-7.0, -6.8, 0.8), (4.6, 1.9, 1.6), -2.0),
)
CORRIDOR: tuple[Box, ...] = (((0.0, 0.0, 1.2), (400.0, 2.4, 2.4), 0.0),)


@dataclass(frozen=True)
class Surroundings:
    """LiDARs at rest. T_lidar0: of each LiDAR, by name, in the frame of the first. boxes: of the scene; places: largest
    distance [m] of stops from the origin along x and y. height_m: of the first LiDAR. rings, azimuth_steps,
    elevation_deg: of all LiDARs. range_noise_m: along the beam."""

    T_lidar0: Mapping[str, np.ndarray] = field(
        default_factory=lambda: {"lidar0": np.eye(4), "lidar1": pose((0.0, 40.0, 75.0), (-0.1, 0.55, -0.3))}
    )
    n_stops: int = 3
    boxes: tuple[Box, ...] = ROOM
    places: tuple[float, float] = (1.5, 1.0)
    height_m: float = 1.3
    rings: int = 16
    azimuth_steps: int = 900
    elevation_deg: tuple[float, float] = (-25.0, 15.0)
    range_noise_m: float = 0.02
    pauses: Pauses = ONCE

    def rig(self) -> Rig:
        """The rig that a user would write, without any true value."""
        return Rig(by_name(*(Lidar(name, "") for name in self.T_lidar0)))


def simulate_surroundings(scene: Surroundings, seed: int) -> Measurements:
    """The clouds of all stops."""
    rng = np.random.default_rng(seed)
    bodies = []
    for _ in range(scene.n_stops):
        x, y = np.array(scene.places) * rng.uniform(-1.0, 1.0, 2)
        bodies.append(pose((0.0, 0.0, rng.uniform(-180.0, 180.0)), (x, y, scene.height_m)))
    return Measurements.of_streams(*(_stream(scene, k, np.array(bodies), rng) for k in range(len(scene.T_lidar0))))


def _stream(scene: Surroundings, number: int, bodies: np.ndarray, rng: np.random.Generator) -> LidarStream:
    """The clouds of a LiDAR at `bodies` (n_stops, 4, 4) and on the way between them, each column at its instant."""
    name, T = list(scene.T_lidar0.items())[number]
    begins = scene.pauses.instants(scene.n_stops, scene.pauses.lidar_hz)
    column_s = np.arange(scene.azimuth_steps) * (scene.pauses.scan_s / scene.azimuth_steps)
    drawn = [_cloud(scene, scene.pauses.poses(bodies, t + column_s) @ T, rng) for t in begins]
    offset_s = column_s[np.concatenate([column for _, column in drawn])]
    stamps_ns = nanoseconds(begins + number * scene.pauses.late_s)
    return scans(name, stamps_ns, [cloud for cloud, _ in drawn], offset_s)


def _cloud(scene: Surroundings, T_world_lidar: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) measured points in the frame of the LiDAR, of the beams that hit something within 100 m, and their columns
    (N,). T_world_lidar (azimuth_steps, 4, 4): at the instant of each column of beams."""
    azimuth = 2.0 * np.pi * np.arange(scene.azimuth_steps)[:, None] / scene.azimuth_steps
    beams = directions(azimuth, np.deg2rad(np.linspace(*scene.elevation_deg, scene.rings)))
    column = np.repeat(np.arange(scene.azimuth_steps), scene.rings)
    T = T_world_lidar[column]
    rays, origin = (T[:, :3, :3] @ beams[:, :, None])[:, :, 0], T[:, :3, 3]
    distance = np.min([_to_box(box, origin, rays) for box in scene.boxes], axis=0)
    hit = distance < 100.0
    measured = distance[hit] + scene.range_noise_m * rng.standard_normal(int(hit.sum()))
    return beams[hit] * measured[:, None], column[hit]


def _to_box(box: Box, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """(n,) distances from `origin` (n, 3) along `rays` (n, 3) to the next side of a box, from outside or inside;
    infinite where they miss it."""
    centre, size, yaw = box
    R = pose((0.0, 0.0, yaw), (0.0, 0.0, 0.0))[:3, :3]
    o, d = (origin - centre) @ R, rays @ R
    d = np.where(np.abs(d) < 1e-12, 1e-12, d)
    both = np.stack([(-0.5 * np.array(size) - o) / d, (0.5 * np.array(size) - o) / d])
    enter, leave = both.min(axis=0).max(axis=1), both.max(axis=0).min(axis=1)
    hit = (enter < leave) & (leave > 0.0)
    return np.where(hit, np.where(enter > 0.0, enter, leave), np.inf)
