"""Errors that corners share wherever in the image they are seen: what the model of a lens cannot follow.

The residuals of a camera are averaged over cells of the image, in groups of consecutive images. Where there is no
misfit, the means of two groups have nothing in common: the mean product of different groups is that of the misfit with
itself (a U-statistic; Hoeffding 1948). Its variance under noise is twice the sum of the squared products, whatever the
cells of one group share, as an error of the pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.measurements import CornerStream

CELLS = (12, 8)  # columns, rows of the part of the image that shows corners
GROUPS = 200  # of images, at most: consecutive ones of a video share errors
FEWEST_GROUPS = 3  # of a cell: fewer show nothing
SIGNIFICANT = 5.0  # standard deviations


@dataclass(frozen=True)
class Misfit:
    """rms: of either component over all corners [px], 0 where noise explains it; field (N, 2): the mean of each
    corner's cell [px], 0 where the cell shows none."""

    rms: float
    field: np.ndarray


def misfit(stream: CornerStream, residual: np.ndarray, used: np.ndarray) -> Misfit:
    """What residuals (N, 2) [px] of a camera's corners show of its lens, by those that are `used` (N,) bool."""
    nothing = Misfit(0.0, np.zeros((len(used), 2)))
    if not used.any():
        return nothing
    cell, n, images = _cells(stream.uv, used), CELLS[0] * CELLS[1], len(stream.stamps_ns)
    group = stream.image[used] * min(images, GROUPS) // images
    key, of, count = np.unique(group * n + cell[used], return_inverse=True, return_counts=True)
    means = _summed(residual[used].astype(np.float64), of, len(key)) / count[:, None]
    groups = np.bincount(key % n, minlength=n)
    told = groups >= FEWEST_GROUPS
    share = np.where(told, np.bincount(cell[used], minlength=n), 0.0)
    # Mean products of different groups' means of a cell, weighted by its corners: noise leaves 0 of each.
    scaled = np.zeros((int(group.max()) + 1, n, 2))
    root = np.sqrt(share / max(share.sum(), 1.0) / np.maximum(groups * (groups - 1.0), 1.0))
    scaled[key // n, key % n] = root[key % n, None] * means
    products = np.einsum("acx,bcx->ab", scaled, scaled, optimize=True)
    np.fill_diagonal(products, 0.0)
    beyond = float(products.sum())
    if not beyond > SIGNIFICANT * np.sqrt(2.0 * float((products**2).sum())):
        return nothing
    mean = _summed(means, key % n, n) / np.maximum(groups, 1)[:, None]
    return Misfit(float(np.sqrt(0.5 * beyond)), np.where(told[:, None], mean, 0.0)[cell])


def _summed(values: np.ndarray, group: np.ndarray, n: int) -> np.ndarray:
    """(n, 2) sums of values (N, 2) by group (N,)."""
    return np.stack([np.bincount(group, values[:, k], n) for k in range(2)], axis=1)


def _cells(uv: np.ndarray, used: np.ndarray) -> np.ndarray:
    """(N,) cell of each corner, of the part of the image that shows those `used`."""
    low, size = uv[used].min(axis=0), np.ptp(uv[used], axis=0) + 1e-9
    column, row = (np.clip((uv[:, k] - low[k]) / size[k] * CELLS[k], 0, CELLS[k] - 1).astype(int) for k in range(2))
    return row * CELLS[0] + column
