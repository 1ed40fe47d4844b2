"""Residual statistics of feature tracks, and the degrees of freedom that the fit of points and parameters takes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from icalib.motion.factor import FitKey, RawSize, ResidualRows, Squares, StateDifference, output_at
from icalib.optim.state import State
from icalib.sensors.camera.corner_statistics import image_rows, rms_px
from icalib.sensors.camera.features.surfaces import ON_PLANES, PlaneDistances

if TYPE_CHECKING:
    from icalib.sensors.camera.features.residual import FeatureFactor

FEATURES = "features"  # kind of the residuals of tracks


@dataclass(frozen=True)
class FeatureOutput:
    """Residuals of all tracks.

    For each camera: residual (N, 2) px, predicted - measured; root (N,) 1/px, square root of the robust weight over
    sigma, 0 if not in use. points (T, 3) m, in the frames of their anchor cameras; off: their distances from planes."""

    residual: tuple[np.ndarray, ...]
    root: tuple[np.ndarray, ...]
    points: np.ndarray
    off: PlaneDistances


def feature_squares(factor: FeatureFactor, out: FeatureOutput) -> dict[FitKey, Squares]:
    """Number and chi^2 of the tracks of each camera, and of its points on planes if there are any."""
    squares, off = {}, out.off
    for i, (camera, residual, root) in enumerate(zip(factor.cameras, out.residual, out.root, strict=True)):
        chi2 = float(((residual * root[:, None]) ** 2).sum())
        squares[camera.name, FEATURES] = Squares(2 * int((root > 0.0).sum()), chi2)
        if len(on_planes := factor.on_planes_of(i)):
            chi2 = float(((off.residual * off.root)[on_planes] ** 2).sum())
            squares[camera.name, ON_PLANES] = Squares(len(on_planes), chi2)
    return squares


def feature_sizes(factor: FeatureFactor, out: FeatureOutput) -> dict[FitKey, RawSize]:
    """RMS of the tracks of each camera, and of its points on planes.

    Outliers count as rejected, but observations of tracks that are left out do not."""
    sizes = {}
    for i, camera in enumerate(factor.cameras):
        rejected = int(factor.outliers[i].sum()) if factor.outliers else 0
        sizes[camera.name, FEATURES] = RawSize(rms_px(out.residual[i], out.root[i]), "px", rejected)
        if len(on_planes := factor.on_planes_of(i)):
            sizes[camera.name, ON_PLANES] = RawSize(float(np.sqrt(np.mean(out.off.residual[on_planes] ** 2))), "m")
    return sizes


def feature_rows(factor: FeatureFactor, out: FeatureOutput, state: State) -> list[ResidualRows]:
    """Residuals of the tracks of each camera."""
    rows = []
    for camera, stream, sigma, residual, root in zip(
        factor.cameras, factor.streams, factor.sigmas, out.residual, out.root, strict=True
    ):
        seconds = camera.instants(state)[stream.image]
        rows.append(image_rows(camera.name, FEATURES, seconds, residual, sigma, root))
    return rows


def dof_used_by_features(factor: FeatureFactor, at: FeatureOutput, along: StateDifference) -> dict[FitKey, float]:
    """See `Factor.dof_used`: |J x|^2 of the tracks of each camera, with re-optimised points, plus the share of points.

    Each point takes three degrees of freedom: its plane's share from the plane residual, the rest from the cameras in
    proportion to their observations."""
    end, count = output_at(factor, along.end), np.zeros(factor.tracks.count)
    used = [root > 0.0 for root in at.root]
    for track, u in zip(factor.tracks.track, used, strict=True):
        count += np.bincount(track[u], minlength=len(count))
    spent = {}
    for i, camera in enumerate(factor.cameras):
        root, u = at.root[i], used[i]
        slope = (end.residual[i] - at.residual[i]) / along.share
        point_dof = float(((3.0 - at.off.share) / np.maximum(count, 1))[factor.tracks.track[i][u]].sum())
        spent[camera.name, FEATURES] = point_dof + float(((slope * root[:, None])[u] ** 2).sum())
        if len(on := factor.on_planes_of(i)):
            slope = (end.off.residual - at.off.residual)[on] / along.share * at.off.root[on]
            # A row takes 1 - E[chi^2]: w = weight / sigma^2, v is the point's variance along the normal by the cameras,
            # and s = w v / (1 + w v) the share. The fit of the point leaves E[chi^2] = w (1 - s)^2 (v + sigma^2).
            # weight < 1: all rows of one patch together have the weight of one row.
            left, weight = 1.0 - at.off.share[on], factor.on.weight[on]
            point_dof = float((1.0 - left * (left * weight + at.off.share[on])).sum())
            spent[camera.name, ON_PLANES] = point_dof + float((slope**2).sum())
    return spent
