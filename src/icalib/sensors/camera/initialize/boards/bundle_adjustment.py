"""Bundle adjustment of tags, images and lenses: Levenberg-Marquardt, the images' poses eliminated (Schur complement).

It is for first guesses: robust, with broad priors on the lenses, which keep a small problem physically possible.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel

HUBER_PX = 2.0
UNSEEN_PX = 8.0  # a corner that the model cannot see counts as one so far off: looking away must not pay
LEAST_GAIN = 1e-4  # of the cost, by a step; smaller ones end the descent
MOST_DAMPING = 1e6
FIRST_DAMPING = 1e-3
RIDGE = 1e-9  # keeps the blocks of images with few corners regular


@dataclass(frozen=True)
class CameraIntrinsics:
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
    lenses: tuple[CameraIntrinsics, ...]


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


def bundle_adjust(seen: SceneViews, state: SceneState, fixed_image: int, rounds: int) -> SceneState:
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


def reprojection_errors(seen: SceneViews, state: SceneState) -> np.ndarray:
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
        begins = [6 * len(state.R_body)]
        for lens in state.lenses:
            begins.append(begins[-1] + len(lens.params))
        S, g, diagonal = np.zeros((begins[-1], begins[-1])), np.zeros(begins[-1]), np.zeros(begins[-1])
        for c, lens in enumerate(state.lenses):
            own = slice(begins[c], begins[c + 1])
            diagonal[own] = lens.free / lens.sigma**2
            g[own] = lens.free * (lens.params - lens.mean) / lens.sigma**2
        S[np.diag_indices_from(S)] = diagonal
        edges = np.flatnonzero(np.diff(seen.image, prepend=-1, append=-1))  # of the views of one image
        camera, bounds = seen.camera[seen.image[edges[:-1]]], np.array(begins)
        fixed = seen.image[edges[:-1]] == fixed_image
        inverse, slope = _eliminate(
            self.gram, self.gradient, edges, seen.body, camera, bounds, fixed, damping, S, g, diagonal
        )
        S[np.diag_indices_from(S)] += np.where(diagonal > 0.0, damping * diagonal, 1.0)
        try:
            step = -np.linalg.solve(S, g)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        turns = _image_steps(self.gram, edges, seen.body, camera, bounds, step, inverse, slope)
        return _moved(state, step, begins, seen.image[edges[:-1]], turns)


def _moved(
    state: SceneState, step: np.ndarray, begins: list[int], images: np.ndarray, image_step: np.ndarray
) -> SceneState:
    R, p = state.R_image.copy(), state.p_image.copy()
    p[images] += np.einsum("nij,nj->ni", R[images], image_step[:, 3:])
    R[images] = R[images] @ so3.exp_many(np.ascontiguousarray(image_step[:, :3]))
    body = step[: begins[0]].reshape(-1, 6)
    turn = so3.exp_many(np.ascontiguousarray(body[:, :3]))
    p_body = state.p_body + np.einsum("kij,kj->ki", state.R_body, body[:, 3:])
    lenses = tuple(
        replace(lens, params=lens.params + np.where(lens.free, step[begins[c] : begins[c + 1]], 0.0))
        for c, lens in enumerate(state.lenses)
    )
    return SceneState(R, p, state.R_body @ turn, p_body, lenses)


@njit(cache=True, nogil=True, error_model="numpy")
def _columns(a, b, body, camera, begins, columns, own):
    """Columns of the calibration parameters that the views a..b of one image meet, the lens last, and where each view
    has them."""
    n = 0
    for v in range(a, b):
        for k in range(6):
            columns[n] = 6 * body[v] + k
            own[n] = 6 + k
            n += 1
    for k in range(begins[camera + 1] - begins[camera]):
        columns[n] = begins[camera] + k
        own[n] = 12 + k
        n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _eliminate(gram, gradient, edges, body, camera, begins, fixed, damping, S, g, diagonal):
    """Adds all images to the normal equations S (n, n), g (n,) of bodies and lenses, their poses eliminated (Schur
    complement), and to `diagonal` (n,) without that. Returns (images, 6, 6) inverse blocks and (images, 6) gradients,
    zero where an image is fixed."""
    m, most = len(edges) - 1, gram.shape[1] - 12
    inverse, slope = np.zeros((m, 6, 6)), np.zeros((m, 6))
    longest = 0
    for i in range(m):
        longest = max(longest, edges[i + 1] - edges[i])
    columns, own = np.empty(6 * longest + most, dtype=np.int64), np.empty(6 * longest + most, dtype=np.int64)
    for i in range(m):
        a, b = edges[i], edges[i + 1]
        n = _columns(a, b, body, camera[i], begins, columns, own)
        coupling, block = np.zeros((6, n)), RIDGE * np.eye(6)
        for v in range(a, b):
            first = 6 * (v - a)
            for j in range(n):
                if first <= j < first + 6 or j >= 6 * (b - a):
                    g[columns[j]] += gradient[v, own[j]]
                    diagonal[columns[j]] += gram[v, own[j], own[j]]
                    for k in range(n):
                        if first <= k < first + 6 or k >= 6 * (b - a):
                            S[columns[j], columns[k]] += gram[v, own[j], own[k]]
                    for k in range(6):
                        coupling[k, j] += gram[v, k, own[j]]
            for j in range(6):
                slope[i, j] += gradient[v, j]
                for k in range(6):
                    block[j, k] += gram[v, j, k]
        if fixed[i]:
            slope[i] = 0.0
            continue
        for k in range(6):
            block[k, k] *= 1.0 + damping
        inverse[i] = np.linalg.inv(block)
        solved = inverse[i] @ coupling
        for j in range(n):
            for k in range(6):
                g[columns[j]] -= solved[k, j] * slope[i, k]
            for k in range(n):
                for q in range(6):
                    S[columns[j], columns[k]] -= coupling[q, j] * solved[q, k]
    return inverse, slope


@njit(cache=True, nogil=True, error_model="numpy")
def _image_steps(gram, edges, body, camera, begins, step, inverse, slope):
    """(images, 6) steps of the images' poses, from the `step` of bodies and lenses."""
    m = len(edges) - 1
    out = np.zeros((m, 6))
    for i in range(m):
        right = slope[i].copy()
        for v in range(edges[i], edges[i + 1]):
            for k in range(6):
                for j in range(6):
                    right[k] += gram[v, k, 6 + j] * step[6 * body[v] + j]
                for j in range(begins[camera[i] + 1] - begins[camera[i]]):
                    right[k] += gram[v, k, 12 + j] * step[begins[camera[i]] + j]
        out[i] = -(inverse[i] @ right)
    return out


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
