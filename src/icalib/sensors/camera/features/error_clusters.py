"""Clusters of corners and of track observations whose errors may correlate: by image cell, target region, or track.

A lens that its model does not follow, and a target that is not as drawn, make the same errors in all parts of a
recording. A region of the image or of the target is then a cluster. Errors of one feature track correlate as well: all
its views are aligned with the same first one. So groups of whole tracks are clusters, too (Liang and Zeger 1986).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from icalib.model.sensor_model import Clusters
from icalib.motion.factor import FactorKey
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.residual import FeatureFactor

IMAGE_CELLS = (4, 3)  # columns, rows
TARGET_REGIONS = 3  # along each side of a body
TRACK_GROUPS = 24  # their spread knows a variance to 1 / sqrt(12); twice as many, to 1 / sqrt(24) at twice the cost


def error_clusters(cameras: tuple[CornerFactor, ...], features: tuple[FeatureFactor, ...]) -> Iterator[Clusters]:
    """Image cells, regions of the target, corners of tags, and groups of feature tracks, as far as there are any."""
    cornered = any(c.sees_target for c in cameras)
    if cornered or features:
        yield Clusters(image_cells(cameras, features))
    if cornered:
        yield Clusters({c.key: _target_regions(c) for c in cameras})
        yield Clusters({c.key: _tag_corners(c, k) for k, c in enumerate(cameras)})
    if features:
        # By feature number, so that all views of one, by all cameras, are in one group; corners are in none.
        groups = {f.key: [(s.feature % TRACK_GROUPS).astype(np.int32) for s in f.streams] for f in features}
        yield Clusters(groups, is_sample=True)


def image_cells(
    cameras: tuple[CornerFactor, ...], features: tuple[FeatureFactor, ...]
) -> dict[FactorKey, np.ndarray | list[np.ndarray]]:
    """Cells of the image of each camera. Corners, and observations of tracks by camera, are in the same cells."""
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
    """(N,) cell of camera number `index` for points uv (N, 2) px, in the rectangle that holds all of them."""
    columns, rows = IMAGE_CELLS
    low, high = uv.min(axis=0, initial=np.inf), uv.max(axis=0, initial=-np.inf) + 1e-9
    x, y = (((uv[:, k] - low[k]) / (high - low)[k] * IMAGE_CELLS[k]).astype(np.int32) for k in range(2))
    return (index * rows + y) * columns + x


def _target_regions(camera: CornerFactor) -> np.ndarray:
    """(N,) region of the target of each corner, the same for all cameras. Bodies that do not bend, such as single tags,
    are one region."""
    target = camera.bodies.target
    region, count = np.zeros(len(target.points), dtype=np.int32), 0
    for k in camera.bodies.used:
        own = target.body == k
        xy = target.points[own, :2]
        low, high = xy.min(axis=0), xy.max(axis=0) + 1e-9
        sides = TARGET_REGIONS if target.bends[k] else 1
        cell = ((xy - low) / (high - low) * sides).astype(int)
        region[own] = count + cell[:, 1] * sides + cell[:, 0]
        count += sides**2
    return region[camera.stream.point]


def _tag_corners(camera: CornerFactor, index: int) -> np.ndarray:
    """(N,) which of its tag's four corners each corner is, for camera number `index`: detectors err on each in its own
    way."""
    corner = camera.bodies.target.point_identity(camera.stream.point)[1]
    return 4 * index + (corner % 4).astype(np.int32)
