"""Clusters of corners and of track observations whose errors may correlate: by image cell, target region, or track.

Misfit of the lens model, and deviations of the target from its stated shape, cause the same errors throughout a
recording. So each region of the image or of the target is a cluster. Errors within a feature track correlate as well,
because all its views are aligned with the first one. So groups of whole tracks are clusters, too. Clusters serve a
cluster-robust covariance (Liang and Zeger 1986).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.model.sensor_model import Clusters
from icalib.motion.factor import FactorKey
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.residual import FeatureFactor

IMAGE_CELLS = (4, 3)  # columns and rows of the grid of image cells
TARGET_REGIONS = 3  # number of regions along each side of a body
TRACK_GROUPS = 24  # a variance from n groups has a relative error of sqrt(2 / n); the cost grows with n


def error_clusters(cameras: tuple[CornerFactor, ...], features: tuple[FeatureFactor, ...]) -> Iterator[Clusters]:
    """Yields clusterings by image cell, by target region, by corner of a tag, and by group of feature tracks.

    Clusterings of corners are left out if no camera sees a target, that of tracks if there are none."""
    cornered = any(c.sees_target for c in cameras)
    if cornered or features:
        yield Clusters(image_cells(cameras, features))
    if cornered:
        yield Clusters({c.key: _target_regions(c) for c in cameras})
        yield Clusters({c.key: _tag_corners(c, k) for k, c in enumerate(cameras)})
    if features:
        # Groups by feature number have all views of a feature, by all cameras. Corners are in no group.
        groups = {f.key: [(s.feature % TRACK_GROUPS).astype(np.int32) for s in f.streams] for f in features}
        yield Clusters(groups, is_sample=True)


def image_cells(
    cameras: tuple[CornerFactor, ...], features: tuple[FeatureFactor, ...]
) -> dict[FactorKey, np.ndarray | list[np.ndarray]]:
    """Image cell of each corner, and of each track observation by camera; both share the cells of their camera."""
    clusters: dict[FactorKey, np.ndarray | list[np.ndarray]] = {}
    tracks: dict[FactorKey, list[np.ndarray]] = {f.key: [] for f in features}
    for index, camera in enumerate(cameras):
        n = len(camera.stream.uv)
        cells = _cells(np.concatenate([camera.stream.uv, *(f.streams[index].uv for f in features)]), index)
        clusters[camera.key] = cells[:n]
        for f in features:
            tracks[f.key].append(cells[n:])
    return tracks | clusters


def _cells(uv: np.ndarray, index: int) -> np.ndarray:
    """(N,) index of the cell of each point uv (N, 2) px of camera `index`, in a grid over the bounding box of uv.

    Cells of different cameras have different indices."""
    columns, rows = IMAGE_CELLS
    low, high = uv.min(axis=0, initial=np.inf), uv.max(axis=0, initial=-np.inf) + 1e-9
    x, y = (((uv[:, k] - low[k]) / (high - low)[k] * IMAGE_CELLS[k]).astype(np.int32) for k in range(2))
    return (index * rows + y) * columns + x


def _target_regions(camera: CornerFactor) -> np.ndarray:
    """(N,) index of the target region of each corner, the same for all cameras.

    Bodies that do not bend, such as single tags, are one region."""
    target = camera.bodies.target
    region, count = np.zeros(len(target.points), dtype=np.int32), 0
    for k in camera.bodies.used:
        points = target.body == k
        xy = target.points[points, :2]
        low, high = xy.min(axis=0), xy.max(axis=0) + 1e-9
        sides = TARGET_REGIONS if target.bends[k] else 1
        cell = ((xy - low) / (high - low) * sides).astype(int)
        region[points] = count + cell[:, 1] * sides + cell[:, 0]
        count += sides**2
    return region[camera.stream.point]


def _tag_corners(camera: CornerFactor, index: int) -> np.ndarray:
    """(N,) index of each corner among the four of its tag, plus 4 `index` for camera `index`.

    Systematic errors of detectors differ between the four corners."""
    corner = camera.bodies.target.point_identity(camera.stream.point)[1]
    return 4 * index + (corner % 4).astype(np.int32)
