"""Bundle adjustment of tags, images and lenses: Levenberg-Marquardt, the images' poses eliminated (Schur complement).

It is for first guesses: robust, with broad priors on the lenses, which keep a small problem physically possible.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numba import njit

from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel

HUBER_PX = 2.0
UNSEEN_PX = 8.0  # a corner that the model cannot see counts as one so far off: looking away must not pay
LEAST_GAIN = 1e-4  # of the cost, by a step; smaller ones end the descent
MOST_DAMPING = 1e6
FIRST_DAMPING = 1e-3
RIDGE = 1e-9  # keeps the blocks of images with few corners regular


@dataclass(frozen=True)
class Lens:
    """A camera's parameters (P,); prior: Gaussian, mean and sigma (P,); free: (P,) bool."""

    model: CameraModel
    params: np.ndarray
    mean: np.ndarray
    sigma: np.ndarray
    free: np.ndarray


@dataclass(frozen=True)
class SceneState:
    """T_scene_cam of images (M, ...), T_scene_body of bodies (B, ...), and lenses. The scene is the frame of one fixed
    image."""

    R_image: np.ndarray
    p_image: np.ndarray
    R_body: np.ndarray
    p_body: np.ndarray
    lenses: tuple[Lens, ...]


@dataclass(frozen=True)
class SceneViews:
    """Corners by view, one body in one image: start (V + 1,), image, body (V,), points (N, 3) in the body's frame, uv
    (N, 2); camera (M,) the lens of each image."""

    start: np.ndarray
    image: np.ndarray
    body: np.ndarray
    points: np.ndarray
    uv: np.ndarray
    camera: np.ndarray

    @property
    def of_corner(self) -> np.ndarray:
        """(N,) the view that each corner belongs to."""
        return np.repeat(np.arange(len(self.image)), np.diff(self.start))

    def some(self, views: np.ndarray) -> SceneViews:
        """Those `views` (V,) bool only."""
        rows = views[self.of_corner]
        start = np.concatenate([[0], np.cumsum(np.diff(self.start)[views])])
        return replace(
            self,
            start=start,
            image=self.image[views],
            body=self.body[views],
            points=self.points[rows],
            uv=self.uv[rows],
        )


def adjust(seen: SceneViews, state: SceneState, fixed_image: int, rounds: int) -> SceneState:
    """`state` after up to `rounds` steps; bodies and images that are in no view of `seen` stay."""
    damping, sums = FIRST_DAMPING, _Sums.of(seen, state)
    for _ in range(rounds):
        trial = sums.step(seen, state, fixed_image, damping)
        after = None if trial is None else _Sums.of(seen, trial)
        if trial is None or after is None or not after.cost < sums.cost:
            damping *= 10.0
            if damping > MOST_DAMPING:
                break
            continue
        done = sums.cost - after.cost < LEAST_GAIN * sums.cost
        state, sums, damping = trial, after, 0.2 * damping
        if done:
            break
    return state


def errors(seen: SceneViews, state: SceneState) -> np.ndarray:
    """(N,) px: how far each corner is from where it is predicted; `UNSEEN_PX` at most."""
    size = np.full(len(seen.uv), UNSEEN_PX)
    local = _in_camera(seen, state)
    own = seen.camera[seen.image][seen.of_corner]
    for c, lens in enumerate(state.lenses):
        rows = np.flatnonzero(own == c)
        uv, valid = lens.model.project(lens.params, local[rows])
        off = np.linalg.norm(uv - seen.uv[rows], axis=1)
        size[rows] = np.where(valid, np.minimum(off, UNSEEN_PX), UNSEEN_PX)
    return size


def _in_camera(seen: SceneViews, state: SceneState) -> np.ndarray:
    """(N, 3) the corners' points in their cameras."""
    view = seen.of_corner
    i, k = seen.image[view], seen.body[view]
    scene = np.einsum("nij,nj->ni", state.R_body[k], seen.points) + state.p_body[k]
    return np.einsum("nji,nj->ni", state.R_image[i], scene - state.p_image[i])


@dataclass(frozen=True)
class _Sums:
    """Robust cost, and by view the Gram matrix (V, D, D) and gradient (V, D) over image (6), body (6) and lens."""

    cost: float
    gram: np.ndarray
    gradient: np.ndarray

    @classmethod
    def of(cls, seen: SceneViews, state: SceneState) -> _Sums:
        local, view = _in_camera(seen, state), seen.of_corner
        own = seen.camera[seen.image][view]
        most = max(len(lens.params) for lens in state.lenses)
        jacobian, residual = np.zeros((len(local), 2, 12 + most)), np.zeros((len(local), 2))
        valid = np.zeros(len(local), dtype=bool)
        for c, lens in enumerate(state.lenses):
            rows = np.flatnonzero(own == c)
            uv, ok, j_point, j_params = lens.model.project_with_jacobians(lens.params, local[rows])
            R = state.R_image[seen.image[view[rows]]].swapaxes(1, 2) @ state.R_body[seen.body[view[rows]]]
            j_body = j_point @ R
            jacobian[rows, :, 0:3] = np.cross(j_point, local[rows, None])
            jacobian[rows, :, 3:6] = -j_point
            jacobian[rows, :, 6:9] = np.cross(seen.points[rows, None], j_body)
            jacobian[rows, :, 9:12] = j_body
            jacobian[rows, :, 12 : 12 + j_params.shape[2]] = j_params * lens.free
            residual[rows], valid[rows] = uv - seen.uv[rows], ok
        size = np.where(valid, np.linalg.norm(residual, axis=1), UNSEEN_PX)
        weight = np.where(valid, np.minimum(1.0, HUBER_PX / np.maximum(size, 1e-12)), 0.0)
        cost = np.where(size > HUBER_PX, HUBER_PX * (size - 0.5 * HUBER_PX), 0.5 * size**2).sum()
        cost += sum(0.5 * (((lens.params - lens.mean) / lens.sigma) ** 2).sum() for lens in state.lenses)
        return cls(float(cost), *_grams(seen.start, jacobian, residual, weight))

    def step(self, seen: SceneViews, state: SceneState, fixed_image: int, damping: float) -> SceneState | None:
        """The state after one damped step; None where it cannot be solved."""
        first = 6 * len(state.R_body)
        begins = [first]
        for lens in state.lenses:
            begins.append(begins[-1] + len(lens.params))
        S, g = np.zeros((begins[-1], begins[-1])), np.zeros(begins[-1])
        for c, lens in enumerate(state.lenses):
            own = slice(begins[c], begins[c + 1])
            S[own, own] += np.diag(lens.free / lens.sigma**2)
            g[own] += lens.free * (lens.params - lens.mean) / lens.sigma**2
        images, bounds = np.unique(seen.image, return_index=True)
        eliminated = []
        for i, a, b in zip(images, bounds, [*bounds[1:], len(seen.image)], strict=True):
            c = seen.camera[i]
            lens = np.arange(begins[c], begins[c + 1])
            columns = np.concatenate([*(6 * seen.body[v] + np.arange(6) for v in range(a, b)), lens])
            block, slope = _of_image(self.gram[a:b], self.gradient[a:b], len(lens))
            S[np.ix_(columns, columns)] += block[6:, 6:]
            g[columns] += slope[6:]
            if i != fixed_image:
                own = block[:6, :6] + damping * np.diag(np.diag(block[:6, :6])) + RIDGE * np.eye(6)
                eliminated.append((i, columns, np.linalg.inv(own), block[:6, 6:], slope[:6]))
        diagonal = np.diag(S).copy()
        for _, columns, inverse, coupling, slope in eliminated:
            S[np.ix_(columns, columns)] -= coupling.T @ inverse @ coupling
            g[columns] -= coupling.T @ (inverse @ slope)
        S[np.diag_indices_from(S)] += np.where(diagonal > 0.0, damping * diagonal, 1.0)
        try:
            step = -np.linalg.solve(S, g)
        except np.linalg.LinAlgError:
            return None
        return _moved(state, step, begins, eliminated) if np.isfinite(step).all() else None


def _of_image(gram: np.ndarray, gradient: np.ndarray, n_lens: int) -> tuple[np.ndarray, np.ndarray]:
    """The normal equations of one image with k views over its pose, its bodies one after another, and its lens."""
    k = len(gram)
    n = 6 + 6 * k + n_lens
    block, slope, lens = np.zeros((n, n)), np.zeros(n), slice(6 + 6 * k, n)
    own = np.r_[0:6, 12 : 12 + n_lens]
    shared = np.r_[0:6, 6 + 6 * k : n]
    block[np.ix_(shared, shared)] = gram.sum(axis=0)[np.ix_(own, own)]
    slope[shared] = gradient.sum(axis=0)[own]
    for v in range(k):
        body = slice(6 + 6 * v, 12 + 6 * v)
        block[body, body], slope[body] = gram[v, 6:12, 6:12], gradient[v, 6:12]
        block[:6, body], block[body, :6] = gram[v, :6, 6:12], gram[v, 6:12, :6]
        block[lens, body], block[body, lens] = gram[v, 12 : 12 + n_lens, 6:12], gram[v, 6:12, 12 : 12 + n_lens]
    return block, slope


def _moved(state: SceneState, step: np.ndarray, begins: list[int], eliminated: Sequence[tuple]) -> SceneState:
    R, p = state.R_image.copy(), state.p_image.copy()
    for i, columns, inverse, coupling, slope in eliminated:
        d = -inverse @ (slope + coupling @ step[columns])
        R[i], p[i] = R[i] @ so3.exp(d[:3]), p[i] + R[i] @ d[3:]
    body = step[: begins[0]].reshape(-1, 6)
    turn = so3.exp_many(np.ascontiguousarray(body[:, :3]))
    p_body = state.p_body + np.einsum("kij,kj->ki", state.R_body, body[:, 3:])
    lenses = tuple(
        replace(lens, params=lens.params + np.where(lens.free, step[begins[c] : begins[c + 1]], 0.0))
        for c, lens in enumerate(state.lenses)
    )
    return SceneState(R, p, state.R_body @ turn, p_body, lenses)


@njit(cache=True, nogil=True, error_model="numpy")
def _grams(start, jacobian, residual, weight):
    """Gram matrices (V, D, D) and gradients (V, D) of the views."""
    n_views, d = len(start) - 1, jacobian.shape[2]
    gram, gradient = np.zeros((n_views, d, d)), np.zeros((n_views, d))
    for v in range(n_views):
        for n in range(start[v], start[v + 1]):
            if weight[n] == 0.0:
                continue
            for row in range(2):
                for a in range(d):
                    scaled = weight[n] * jacobian[n, row, a]
                    gradient[v, a] += scaled * residual[n, row]
                    for b in range(a + 1):
                        gram[v, a, b] += scaled * jacobian[n, row, b]
        for a in range(d):
            for b in range(a):
                gram[v, b, a] = gram[v, a, b]
    return gram, gradient
