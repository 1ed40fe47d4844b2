"""A lens, the shape of the target and the poses of images together, by least squares over corners that are about in
place already."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.cameras.convert import fit_rays

UNSEEN_PX = 20.0  # what a corner that the model cannot see is taken to be off by, or it would learn to look away
MOST_ROUNDS, MOST_DAMPING = 40, 1e8
SETTLED = 1e-5  # of the sum of squares
START_CORNERS = 1500  # to start from; more do not make a start better


@dataclass(frozen=True)
class ImagePoints:
    """Points (N, 3) [m] in the camera frame, where an estimate has them, seen at uv (N, 2) [px]; those of image i are
    start[i]:start[i + 1], at least one each. basis (N, 3, s): how they move with what the shape of the target differs
    from that of the estimate by."""

    points: np.ndarray
    uv: np.ndarray
    start: np.ndarray
    basis: np.ndarray

    @property
    def image(self) -> np.ndarray:
        """(N,) the image of each point."""
        return np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))

    def moved(self, motion: np.ndarray, shape: np.ndarray) -> ImagePoints:
        """With another `shape` (s,), after each image's turn and shift (M, 6)."""
        turn = np.array([so3.exp(np.ascontiguousarray(m[:3])) for m in motion])[self.image]
        points = np.einsum("nij,nj->ni", turn, self.points + self.basis @ shape) + motion[self.image, 3:]
        return ImagePoints(points, self.uv, self.start, turn @ self.basis)

    def total(self, values: np.ndarray) -> np.ndarray:
        """(M, ...) sums of values (N, ...) by image."""
        return np.add.reduceat(values, self.start[:-1], axis=0)


def started(model: CameraModel, other: CameraModel, params: np.ndarray, seen: ImagePoints) -> Iterator[np.ndarray]:
    """Parameters of `model` from each of its starts that project the points as near as may be to where they are seen.
    The scale in the middle is that of `other` with `params`."""
    few = slice(None, None, max(len(seen.uv) // START_CORNERS, 1))
    points, uv = seen.points[few], seen.uv[few]
    for distortion in model.start_distortions:
        start = np.array([*params[:4], *distortion])
        start[:2] *= other.central_scale(params) / model.central_scale(start)
        visible = model.project(start, points)[1]
        if 2 * visible.sum() > len(uv):
            with suppress(np.linalg.LinAlgError):
                yield fit_rays(model, start, points[visible], uv[visible])


def adjust(
    model: CameraModel, params: np.ndarray, seen: ImagePoints, fixed: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Parameters (P,), a change of the target's shape (s,), and the squared error (M,) [px^2] that each image is left
    with. Levenberg-Marquardt over these and a motion of each image's points, which is eliminated. With a `fixed` shape
    (s,) the poses alone are fitted, and the parameters stay.

    Raises numpy.linalg.LinAlgError where an image's corners do not tell its pose.
    """
    shape, n = np.zeros(seen.basis.shape[2]), len(params)
    if fixed is not None:
        shape, n, seen = fixed, 0, seen.moved(np.zeros((len(seen.start) - 1, 6)), fixed)
    here, damping = _linearised(model, params, seen, fixed is None), 1e-4
    for _ in range(MOST_ROUNDS):
        step, motion = _step(*here, seen, damping)
        trial = params + step[:n] if n else params
        moved = seen.moved(motion, step[n:] if n else np.zeros(len(shape)))
        there = _linearised(model, trial, moved, fixed is None)
        before, after = (float((r**2).sum()) for r, _ in (here, there))
        if after < before:
            params, seen, here = trial, moved, there
            shape = shape + step[n:] if n else shape
            damping *= 0.1
            if before - after < SETTLED * before:
                break
        else:
            damping *= 10.0
            if damping > MOST_DAMPING:
                break
    return params, shape, seen.total((here[0] ** 2).sum(axis=1))


def _linearised(
    model: CameraModel, params: np.ndarray, seen: ImagePoints, whole: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, 2) [px], and their derivatives (N, 2, 6 + P + s) by a small turn and shift of the points in the
    camera frame, and on the `whole` by parameters and shape."""
    projected, valid, J_point, J_params = model.project_with_jacobians(params, seen.points)
    residual = np.where(valid[:, None], projected - seen.uv, np.sqrt(0.5) * UNSEEN_PX)
    J_turn = np.cross(seen.points[:, None, :], J_point)
    return residual, np.concatenate([J_turn, J_point, *((J_params, J_point @ seen.basis) if whole else ())], axis=2)


def _step(residual: np.ndarray, J: np.ndarray, seen: ImagePoints, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Of what all images share (n,), and of each image's turn and shift (M, 6)."""
    A, B = J[:, :, :6], J[:, :, 6:]
    H, C = (seen.total(np.einsum("nki,nkj->nij", A, x)) for x in (A, B))
    g = seen.total(np.einsum("nki,nk->ni", A, residual))
    diagonal = np.einsum("mii->mi", H)
    diagonal *= 1.0 + damping
    diagonal += 1e-12 * diagonal.max(axis=1, keepdims=True)
    solved = np.linalg.solve(H, np.concatenate([C, g[:, :, None]], axis=2))
    S = np.einsum("nki,nkj->ij", B, B) - np.einsum("mki,mkj->ij", C, solved[:, :, :-1])
    b = np.einsum("nki,nk->i", B, residual) - np.einsum("mki,mk->i", C, solved[:, :, -1])
    scale = np.sqrt(np.maximum(np.einsum("nki,nki->i", B, B), 1e-300))
    scaled = S / scale[:, None] / scale + damping * np.eye(len(b))
    step = -np.linalg.lstsq(scaled, b / scale, rcond=1e-13)[0] / scale
    return step, -solved[:, :, -1] - np.einsum("mij,j->mi", solved[:, :, :-1], step)
