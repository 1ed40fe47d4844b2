"""In how many directions the surfaces face that a LiDAR sees: what a floor, a single wall or a corridor cannot show."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.errors import EstimationError
from icalib.sensors.lidar.initialize.voxel_map import ScanPose, VoxelMap, insert

SCANS = 20
MOST_POINTS = 6000  # of a scan
VOXEL_M = 1.0
CAPACITY = 1 << 13
FEWEST_SCANS = 5  # with anything flat
LEAST_SHARE = 0.02  # of all points: 0.2 and more on walls across, 0.002 and less where noise alone tilts voxels
SEEN = {
    1: "face one direction only, such as a floor or parallel walls, so the motion along them is unobservable",
    2: "face two directions only, as in a corridor, so the motion along both is unobservable",
}


@contextmanager
def naming_sight(streams: Sequence[LidarStream]) -> Iterator[None]:
    """An EstimationError raised within speaks of what the LiDARs saw, where one saw too little to tell its motion."""
    try:
        yield
    except EstimationError as error:
        for stream in streams:
            if (faces := directions(stream)) in SEEN:
                raise EstimationError(
                    f"the flat surfaces that {stream.name} sees {SEEN[faces]}; record where walls and floor "
                    "face three directions, or together with a camera that sees a target."
                ) from error
        raise


def directions(stream: LidarStream) -> int:
    """How many directions, 1 to 3, flat surfaces face in most scans; 0 where hardly anything is flat."""
    filled = np.flatnonzero(np.diff(stream.start) > 0)
    some = filled[np.linspace(0, len(filled) - 1, min(SCANS, len(filled))).astype(np.int64)]
    found = [shares for i in some if (shares := _shares(stream, int(i))) is not None]
    return count_of(np.median(found, axis=0)) if len(found) >= FEWEST_SCANS else 0


def count_of(shares: np.ndarray) -> int:
    """Number of independent normal directions, from the shares of `facing`."""
    return int((shares > LEAST_SHARE).sum())


def _shares(stream: LidarStream, scan: int) -> np.ndarray | None:
    """(3,) of the points of a scan on surfaces that face each of three directions, across one another."""
    xyz = stream.xyz[stream.start[scan] : stream.start[scan + 1]].astype(np.float64)
    size2 = (xyz**2).sum(axis=1)
    xyz = xyz[np.isfinite(size2) & (size2 > 0.0)]
    xyz = xyz[:: -(-len(xyz) // MOST_POINTS) | 1]
    voxels = VoxelMap.empty(VOXEL_M, CAPACITY)
    here = ScanPose(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    insert(voxels, here, xyz, np.zeros(len(xyz)), 0, 1.0)
    normal, weight = voxels.normal[voxels.flat], voxels.weight[voxels.flat]
    return facing(normal, weight) if len(normal) else None


def facing(normal: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """(3,) shares of the weight (n,), increasing, of normals (n, 3) along their own axes."""
    return np.linalg.eigvalsh((normal * weight[:, None]).T @ normal / weight.sum())
