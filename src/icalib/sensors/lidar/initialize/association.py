"""Association of points with planes that several LiDARs share, repeated in each round of association and solve.

Each round transforms all points to the world by the current state, finds planes there, and associates points with them.
The tolerance allows for errors of that state. A plane keeps its name from round to round if it keeps its points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.detection.planes.planes import MOST_POINTS, ExtractedPlanes, PlaneSearch, find_planes
from icalib.errors import EstimationError
from icalib.motion.plane_association import PlaneAssociation
from icalib.motion.point_planes import count_points
from icalib.motion.sweep import EstimatedMotion
from icalib.optim.arrowhead import in_parallel
from icalib.optim.state import Key
from icalib.sensors.lidar.binning import in_world

POINTS_PER_PART = 200_000  # points of a thread at a time; bounds the memory
ASSOCIATION_ROUNDS = 4
# Assumed error of the state in each round: position [m], and rotation about the sensor [rad].
STATE_ERRORS = (0.03, 0.01, 0.003, 0.001)
MIN_PLANE_POINTS = 100  # points of a plane: with fewer, its normal is too uncertain to be of use
MIN_KEPT_POINTS = 0.5  # share of the associated points of a plane from the old plane whose name it keeps


@dataclass(frozen=True)
class AssociatedPlanes:
    """Points associated with planes. planes (P, 6): normal, and a point [m], in the world frame; ordered as the names
    in `association`."""

    association: PlaneAssociation
    planes: np.ndarray

    @property
    def values(self) -> dict[Key, np.ndarray]:
        """The planes as values of a state."""
        return {key: plane.copy() for key, plane in zip(self.association.keys, self.planes, strict=True)}


def round_search(k: int, noise_m: float) -> PlaneSearch:
    """Tolerances of the plane search in round k, counted from 0. noise_m: standard deviation of a point [m]."""
    error = STATE_ERRORS[min(k, len(STATE_ERRORS) - 1)]
    return PlaneSearch(noise_m=noise_m, position_m=error, angle_rad=error)


def associate(
    streams: Sequence[LidarStream], motion: EstimatedMotion, search: PlaneSearch, before: AssociatedPlanes | None = None
) -> AssociatedPlanes:
    """Planes and their points at the state of `motion`. A plane gets the name of the plane in `before` with which it
    shares most points. Raises EstimationError if there is no plane."""
    moved = [in_world(motion, s) for s in streams]
    planes = find_planes(*_thinned(moved), search)
    if not planes.count:
        names = " and ".join(s.name for s in streams)
        raise EstimationError(
            f"{names} saw no flat surface of {search.smallest_m2} m^2 or more; record among walls and floors, "
            "or check the point times."
        )
    plane = tuple(_plane_of_points(planes, points, origins, search) for points, origins in moved)
    association = PlaneAssociation(_plane_names(planes.count, plane, before and before.association), plane)
    return AssociatedPlanes(association, planes.planes.copy())


def association_of_streams(streams: Sequence[LidarStream]) -> PlaneAssociation:
    """The association that the streams contain, without planes of fewer than MIN_PLANE_POINTS points."""
    n_planes = max((int(s.plane.max(initial=-1)) for s in streams), default=-1) + 1
    count = sum((count_points(s.plane, n_planes) for s in streams), np.zeros(n_planes, dtype=np.int64))
    used = np.flatnonzero(count >= MIN_PLANE_POINTS)
    index = np.full(n_planes + 1, -1, dtype=np.int32)
    index[used] = np.arange(len(used))
    return PlaneAssociation(tuple(f"plane {k}" for k in used), tuple(index[s.plane] for s in streams))


def _thinned(clouds: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Points, and the positions from which they were seen, of all clouds together, thinned to at most MOST_POINTS. The
    step is odd, as an even step would select only some lasers of a spinning LiDAR."""
    step = odd_step(sum(len(points) for points, _ in clouds))
    points, origins = zip(*clouds, strict=True)
    return np.concatenate([p[::step] for p in points]), np.concatenate([s[::step] for s in origins])


def odd_step(points: int) -> int:
    """Odd step that thins `points` points to at most MOST_POINTS."""
    return -(-points // MOST_POINTS) | 1


def _plane_of_points(
    planes: ExtractedPlanes, points: np.ndarray, origins: np.ndarray, search: PlaneSearch
) -> np.ndarray:
    """(N,) int32 plane of each point, -1: none; see `ExtractedPlanes.of_points`. Uses two threads."""
    parts = [slice(a, a + POINTS_PER_PART) for a in range(0, len(points), POINTS_PER_PART)]
    numbers = in_parallel(lambda part: planes.of_points(points[part], origins[part], search), parts)
    return np.concatenate([np.zeros(0, np.int32), *numbers])


def _plane_names(count: int, plane: tuple[np.ndarray, ...], before: PlaneAssociation | None) -> tuple[str, ...]:
    """A name for each of `count` planes: that of the plane in `before` with which it shares most points, else a new
    one. plane: for each LiDAR, the plane (N,) of its points."""
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
        if not names[q] and name not in names and shared[q, k] > MIN_KEPT_POINTS * total[q]:
            names[q] = name
    number = 1 + max(int(name.removeprefix("plane ")) for name in before.names)
    for q in range(count):
        if not names[q]:
            names[q], number = f"plane {number}", number + 1
    return tuple(names)
