"""Cluster-robust covariances, for errors that correlate within clusters such as a region of the image or of the target.

A lens that its model does not fit, or a target that is not as drawn, makes the same errors in all segments of a
recording. The scatter over segments does not show them. The gradient of a cluster would be zero but for noise.
Measurements in no cluster, such as those of the IMU, form one more cluster, unless the clusters are a sample (Liang and
Zeger 1986).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from icalib.estimate.problem.outcome import Outcome
from icalib.estimate.problem.problem import Problem
from icalib.estimate.residual_statistics.fit_statistics import spread_covariance
from icalib.model.sensor_model import all_models
from icalib.motion.factor import FactorKey
from icalib.optim.arrowhead import Piece


@dataclass(frozen=True)
class ClusterCovariances:
    """Cluster-robust covariances (B, B). regions: one for each way to divide images or target into regions, such as
    image cells. tracks: for groups of feature tracks, None without tracks."""

    regions: list[np.ndarray]
    tracks: np.ndarray | None


def cluster_covariances(problem: Problem, outcome: Outcome) -> ClusterCovariances:
    """Cluster-robust (sandwich) covariances of the calibration parameters."""
    every = [c for model in all_models() for c in model.clusters(problem.factors)]
    gradients = _cluster_gradients(problem, outcome, [c.of_factor for c in every]) if every else []
    regions, tracks = [], None
    for clusters, b in zip(every, gradients, strict=True):
        if clusters.is_sample:
            centred = b - b.mean(axis=0)
            tracks = len(b) / (len(b) - 1.0) * spread_covariance(problem, outcome, centred)
        else:
            regions.append(spread_covariance(problem, outcome, np.vstack([b, -b.sum(axis=0)])))
    return ClusterCovariances(regions, tracks)


def _count(clusters: Mapping[FactorKey, Any]) -> int:
    """Number of clusters."""
    arrays = [a for labels in clusters.values() for a in (labels if isinstance(labels, list) else [labels])]
    return 1 + max(int(a.max(initial=-1)) for a in arrays)


def _cluster_gradients(
    problem: Problem, outcome: Outcome, kinds: Sequence[Mapping[FactorKey, Any]]
) -> list[np.ndarray]:
    """Gradient of each cluster, (clusters, B) for each of `kinds`; chain and points are marginalised.

    Each cluster gets a column beside the calibration parameters, with its gradient as the right-hand side. Eliminating
    the chain and the points then marginalises all gradients at once.
    """
    counts = [_count(kind) for kind in kinds]
    B, state, at = problem.layout.size, outcome.state, problem.reusable_output(outcome.residuals)
    starts = B + np.cumsum([0, *counts])

    def segment(first: int, last: int) -> Piece:
        piece = problem.piece_with_columns(state, first, last, sum(counts), at)
        for kind, n, column in zip(kinds, counts, starts[:-1].tolist(), strict=True):
            for key, cluster in kind.items():
                factor: Any = problem.factors[key]  # it has `accumulate_clusters`
                factor.accumulate_clusters(state, piece, at[key], cluster, n, column)
        return piece

    rest = problem.marginal(segment)
    return [rest[:B, a:b].T for a, b in pairwise(starts)]
