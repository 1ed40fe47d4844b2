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

import numpy as np

from icalib.estimate.evidence.evidence import spread_covariance
from icalib.estimate.problem.outcome import Outcome
from icalib.estimate.problem.problem import Problem
from icalib.optim.arrowhead import Piece
from icalib.sensors.camera.corner_factor import CornerFactor

IMAGE_CELLS = (4, 3)  # columns, rows
TARGET_PARTS = 3  # along each side
TRACK_GROUPS = 24  # their spread knows a variance to 1 / sqrt(12); twice as many, to 1 / sqrt(24) at twice the cost


@dataclass(frozen=True)
class Clusters:
    """By camera the cluster of every corner (N,) and of every observation of a track (M,); count: of clusters."""

    corners: list[np.ndarray]
    tracks: list[np.ndarray]

    @property
    def count(self) -> int:
        return 1 + max(int(c.max(initial=-1)) for c in (*self.corners, *self.tracks))


@dataclass(frozen=True)
class ClusterCovariances:
    """(B, B) covariances that allow for correlated errors: of `places`, which are image cells, parts of the target and
    corners of tags, one each; and of feature `tracks`, None where there are none."""

    places: list[np.ndarray]
    tracks: np.ndarray | None


def cluster_covariances(problem: Problem, outcome: Outcome) -> ClusterCovariances:
    """Cluster-robust (sandwich) covariances of the calibration parameters."""
    kinds, tracked = list(_kinds(problem)), problem.features is not None
    if not kinds:
        return ClusterCovariances([], None)
    if tracked:
        kinds.append(_track_groups(problem))
    gradients = _cluster_gradients(problem, outcome, kinds)
    places = gradients[:-1] if tracked else gradients
    places = [spread_covariance(problem, outcome, np.vstack([b, -b.sum(axis=0)])) for b in places]
    if not tracked:
        return ClusterCovariances(places, None)
    b = gradients[-1] - gradients[-1].mean(axis=0)
    return ClusterCovariances(places, len(b) / (len(b) - 1.0) * spread_covariance(problem, outcome, b))


def _kinds(problem: Problem) -> Iterator[Clusters]:
    cornered = any(len(c.stream.uv) for c in problem.cameras)
    if cornered or problem.features is not None:
        yield _image_cells(problem)
    if cornered:
        yield Clusters([_target_parts(c) for c in problem.cameras], [])
        yield Clusters([_tag_corners(c, k) for k, c in enumerate(problem.cameras)], [])


def _image_cells(problem: Problem) -> Clusters:
    """Cells of the image, cameras apart; corners and tracks in the same ones."""
    followed = [np.zeros((0, 2)) for _ in problem.cameras]
    if problem.features is not None:
        followed = [stream.uv for stream in problem.features.streams]
    corners, tracks = [], []
    for index, (camera, uv) in enumerate(zip(problem.cameras, followed, strict=True)):
        cells = _cells(np.concatenate([camera.stream.uv, uv]), index)
        corners.append(cells[: len(camera.stream.uv)])
        tracks.append(cells[len(camera.stream.uv) :])
    return Clusters(corners, tracks if problem.features is not None else [])


def _track_groups(problem: Problem) -> Clusters:
    """Features by number, so that all views of one, by all cameras, are in one group; corners in none of their own."""
    assert problem.features is not None
    corners = [np.zeros(len(c.stream.uv), dtype=np.int32) for c in problem.cameras]
    return Clusters(corners, [(s.feature % TRACK_GROUPS).astype(np.int32) for s in problem.features.streams])


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
    counts = [kind.count for kind in kinds]
    B, state, at = problem.layout.size, outcome.state, problem.scratch(outcome.residuals)
    starts = B + np.cumsum([0, *counts])

    def segment(first: int, last: int) -> Piece:
        piece = Piece.zeros(first, last, int(starts[-1]))
        narrow = problem.with_features(problem.narrow(piece, B))
        problem.add_measurements(state, narrow, at)
        problem.add_bias_prior(state, narrow)
        problem.hold_frames(state, narrow)
        piece.side[:, :, :B] = narrow.side[:, :, :B]
        piece.border[:B, :B] = narrow.border[:B, :B]
        if narrow.features is not None:
            piece = replace(piece, features=narrow.features.widened(int(starts[-1])))
        for kind, n, column in zip(kinds, counts, starts[:-1].tolist(), strict=True):
            for camera, corners, cluster in zip(problem.cameras, at.corners, kind.corners, strict=True):
                camera.accumulate_clusters(state, piece, corners, cluster, n, column)
            if problem.features is not None and at.features is not None and kind.tracks:
                problem.features.accumulate_clusters(state, piece, at.features, kind.tracks, n, column)
        return piece

    rest = problem.marginal(segment)
    return [rest[:B, a:b].T for a, b in pairwise(starts)]
