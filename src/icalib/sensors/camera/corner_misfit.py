"""Misfit of the lens model: the part of the corner residuals that is a function of the image position alone.

The residuals of a camera are averaged over cells of the image, in groups of consecutive images. Without misfit the
means of two groups are independent, with mean zero. So the mean product over pairs of different groups estimates the
squared misfit without bias (a U-statistic; Hoeffding 1948). Without misfit its variance is twice the sum of the squared
products over ordered pairs. That holds even if cells of one group share an error, such as one of the pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.data.measurements import CornerStream

# Columns and rows of cells in the bounding box of all corners. Smaller cells resolve finer misfit with more noise.
MISFIT_CELLS = (12, 8)
MAX_IMAGE_GROUPS = 200  # errors correlate between successive images, so groups must be long against the correlation
MIN_GROUPS_IN_CELL = 3  # groups with corners in a cell, below which the cell is left out
SIGNIFICANT_STD = 5.0  # standard deviations of the statistic under noise alone; a smaller misfit counts as zero


@dataclass(frozen=True)
class LensMisfit:
    """Misfit of one camera's lens model.

    rms [px]: RMS misfit per image axis over all corners, 0 if it is not significant. field (N, 2) [px]: mean residual,
    predicted - measured, in the cell of each corner; 0 in cells with too few groups.
    """

    rms: float
    field: np.ndarray


def lens_misfit(stream: CornerStream, residual: np.ndarray, used: np.ndarray) -> LensMisfit:
    """The misfit of one camera's lens model.

    residual (N, 2) [px]: predicted - measured; used (N,) bool: corners in use. The misfit is zero if it is not
    significant, or no corner is in use.
    """
    nothing = LensMisfit(0.0, np.zeros((len(used), 2), np.float32))
    if not used.any():
        return nothing
    cell, n, images = _cells(stream.uv, used), MISFIT_CELLS[0] * MISFIT_CELLS[1], len(stream.stamps_ns)
    group_of_image = np.arange(images) * min(images, MAX_IMAGE_GROUPS) // images
    n_groups = int(group_of_image[-1]) + 1
    key = (group_of_image * n).astype(np.int32)[stream.image[used]] + cell[used]
    count = np.bincount(key, minlength=n_groups * n).reshape(n_groups, n)
    means = np.stack([np.bincount(key, residual[used, k], n_groups * n) for k in range(2)], axis=1)
    means = means.reshape(n_groups, n, 2) / np.maximum(count, 1)[:, :, None]
    groups = (count > 0).sum(axis=0)
    enough = groups >= MIN_GROUPS_IN_CELL
    share = np.where(enough, count.sum(axis=0), 0.0)
    # products[a, b]: product of the means of groups a and b, summed over cells with their numbers of corners as
    # weights, over the number of pairs. Without misfit, off-diagonal entries have mean zero. The diagonal, which holds
    # the noise, is dropped.
    root = np.sqrt(share / max(share.sum(), 1.0) / np.maximum(groups * (groups - 1.0), 1.0))
    scaled = root[:, None] * means
    products = np.einsum("acx,bcx->ab", scaled, scaled, optimize=True)
    np.fill_diagonal(products, 0.0)
    square = float(products.sum())  # of both components together
    if not square > SIGNIFICANT_STD * np.sqrt(2.0 * float((products**2).sum())):
        return nothing
    mean = np.where(enough[:, None], means.sum(axis=0) / np.maximum(groups, 1)[:, None], 0.0)
    return LensMisfit(float(np.sqrt(0.5 * square)), mean.astype(np.float32)[cell])


def _cells(uv: np.ndarray, used: np.ndarray) -> np.ndarray:
    """(N,) int: cell of each corner uv (N, 2) px, in a grid over the bounding box of the `used` corners."""
    column, row = (_strips(uv[:, k], used, MISFIT_CELLS[k]) for k in range(2))
    return row * np.int16(MISFIT_CELLS[0]) + column


def _strips(x: np.ndarray, used: np.ndarray, count: int) -> np.ndarray:
    """(N,) int16 from 0 to `count` - 1: number of the interval of x (N,), when `count` equal ones span the `used` x."""
    used_x = x[used]
    low, size = used_x.min(), np.ptp(used_x) + 1e-9
    return np.clip((x - low) / size * count, 0, count - 1).astype(np.int16)
