"""Projection uncertainty of a camera over its image [px], from the covariance of its intrinsics and distortion.

A large part of an error of the lens is a pose change: a shift of the principal point is a rotation. Extrinsics that
were estimated with the lens absorb that part. The pose change r that best absorbs each error db over the image is
therefore removed first, as mrcal does ("projection uncertainty", "implied rotation"; derived anew). With the covariance
P of the lens:

    r = K db,   K = -(sum Jr^T Jr)^-1 sum Jr^T Ji
    cov(q) = (Ji + Jr K) P (Ji + Jr K)^T

Ji = d q / d b for a fixed point, and Jr = d q / d r at the same pixel. Sums run over a grid of pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from icalib.geometry.cameras import camera_model
from icalib.geometry.cameras.base import CameraModel
from icalib.result.relative import joint_covariance

if TYPE_CHECKING:
    from icalib.result.calibration import Calibration

COLUMNS = 36  # cells across the image
FEWEST_SEEN = 12  # cells: fewer do not determine the pose change, so that the whole image is used


@dataclass(frozen=True)
class ProjectionMap:
    """Standard deviation, in its worst direction, of the projection of points at `range_m` [m] by `camera`. A rotation
    is removed, and at finite ranges a translation as well.

    u (n,), v (m,): middles of cells of the image [px]; sigma (m, n) [px], NaN where the model has no ray; seen (m, n):
    cells with corners or tracked points. The pose change is fitted over these, or over all if there are none.
    """

    camera: str
    range_m: float
    u: np.ndarray
    v: np.ndarray
    sigma: np.ndarray
    seen: np.ndarray

    @property
    def median_seen(self) -> float:
        """px, over the cells that are seen; over the whole image where there are none."""
        own = self.sigma[self.seen & np.isfinite(self.sigma)]
        return float(np.median(own)) if len(own) else float(np.nanmedian(self.sigma))

    @property
    def worst(self) -> tuple[float, float, float]:
        """px: the largest sigma, and u and v of its cell."""
        row, column = np.unravel_index(int(np.nanargmax(self.sigma)), self.sigma.shape)
        return float(self.sigma[row, column]), float(self.u[column]), float(self.v[row])


def projection_uncertainty(c: Calibration, camera: str, range_m: float = np.inf) -> ProjectionMap | None:
    """The map of one camera, from the covariance of its intrinsics and distortion, empirical factors included.

    None where the model has no ray in the whole image. Zero throughout where both are fixed by the rig file. Raises
    KeyError where `camera` was not calibrated.
    """
    lens = [c.group(camera, "intrinsics"), c.group(camera, "distortion")]
    model, (width, height) = camera_model(c.rig["sensors"][camera]["model"]), c.rig["sensors"][camera]["resolution"]
    n, m = COLUMNS, max(1, round(COLUMNS * height / width))
    u, v = (np.arange(n) + 0.5) * width / n - 0.5, (np.arange(m) + 0.5) * height / m - 0.5
    uv = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    seen = np.zeros((m, n), dtype=bool)
    for r in (r for r in c.image_residuals if r.sensor == camera):
        cell = ((r.uv[r.used] + 0.5) * [n / width, m / height]).astype(int)
        seen[np.clip(cell[:, 1], 0, m - 1), np.clip(cell[:, 0], 0, n - 1)] = True
    params = np.concatenate([g.value for g in lens])
    sigma = projection_std(model, params, joint_covariance(c, lens), uv, seen.ravel(), range_m)
    return ProjectionMap(camera, range_m, u, v, sigma.reshape(m, n), seen) if np.isfinite(sigma).any() else None


def projection_std(
    model: CameraModel,
    params: np.ndarray,
    covariance: np.ndarray,
    uv: np.ndarray,
    seen: np.ndarray,
    range_m: float = np.inf,
) -> np.ndarray:
    """(N,) px: standard deviation in the worst direction at pixels uv (N, 2), NaN where the model has no ray.

    params (P,), covariance (P, P); the camera's motion is fitted over the pixels `seen` (N,), over all where these are
    too few.
    """
    rays, valid = model.unproject(params, uv)
    points = rays * (range_m if np.isfinite(range_m) else 1.0)
    _, projected, j_point, j_params = model.project_with_jacobians(params, points)
    valid &= projected
    j_motion = j_point @ _moved_by(points, np.isfinite(range_m))
    used = valid & seen
    used = used if np.count_nonzero(used) >= FEWEST_SEEN else valid
    size = j_motion.shape[2]
    K = np.linalg.lstsq(j_motion[used].reshape(-1, size), -j_params[used].reshape(-1, len(params)), rcond=None)[0]
    left = j_params + j_motion @ K
    worst = np.linalg.eigvalsh(left @ covariance @ left.transpose(0, 2, 1))[:, -1]
    return np.where(valid, np.sqrt(np.maximum(worst, 0.0)), np.nan)


def _moved_by(points: np.ndarray, near: bool) -> np.ndarray:
    """(N, 3, 3): d points / d rotation; (N, 3, 6) of near ones, followed by translation in units of their distance."""
    x, y, z = points.T
    zero = np.zeros_like(x)
    turned = np.stack([zero, z, -y, -z, zero, x, y, -x, zero], axis=1).reshape(-1, 3, 3)
    if not near:
        return turned
    shifted = np.linalg.norm(points, axis=1)[:, None, None] * np.eye(3)
    return np.concatenate([turned, shifted], axis=2)


def working_distance(c: Calibration, camera: str) -> float | None:
    """m: median distance of `camera` from the target's first point while it saw the target, else from its tracked
    points; None where it saw neither."""
    own = [r for r in c.corner_residuals if r.sensor == camera and len(r.uv)]
    if not own:
        return next((r.distance for r in c.track_residuals if r.sensor == camera), None)
    path = c.trajectory
    seconds = own[0].seconds[np.diff(own[0].start) > 0]
    node = np.clip(np.searchsorted(path.seconds, seconds), 0, len(path.seconds) - 1)
    # The world's origin is the target's first point.
    centre = path.position[node] + path.rotation[node] @ c.group(camera, "translation").value
    return float(np.median(np.linalg.norm(centre, axis=1)))
