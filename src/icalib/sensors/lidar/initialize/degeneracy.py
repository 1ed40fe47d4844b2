"""Geometric degeneracy of a scene: whether the flat surfaces that a LiDAR sees face fewer than three directions."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from icalib.data.measurements import LidarStream
from icalib.errors import EstimationError
from icalib.sensors.lidar.initialize.voxel_map import ScanPose, VoxelMap, insert

N_SAMPLED_SCANS = 20  # of a recording, evenly spread: enough for a median
MAX_SAMPLED_POINTS = 6000  # of a scan
NORMAL_VOXEL_M = 1.0  # edge of the voxels whose normals are counted
MAX_NORMAL_VOXELS = 1 << 13
MIN_PLANAR_SCANS = 5  # scans with planar voxels, for a verdict
MIN_DIRECTION_SHARE = 0.02  # of the points: 0.2 and more for a direction that walls face, 0.002 and less by noise
DEGENERACIES = {
    1: "face one direction only, such as a floor or parallel walls, so the motion along them is unobservable",
    2: "face two directions only, as in a corridor, so the motion along both is unobservable",
}


@contextmanager
def explaining_degeneracy(streams: Sequence[LidarStream]) -> Iterator[None]:
    """Context that replaces an EstimationError by one that names the degenerate scene, if a LiDAR saw such a scene."""
    try:
        yield
    except EstimationError as error:
        for stream in streams:
            if (n := n_directions(stream)) in DEGENERACIES:
                raise EstimationError(
                    f"the flat surfaces that {stream.name} sees {DEGENERACIES[n]}; record where walls and floor "
                    "face three directions, or together with a camera that sees a target."
                ) from error
        raise


def n_directions(stream: LidarStream) -> int:
    """Number of directions, 1 to 3, that flat surfaces face in most scans; 0 if few scans have flat surfaces."""
    filled = np.flatnonzero(np.diff(stream.start) > 0)
    some = filled[np.linspace(0, len(filled) - 1, min(N_SAMPLED_SCANS, len(filled))).astype(np.int64)]
    shares = [s for i in some if (s := _scan_shares(stream, int(i))) is not None]
    return count_directions(np.median(shares, axis=0)) if len(shares) >= MIN_PLANAR_SCANS else 0


def count_directions(shares: np.ndarray) -> int:
    """Number of independent directions that surfaces face, 0 to 3. shares (3,): see `normal_shares`."""
    return int((shares > MIN_DIRECTION_SHARE).sum())


def _scan_shares(stream: LidarStream, scan: int) -> np.ndarray | None:
    """`normal_shares` (3,) of a scan, weighted by points; None if no voxel is planar."""
    xyz = stream.xyz[stream.start[scan] : stream.start[scan + 1]].astype(np.float64)
    size2 = (xyz**2).sum(axis=1)
    xyz = xyz[np.isfinite(size2) & (size2 > 0.0)]
    xyz = xyz[:: -(-len(xyz) // MAX_SAMPLED_POINTS) | 1]
    voxels = VoxelMap.empty(NORMAL_VOXEL_M, MAX_NORMAL_VOXELS)
    identity = ScanPose(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))
    insert(voxels, identity, xyz, np.zeros(len(xyz)), 0, 1.0)
    normal, weight = voxels.normal[voxels.flat], voxels.weight[voxels.flat]
    return normal_shares(normal, weight) if len(normal) else None


def normal_shares(normal: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Shares (3,) of the total weight along the principal axes of normals, increasing: eigenvalues of the weighted mean
    of n n^T. normal (n, 3); weight (n,)."""
    return np.linalg.eigvalsh((normal * weight[:, None]).T @ normal / weight.sum())
