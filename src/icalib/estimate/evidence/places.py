"""What errors that stay with a place say of the formal standard deviations: of the image, of the target, of a tag.

A lens that the model cannot follow and a target that is not as drawn make the same errors in all parts of a recording,
and splitting it in time does not see them. What is seen in a place is a cluster, whose gradient would be zero but for
noise; the IMU and all other sensors are one more. Errors of one feature track are correlated as well: its views are
aligned with the same first one. Groups of whole tracks are clusters, too (Liang and Zeger 1986).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from icalib.estimate.evidence.evidence import spread_covariance
from icalib.estimate.problem.outcome import Outcome
from icalib.estimate.problem.problem import Problem
from icalib.motion.factor import FactorKey, of_type
from icalib.optim.arrowhead import Piece
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.feature_factor import FeatureFactor

IMAGE_CELLS = (4, 3)  # columns, rows
TARGET_PARTS = 3  # along each side
TRACK_GROUPS = 24  # their spread knows a variance to 1 / sqrt(12); twice as many, to 1 / sqrt(24) at twice the cost


Clusters = dict[FactorKey, Any]  # of each factor that has any, the cluster of every measurement


@dataclass(frozen=True)
class ClusterCovariances:
    """(B, B) covariances that allow for correlated errors: of `places`, which are image cells, parts of the target and
    corners of tags, one each; and of feature `tracks`, None where there are none."""

    places: list[np.ndarray]
    tracks: np.ndarray | None


def cluster_covariances(problem: Problem, outcome: Outcome) -> ClusterCovariances:
    """Cluster-robust (sandwich) covariances of the calibration parameters."""
    features = of_type(problem.factors, FeatureFactor)
    kinds = list(_kinds(problem))
    if not kinds:
        return ClusterCovariances([], None)
    # Features by number, so that all views of one, by all cameras, are in one group; corners are in none.
    kinds += [{f.key: [(s.feature % TRACK_GROUPS).astype(np.int32) for s in f.streams]} for f in features]
    gradients = _cluster_gradients(problem, outcome, kinds)
    places = gradients[:-1] if features else gradients
    places = [spread_covariance(problem, outcome, np.vstack([b, -b.sum(axis=0)])) for b in places]
    if not features:
        return ClusterCovariances(places, None)
    b = gradients[-1] - gradients[-1].mean(axis=0)
    return ClusterCovariances(places, len(b) / (len(b) - 1.0) * spread_covariance(problem, outcome, b))


def _kinds(problem: Problem) -> Iterator[Clusters]:
    cameras, features = of_type(problem.factors, CornerFactor), of_type(problem.factors, FeatureFactor)
    cornered = any(len(c.stream.uv) for c in cameras)
    if cornered or features:
        yield _image_cells(cameras, features)
    if cornered:
        yield {c.key: _target_parts(c) for c in cameras}
        yield {c.key: _tag_corners(c, k) for k, c in enumerate(cameras)}


def _image_cells(cameras: tuple[CornerFactor, ...], features: tuple[FeatureFactor, ...]) -> Clusters:
    """Cells of the image, cameras apart; corners and tracks in the same ones."""
    clusters: Clusters = {f.key: [] for f in features}
    for index, camera in enumerate(cameras):
        n = len(camera.stream.uv)
        cells = _cells(np.concatenate([camera.stream.uv, *(f.streams[index].uv for f in features)]), index)
        clusters[camera.key] = cells[:n]
        for f in features:
            clusters[f.key].append(cells[n:])
    return clusters


def _count(clusters: Clusters) -> int:
    arrays = [a for own in clusters.values() for a in (own if isinstance(own, list) else [own])]
    return 1 + max(int(a.max(initial=-1)) for a in arrays)


def _cells(uv: np.ndarray, index: int) -> np.ndarray:
    """(N,) cell of the part of image `index` in which there is anything."""
    columns, rows = IMAGE_CELLS
    low, high = uv.min(axis=0, initial=np.inf), uv.max(axis=0, initial=-np.inf) + 1e-9
    x, y = (((uv[:, k] - low[k]) / (high - low)[k] * IMAGE_CELLS[k]).astype(np.int32) for k in range(2))
    return (index * rows + y) * columns + x


def _target_parts(camera: CornerFactor) -> np.ndarray:
    """(N,) part of a body of the target, the same for all cameras; single tags are not divided."""
    target = camera.bodies.target
    part, parts = np.zeros(len(target.points), dtype=np.int32), 0
    for k in camera.bodies.used:
        own = target.body == k
        xy = target.points[own, :2]
        low, high = xy.min(axis=0), xy.max(axis=0) + 1e-9
        sides = TARGET_PARTS if target.bends[k] else 1
        cell = ((xy - low) / (high - low) * sides).astype(int)
        part[own] = parts + cell[:, 1] * sides + cell[:, 0]
        parts += sides**2
    return part[camera.stream.point]


def _tag_corners(camera: CornerFactor, index: int) -> np.ndarray:
    """(N,) which of its tag's four corners, cameras apart: what a detector does to each."""
    corner = camera.bodies.target.point_identity(camera.stream.point)[1]
    return 4 * index + (corner % 4).astype(np.int32)


def _cluster_gradients(problem: Problem, outcome: Outcome, kinds: list[Clusters]) -> list[np.ndarray]:
    """Of each of `kinds` of clusters (clusters, B), the gradient of each cluster; chain and points are marginalised."""
    counts = [_count(kind) for kind in kinds]
    B, state, at = problem.layout.size, outcome.state, problem.scratch(outcome.residuals)
    starts = B + np.cumsum([0, *counts])

    def segment(first: int, last: int) -> Piece:
        piece = Piece.zeros(first, last, int(starts[-1]))
        narrow = problem.attach(problem.narrow(piece, B))
        problem.add_measurements(state, narrow, at)
        problem.add_bias_prior(state, narrow)
        problem.hold_frames(state, narrow)
        piece.side[:, :, :B] = narrow.side[:, :, :B]
        piece.calib[:B, :B] = narrow.calib[:B, :B]
        if narrow.features is not None:
            piece = replace(piece, features=narrow.features.widened(int(starts[-1])))
        for kind, n, column in zip(kinds, counts, starts[:-1].tolist(), strict=True):
            for key, cluster in kind.items():
                factor: Any = problem.factors[key]  # of those that have clusters
                factor.accumulate_clusters(state, piece, at[key], cluster, n, column)
        return piece

    rest = problem.marginal(segment)
    return [rest[:B, a:b].T for a, b in pairwise(starts)]
