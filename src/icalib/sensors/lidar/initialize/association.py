"""Planes that several LiDARs share, and which of their points lie on which, found anew in every round of a solve.

Each round moves all points to where the last state has them, finds planes there and associates points with them,
allowing for what that state may be off. A plane keeps its name from round to round by the points that it keeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.detection.planes.planes import MOST_POINTS, FoundPlanes, PlaneSearch, find_planes
from icalib.errors import EstimationError
from icalib.motion.clouds import Clouds
from icalib.motion.sweep import Motion
from icalib.optim.arrowhead import in_parallel
from icalib.optim.state import Key
from icalib.sensors.lidar.binning import in_world

POINTS_AT_A_TIME = 200_000  # by one thread: what association needs beside the clouds stays small
ROUNDS = 4
MISPLACED = (0.03, 0.01, 0.003, 0.001)  # m, and rad about the sensor: what the states of the rounds may be off
LEAST_SHARED = 0.5  # of a plane's points that had a plane before


@dataclass(frozen=True)
class Association:
    """Which of the planes (P, 6), normal and a point on it in the world, each point lies on, in the order of their
    names."""

    clouds: Clouds
    planes: np.ndarray

    @property
    def values(self) -> dict[Key, np.ndarray]:
        return {key: plane.copy() for key, plane in zip(self.clouds.keys, self.planes, strict=True)}


def round_search(k: int, noise_m: float) -> PlaneSearch:
    """What to allow for in round k, counted from 0; noise_m of a point."""
    misplaced = MISPLACED[min(k, len(MISPLACED) - 1)]
    return PlaneSearch(noise_m=noise_m, position_m=misplaced, angle_rad=misplaced)


def associate(
    streams: Sequence[LidarStream], motion: Motion, search: PlaneSearch, before: Association | None = None
) -> Association:
    """Planes and points as the state of `motion` has them; names of planes are those of `before` where they share their
    points. Raises EstimationError where there is no plane."""
    moved = [in_world(motion, s) for s in streams]
    found = find_planes(*_thinned(moved), search)
    if not found.count:
        names = " and ".join(s.name for s in streams)
        raise EstimationError(
            f"{names} saw no flat surface of {search.smallest_m2} m^2 or more; record among walls and floors, "
            "or check the point times."
        )
    plane = tuple(_of_points(found, points, seen_from, search) for points, seen_from in moved)
    clouds = Clouds(_names(found.count, plane, before and before.clouds), plane)
    return Association(clouds, found.planes.copy())


def _thinned(clouds: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Points and where they were seen from, of all clouds together, as many as the search looks at; by an odd step, or
    only some of a spinning LiDAR's lasers would be left."""
    step = odd_step(sum(len(points) for points, _ in clouds))
    points, seen_from = zip(*clouds, strict=True)
    return np.concatenate([p[::step] for p in points]), np.concatenate([s[::step] for s in seen_from])


def odd_step(points: int) -> int:
    """Every how manyth of so many points makes no more than the search looks at."""
    return -(-points // MOST_POINTS) | 1


def _of_points(found: FoundPlanes, points: np.ndarray, seen_from: np.ndarray, search: PlaneSearch) -> np.ndarray:
    """(N,) int32 as `FoundPlanes.of_points` has it, on two threads."""
    parts = [slice(a, a + POINTS_AT_A_TIME) for a in range(0, len(points), POINTS_AT_A_TIME)]
    own = in_parallel(lambda part: found.of_points(points[part], seen_from[part], search), parts)
    return np.concatenate([np.zeros(0, np.int32), *own])


def _names(count: int, plane: tuple[np.ndarray, ...], before: Clouds | None) -> tuple[str, ...]:
    """One for each of `count` planes: that of the plane before with which it shares most points, else a new one."""
    if before is None:
        return tuple(f"plane {k}" for k in range(count))
    shared = np.zeros((count, len(before.names)), dtype=np.int64)
    for now, then in zip(plane, before.plane, strict=True):
        both = (now >= 0) & (then >= 0)
        shared += np.bincount(now[both] * np.int64(len(before.names)) + then[both], minlength=shared.size).reshape(
            shared.shape
        )
    total, names = shared.sum(axis=1), [""] * count
    for flat in np.argsort(-shared, axis=None, kind="stable"):
        q, k = divmod(int(flat), len(before.names))
        name = before.names[k]
        if not names[q] and name not in names and shared[q, k] > LEAST_SHARED * total[q]:
            names[q] = name
    number = 1 + max(int(name.removeprefix("plane ")) for name in before.names)
    for q in range(count):
        if not names[q]:
            names[q], number = f"plane {number}", number + 1
    return tuple(names)
