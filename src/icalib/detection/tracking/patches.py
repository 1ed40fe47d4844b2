"""Compiled: alignment of an image with the first view of each track.

A point tracked only from image to image drifts: its errors add up, and the estimator cannot detect that. Therefore each
image is aligned with the first view under an affine map (Shi and Tomasi, Good Features to Track, 1994). The map is
found by inverse compositional Gauss-Newton (Baker and Matthews, 2004). Grey levels are normalised by mean and contrast,
so that a change of exposure has no effect.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from icalib.base.compiled import njit

RADIUS = 7  # px; a patch has 15 x 15 px
SIDE = 2 * RADIUS + 1
CONVERGED_PX = 0.02  # shift by the last step, below which the alignment has converged
MOST_ALIGNMENT_STEPS = 12
LEAST_TEXTURE = 1.0  # least standard deviation of the grey levels of a patch; less is noise


class Templates(NamedTuple):
    """First views of n tracks, patches of SIDE x SIDE px.

    grey (n, SIDE, SIDE) float32: grey levels, mean 0 and standard deviation 1; slope (n, SIDE, SIDE, 2) float32: their
    derivatives by x and y, per px; inverse (n, 6, 6): inverse of the normal matrix of the affine map; spread (n,) px^2:
    second moment of the patch along each axis, weighted as in the alignment.
    """

    grey: np.ndarray
    slope: np.ndarray
    inverse: np.ndarray
    spread: np.ndarray

    def some(self, kept: np.ndarray) -> Templates:
        """The templates selected by `kept`, indices or a mask."""
        return Templates(*(column[kept] for column in self))

    def joined(self, other: Templates) -> Templates:
        """These templates, followed by the `other` ones."""
        return Templates(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def no_templates() -> Templates:
    """Templates of no tracks."""
    return Templates(
        np.zeros((0, SIDE, SIDE), np.float32),
        np.zeros((0, SIDE, SIDE, 2), np.float32),
        np.zeros((0, 6, 6)),
        np.zeros(0),
    )


def cut_templates(image: np.ndarray, uv: np.ndarray) -> tuple[Templates, np.ndarray]:
    """Templates around whole pixels uv (n, 2) of an image (h, w) float32, and a mask (n,) of those with texture in two
    directions. Pixels must be at least RADIUS + 1 px inside the image."""
    n = len(uv)
    grey, slope = np.empty((n, SIDE, SIDE), np.float32), np.empty((n, SIDE, SIDE, 2), np.float32)
    normal = np.empty((n, 6, 6))
    contrast = _cut(image, np.rint(uv).astype(np.int64), grey, slope, normal)
    normal[:, range(6), range(6)] += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None] + 1e-12
    good = (contrast > LEAST_TEXTURE) & (np.linalg.cond(normal) < 1e8)
    normal[~good] = np.eye(6)
    inverse = np.linalg.inv(normal)
    return Templates(grey, slope, inverse, _spread(slope, inverse)), good


def _spread(slope: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """(n,) px^2: second moment of each patch along an axis, weighted as in the alignment. It is the shift that the
    affine alignment estimates for a displacement q(x) = x_a^2, averaged over both axes a and both components of q."""
    y, x = np.mgrid[-RADIUS : RADIUS + 1, -RADIUS : RADIUS + 1].astype(np.float64)
    by_x, by_y = slope[..., 0], slope[..., 1]
    rows = np.stack([by_x * x, by_x * y, by_y * x, by_y * y, by_x, by_y], axis=-1)
    square = np.stack([x * x, y * y])
    products = np.einsum("nija,nijk,qij->nkqa", rows, slope, square, optimize=True)
    shift = np.einsum("nka,nkqa->nkq", inverse[:, 4:], products)
    return np.clip(shift.mean(axis=(1, 2)), 0.0, None)


@njit(cache=True, nogil=True)
def _cut(image, at, grey, slope, normal):
    """Fills grey, slope and normal; returns the contrast (n,) of each patch."""
    contrast = np.empty(len(at))
    for n in range(len(at)):
        c, r = at[n, 0], at[n, 1]
        total, square = 0.0, 0.0
        for i in range(SIDE):
            for j in range(SIDE):
                value = image[r + i - RADIUS, c + j - RADIUS]
                total += value
                square += value * value
        mean = total / SIDE**2
        contrast[n] = np.sqrt(max(square / SIDE**2 - mean * mean, 0.0))
        scale = 1.0 / max(contrast[n], 1e-6)
        normal[n] = 0.0
        row = np.empty(6)
        for i in range(SIDE):
            for j in range(SIDE):
                y, x = r + i - RADIUS, c + j - RADIUS
                grey[n, i, j] = (image[y, x] - mean) * scale
                slope[n, i, j, 0] = 0.5 * scale * (image[y, x + 1] - image[y, x - 1])
                slope[n, i, j, 1] = 0.5 * scale * (image[y + 1, x] - image[y - 1, x])
                _affine_row(slope[n, i, j], i - RADIUS, j - RADIUS, row)
                for a in range(6):
                    for b in range(6):
                        normal[n, a, b] += row[a] * row[b]
    return contrast


@njit(cache=True, nogil=True, inline="always")
def _affine_row(slope, dy, dx, row):
    """Derivatives of a grey level by the affine map (a00, a01, a10, a11, tx, ty): x' = x + A x + t."""
    row[0], row[1], row[4] = slope[0] * dx, slope[0] * dy, slope[0]
    row[2], row[3], row[5] = slope[1] * dx, slope[1] * dy, slope[1]


@njit(cache=True, nogil=True)
def align(image, templates, uv, A, ncc):
    """Aligns the image (h, w) float32 with the templates, from the start values uv (n, 2) px and A (n, 2, 2), which are
    updated.

    The point x of a template is at uv + A x in the image. Fills ncc (n,): correlation of both, or -1 if the patch
    leaves the image, has too little contrast, or the iteration does not converge.
    """
    patch, row, b, step = np.empty((SIDE, SIDE)), np.empty(6), np.empty(6), np.empty(6)
    for n in range(len(uv)):
        ncc[n] = -1.0
        for _ in range(MOST_ALIGNMENT_STEPS):
            correlation = _sample(image, uv[n], A[n], templates.grey[n], patch)
            if correlation < 0.0:
                break
            b[:] = 0.0
            for i in range(SIDE):
                for j in range(SIDE):
                    error = patch[i, j] - templates.grey[n, i, j]
                    _affine_row(templates.slope[n, i, j], i - RADIUS, j - RADIUS, row)
                    for a in range(6):
                        b[a] += row[a] * error
            for a in range(6):
                step[a] = 0.0
                for k in range(6):
                    step[a] += templates.inverse[n, a, k] * b[k]
            moved = _compose(uv[n], A[n], step)
            if moved < 0.0:
                break
            if moved < CONVERGED_PX:
                ncc[n] = correlation
                break


@njit(cache=True, nogil=True)
def _sample(image, uv, A, template, patch):
    """Fills `patch` (SIDE, SIDE) with the grey levels of the mapped patch, normalised to fit the template best. Returns
    the correlation with the template, -1 if the patch leaves the image or has too little contrast."""
    h, w = image.shape
    reach_x = RADIUS * (abs(A[0, 0]) + abs(A[0, 1]))
    reach_y = RADIUS * (abs(A[1, 0]) + abs(A[1, 1]))
    if not (uv[0] - reach_x >= 0.0 and uv[0] + reach_x < w - 1.0 and uv[1] - reach_y >= 0.0):
        return -1.0
    if not uv[1] + reach_y < h - 1.0:
        return -1.0
    total, square, product = 0.0, 0.0, 0.0
    for i in range(SIDE):
        for j in range(SIDE):
            dx, dy = j - RADIUS, i - RADIUS
            x, y = uv[0] + A[0, 0] * dx + A[0, 1] * dy, uv[1] + A[1, 0] * dx + A[1, 1] * dy
            c, r = int(x), int(y)
            p, q = x - c, y - r
            above = image[r, c] + p * (image[r, c + 1] - image[r, c])
            below = image[r + 1, c] + p * (image[r + 1, c + 1] - image[r + 1, c])
            value = above + q * (below - above)
            patch[i, j] = value
            total += value
            square += value * value
            product += value * template[i, j]
    mean = total / SIDE**2
    variance = square / SIDE**2 - mean * mean
    if not (variance > LEAST_TEXTURE**2 and product > 0.0):
        return -1.0
    # Scaled by the projection on the template: noise adds to the contrast, so a scale by contrast would be too small.
    scale = SIDE**2 / product
    for i in range(SIDE):
        for j in range(SIDE):
            patch[i, j] = (patch[i, j] - mean) * scale
    return product / SIDE**2 / np.sqrt(variance)


@njit(cache=True, nogil=True)
def _compose(uv, A, step):
    """Replaces the map (uv, A) by its composition with the inverse of the small map `step`. Returns the shift of uv
    [px], -1 if the step changes areas by a factor of four or more."""
    b00, b01, b10, b11 = 1.0 + step[0], step[1], step[2], 1.0 + step[3]
    determinant = b00 * b11 - b01 * b10
    if not 0.25 < determinant < 4.0:
        return -1.0
    i00, i01, i10, i11 = b11 / determinant, -b01 / determinant, -b10 / determinant, b00 / determinant
    a00, a01, a10, a11 = A[0, 0], A[0, 1], A[1, 0], A[1, 1]
    A[0, 0], A[0, 1] = a00 * i00 + a01 * i10, a00 * i01 + a01 * i11
    A[1, 0], A[1, 1] = a10 * i00 + a11 * i10, a10 * i01 + a11 * i11
    dx, dy = A[0, 0] * step[4] + A[0, 1] * step[5], A[1, 0] * step[4] + A[1, 1] * step[5]
    uv[0] -= dx
    uv[1] -= dy
    return np.sqrt(dx * dx + dy * dy)
