"""Residual statistics of the corners of one camera, and the degrees of freedom that the fit takes from them."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from icalib.motion.factor import FitKey, ResidualRows, Squares, StateDifference
from icalib.optim.arrowhead import in_parallel

if TYPE_CHECKING:
    from icalib.sensors.camera.corner_factor import CornerFactor, CornerOutput

CORNERS, SHIFT, DELAY = "corners", "common error", "stamp jitter"  # kinds of residuals


def corner_squares(camera: CornerFactor, out: CornerOutput) -> dict[FitKey, Squares]:
    """Number and chi^2 of the corners, and of the coefficients of each common error."""
    squares = {(camera.name, CORNERS): Squares(2 * int(np.count_nonzero(out.root)), camera.chi2(out))}
    for kind, coefficients in _shared_kinds(camera).items():
        rows = out.shared[:, coefficients] / camera.noise.tau[coefficients]
        squares[camera.name, kind] = Squares(rows.size, float((rows**2).sum()))
    return squares


def _shared_kinds(camera: CornerFactor) -> dict[str, slice]:
    """Coefficients of each kind of common error that is modelled: a shift has two, a delay one."""
    m = len(camera.noise.tau)
    shifts = m - m % 2
    kinds = {SHIFT: slice(0, shifts), DELAY: slice(shifts, m)}
    return {kind: part for kind, part in kinds.items() if part.start < part.stop}


def image_rows(
    sensor: str, kind: str, seconds: np.ndarray, residual: np.ndarray, sigma: np.ndarray, root: np.ndarray
) -> ResidualRows:
    """Residuals (n, 2) px of one sensor as `ResidualRows`.

    seconds (n,) s; sigma (n,) px per axis; root (n,) 1/px: square root of the robust weight, over sigma."""
    two = residual.shape
    sigma, root = np.broadcast_to(sigma[:, None], two), np.broadcast_to((root * sigma)[:, None], two)
    return ResidualRows(sensor, kind, "px", seconds, residual, sigma, residual / sigma, root)


def rms_px(residual: np.ndarray, root: np.ndarray) -> float | None:
    """RMS per axis of the residuals (N, 2) px with root (N,) > 0, the square root of the weight; None without any."""
    used = residual[root > 0.0]
    return float(np.sqrt(np.mean(used**2, dtype=np.float64))) if len(used) else None


def dof_used_by_corners(camera: CornerFactor, out: CornerOutput, along: StateDifference) -> dict[FitKey, float]:
    """See `Factor.dof_used`."""
    dof = in_parallel(partial(_dof_used_by_views, camera, out, along), camera.blocks())
    return {(camera.name, kind): sum(block[kind] for block in dof) for kind in (dof[0] if dof else ())}


def _dof_used_by_views(
    camera: CornerFactor, at: CornerOutput, step: StateDifference, views: tuple[int, int]
) -> dict[str, float]:
    """|J x|^2 of the range `views` by kind of residual, for the step x; the mean over common errors given x."""
    rows, n, m = camera.corners_of(*views), views[1] - views[0], len(camera.noise.tau)
    up, down = (camera.residual(state, *views) for state in (step.end, step.start))
    root, view = at.root[rows], camera.views.of_corners(*views) - views[0]
    along = (up - down) / step.share * root[:, None]
    if m == 0:
        return {CORNERS: float((along**2).sum())}
    # The common error c minimises |along + f c|^2 + |c / tau|^2; its covariance about the minimum is M^-1.
    f = camera.noise.field[rows] * root[:, None, None]
    M, rhs = np.zeros((n, m, m)), np.zeros((n, m))
    np.add.at(M, view, np.einsum("iak,ial->ikl", f, f))
    np.add.at(rhs, view, -np.einsum("iak,ia->ik", f, along))
    M += np.diag(1.0 / camera.noise.tau**2)
    inverse = np.linalg.inv(M)
    shared = np.einsum("vkl,vl->vk", inverse, rhs)
    total = float(((along + np.einsum("iak,ik->ia", f, shared[view])) ** 2).sum())
    total += float(np.einsum("iak,ikl,ial->", f, inverse[view], f))
    spent = (shared**2 + np.diagonal(inverse, axis1=1, axis2=2)).sum(axis=0) / camera.noise.tau**2
    return {CORNERS: total} | {kind: float(spent[part].sum()) for kind, part in _shared_kinds(camera).items()}
