"""Initial guess of cameras that see a target of one or several bodies."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.base.compiled import njit
from icalib.geometry import so3
from icalib.geometry.cameras.base import CameraModel

SCENE_HUBER_PX = 2.0  # px; a few times the noise of detected corners
# px, the error of a corner that the model cannot project. Without this cost, poses that look away would fit best.
INVISIBLE_ERROR_PX = 8.0
SCENE_COST_TOLERANCE = 1e-4  # relative decrease of the cost at which the adjustment has converged
FIRST_SCENE_DAMPING, MAX_SCENE_DAMPING = 1e-3, 1e6  # relative to the diagonal of the normal matrix
POSE_RIDGE = 1e-9  # px^2, added to the diagonal of each pose block; keeps images with few corners regular


@dataclass(frozen=True)
class CameraIntrinsics:
    """Intrinsics and distortion of a camera, params (P,), in an adjustment.

    mean, sigma: (P,) of their Gaussian prior; free: (P,) bool, those that are adjusted.
    """

    model: CameraModel
    params: np.ndarray
    mean: np.ndarray
    sigma: np.ndarray
    free: np.ndarray


@dataclass(frozen=True)
class SceneState:
    """Poses T_scene_cam of M images and T_scene_body of B bodies, and intrinsics of the cameras.

    The scene frame is the camera frame of one fixed image.

    R_image (M, 3, 3), p_image (M, 3) [m], R_body (B, 3, 3), p_body (B, 3) [m].
    """

    R_image: np.ndarray
    p_image: np.ndarray
    R_body: np.ndarray
    p_body: np.ndarray
    lenses: tuple[CameraIntrinsics, ...]


@dataclass(frozen=True)
class SceneViews:
    """N corners in V views; a view is one body in one image, and the views of an image follow one another.

    start: (V + 1,), view v has the corners start[v]:start[v + 1]; image, body: (V,) indices for each view.
    points: (N, 3) [m] in the frames of the bodies; uv: (N, 2) [px]; camera: (M,) index of the camera of each image.
    """

    start: np.ndarray
    image: np.ndarray
    body: np.ndarray
    points: np.ndarray
    uv: np.ndarray
    camera: np.ndarray

    @property
    def of_corner(self) -> np.ndarray:
        """(N,) index of the view of each corner."""
        return np.repeat(np.arange(len(self.image)), np.diff(self.start))

    @property
    def first_of_images(self) -> np.ndarray:
        """Index of the first view of each image that has views, then the number of views V."""
        return np.flatnonzero(np.diff(self.image, prepend=-1, append=-1))

    def select(self, views: np.ndarray) -> SceneViews:
        """The views that `views` (V,) bool selects, with their corners."""
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


def bundle_adjust(views: SceneViews, state: SceneState, fixed_image: int, max_steps: int) -> SceneState:
    """`state` after up to `max_steps` steps of Levenberg-Marquardt.

    The pose of image number `fixed_image`, and those of bodies and images without a view, do not change."""
    damping, system = FIRST_SCENE_DAMPING, _SceneSystem.at(views, state)
    for _ in range(max_steps):
        trial = system.step(views, state, fixed_image, damping)
        after = None if trial is None else _SceneSystem.at(views, trial)
        if trial is None or after is None or not after.cost < system.cost:
            damping *= 10.0
            if damping > MAX_SCENE_DAMPING:
                break
            continue
        has_converged = system.cost - after.cost < SCENE_COST_TOLERANCE * system.cost
        state, system, damping = trial, after, 0.2 * damping
        if has_converged:
            break
    return state


def reprojection_errors(views: SceneViews, state: SceneState) -> np.ndarray:
    """(N,) [px] distance of each corner from its projection, `INVISIBLE_ERROR_PX` at most."""
    error = np.full(len(views.uv), INVISIBLE_ERROR_PX)
    points = _points_in_camera(views, state)
    camera = views.camera[views.image][views.of_corner]
    for c, lens in enumerate(state.lenses):
        rows = np.flatnonzero(camera == c)
        uv, valid = lens.model.project(lens.params, points[rows])
        distance = np.linalg.norm(uv - views.uv[rows], axis=1)
        error[rows] = np.where(valid, np.minimum(distance, INVISIBLE_ERROR_PX), INVISIBLE_ERROR_PX)
    return error


def _points_in_camera(views: SceneViews, state: SceneState) -> np.ndarray:
    """(N, 3) [m] the point of each corner in the frame of its camera."""
    view = views.of_corner
    i, k = views.image[view], views.body[view]
    scene = np.einsum("nij,nj->ni", state.R_body[k], views.points) + state.p_body[k]
    return np.einsum("nji,nj->ni", state.R_image[i], scene - state.p_image[i])


@dataclass(frozen=True)
class _SceneSystem:
    """Robust cost [px^2] and its second-order terms by view: Gauss-Newton matrix (V, D, D) and gradient (V, D).

    Columns of a view: pose of the image (6), pose of the body (6), parameters of the camera.
    """

    cost: float
    matrix: np.ndarray
    gradient: np.ndarray

    @classmethod
    def at(cls, views: SceneViews, state: SceneState) -> _SceneSystem:
        """The linearisation at `state`."""
        residual, J, valid = _residuals(views, state)
        size = np.where(valid, np.linalg.norm(residual, axis=1), INVISIBLE_ERROR_PX)
        k = SCENE_HUBER_PX
        weight = np.where(valid, np.minimum(1.0, k / np.maximum(size, 1e-12)), 0.0)
        cost = np.where(size > k, k * (size - 0.5 * k), 0.5 * size**2).sum()
        cost += sum(0.5 * (((lens.params - lens.mean) / lens.sigma) ** 2).sum() for lens in state.lenses)
        return cls(float(cost), *_view_terms(views.start, J, residual, weight))

    def step(self, views: SceneViews, state: SceneState, fixed_image: int, damping: float) -> SceneState | None:
        """The state after one damped step; None if the normal equations are singular."""
        begins = [6 * len(state.R_body)]  # first column of each camera
        for lens in state.lenses:
            begins.append(begins[-1] + len(lens.params))
        S, g, diagonal = np.zeros((begins[-1], begins[-1])), np.zeros(begins[-1]), np.zeros(begins[-1])
        for c, lens in enumerate(state.lenses):
            columns = slice(begins[c], begins[c + 1])
            diagonal[columns] = lens.free / lens.sigma**2
            g[columns] = lens.free * (lens.params - lens.mean) / lens.sigma**2
        S[np.diag_indices_from(S)] = diagonal
        first = views.first_of_images
        images, bounds = views.image[first[:-1]], np.array(begins)
        camera, fixed = views.camera[images], images == fixed_image
        H_inverse, g_pose = _eliminate_poses(
            self.matrix, self.gradient, first, views.body, camera, bounds, fixed, damping, S, g, diagonal
        )
        S[np.diag_indices_from(S)] += np.where(diagonal > 0.0, damping * diagonal, 1.0)
        try:
            step = -np.linalg.solve(S, g)
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        pose_steps = _back_substitute(self.matrix, first, views.body, camera, bounds, step, H_inverse, g_pose)
        return _moved(state, step, begins, images, pose_steps)


def _residuals(views: SceneViews, state: SceneState) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (N, 2) [px], their Jacobians (N, 2, D) by the columns of a view, and (N,) bool, corners in view."""
    points, view = _points_in_camera(views, state), views.of_corner
    camera = views.camera[views.image][view]
    n_params = max(len(lens.params) for lens in state.lenses)
    J, residual = np.zeros((len(points), 2, 12 + n_params)), np.zeros((len(points), 2))
    valid = np.zeros(len(points), dtype=bool)
    for c, lens in enumerate(state.lenses):
        rows = np.flatnonzero(camera == c)
        uv, ok, J_point, J_params = lens.model.project_with_jacobians(lens.params, points[rows])
        R_cam_body = state.R_image[views.image[view[rows]]].swapaxes(1, 2) @ state.R_body[views.body[view[rows]]]
        J_body_point = J_point @ R_cam_body
        J[rows, :, 0:3] = np.cross(J_point, points[rows, None])
        J[rows, :, 3:6] = -J_point
        J[rows, :, 6:9] = np.cross(views.points[rows, None], J_body_point)
        J[rows, :, 9:12] = J_body_point
        J[rows, :, 12 : 12 + J_params.shape[2]] = J_params * lens.free
        residual[rows], valid[rows] = uv - views.uv[rows], ok
    return residual, J, valid


def _moved(
    state: SceneState, step: np.ndarray, begins: list[int], images: np.ndarray, pose_steps: np.ndarray
) -> SceneState:
    """The state after a `step` (n,) of bodies and cameras, and `pose_steps` (m, 6) of the images `images` (m,).

    begins: first column of each camera in `step`, then n."""
    R, p = state.R_image.copy(), state.p_image.copy()
    p[images] += np.einsum("nij,nj->ni", R[images], pose_steps[:, 3:])
    R[images] = R[images] @ so3.exp_many(np.ascontiguousarray(pose_steps[:, :3]))
    body = step[: begins[0]].reshape(-1, 6)
    rotation = so3.exp_many(np.ascontiguousarray(body[:, :3]))
    p_body = state.p_body + np.einsum("kij,kj->ki", state.R_body, body[:, 3:])
    lenses = tuple(
        replace(lens, params=lens.params + np.where(lens.free, step[begins[c] : begins[c + 1]], 0.0))
        for c, lens in enumerate(state.lenses)
    )
    return SceneState(R, p, state.R_body @ rotation, p_body, lenses)


@njit(cache=True, nogil=True, error_model="numpy")
def _columns(a, b, body, camera, begins, columns, local):
    """Writes the columns of body poses and camera parameters that views a..b of one image depend on.

    columns: indices in the normal equations of the scene; local: indices in the terms of a view. Returns their number.
    """
    n = 0
    for v in range(a, b):
        for k in range(6):
            columns[n] = 6 * body[v] + k
            local[n] = 6 + k
            n += 1
    for k in range(begins[camera + 1] - begins[camera]):
        columns[n] = begins[camera] + k
        local[n] = 12 + k
        n += 1
    return n


@njit(cache=True, nogil=True, error_model="numpy")
def _add_views(matrix, gradient, a, b, columns, local, S, g, diagonal, C, H_pose, g_pose):
    """Adds the terms of views a..b of one image to the normal equations. columns, local (n,): see `_columns`.

    S, g, diagonal: of body poses and camera parameters; H_pose (6, 6), g_pose (6,): of the image's pose; C (6, n): the
    block between both."""
    n = C.shape[1]
    for v in range(a, b):
        # View v depends on the six columns of its own body and on those of the camera, which follow all bodies.
        first = 6 * (v - a)
        for j in range(n):
            if first <= j < first + 6 or j >= 6 * (b - a):
                g[columns[j]] += gradient[v, local[j]]
                diagonal[columns[j]] += matrix[v, local[j], local[j]]
                for k in range(n):
                    if first <= k < first + 6 or k >= 6 * (b - a):
                        S[columns[j], columns[k]] += matrix[v, local[j], local[k]]
                for k in range(6):
                    C[k, j] += matrix[v, k, local[j]]
        for j in range(6):
            g_pose[j] += gradient[v, j]
            for k in range(6):
                H_pose[j, k] += matrix[v, j, k]


@njit(cache=True, nogil=True, error_model="numpy")
def _eliminate_poses(matrix, gradient, first, body, camera, begins, fixed, damping, S, g, diagonal):
    """Adds the Schur complements of m images to the normal equations S (n, n), g (n,) of bodies and cameras.

    Their diagonal before elimination is added to `diagonal` (n,). first: (m + 1,) the first view of each image. Returns
    inverse blocks (m, 6, 6) and gradients (m, 6) of the poses, zero for a fixed image.
    """
    m, n_params = len(first) - 1, matrix.shape[1] - 12
    H_inverse, g_pose = np.zeros((m, 6, 6)), np.zeros((m, 6))
    longest = 0
    for i in range(m):
        longest = max(longest, first[i + 1] - first[i])
    columns, local = np.empty(6 * longest + n_params, dtype=np.int64), np.empty(6 * longest + n_params, dtype=np.int64)
    for i in range(m):
        a, b = first[i], first[i + 1]
        n = _columns(a, b, body, camera[i], begins, columns, local)
        C, H_pose = np.zeros((6, n)), POSE_RIDGE * np.eye(6)
        _add_views(matrix, gradient, a, b, columns, local, S, g, diagonal, C, H_pose, g_pose[i])
        if fixed[i]:
            g_pose[i] = 0.0
            continue
        for k in range(6):
            H_pose[k, k] *= 1.0 + damping
        H_inverse[i] = np.linalg.inv(H_pose)
        solved = H_inverse[i] @ C
        for j in range(n):
            for k in range(6):
                g[columns[j]] -= solved[k, j] * g_pose[i, k]
            for k in range(n):
                for q in range(6):
                    S[columns[j], columns[k]] -= C[q, j] * solved[q, k]
    return H_inverse, g_pose


@njit(cache=True, nogil=True, error_model="numpy")
def _back_substitute(matrix, first, body, camera, begins, step, H_inverse, g_pose):
    """(m, 6) steps of the images' poses, from the `step` (n,) of bodies and cameras."""
    m = len(first) - 1
    out = np.zeros((m, 6))
    for i in range(m):
        right = g_pose[i].copy()
        for v in range(first[i], first[i + 1]):
            for k in range(6):
                for j in range(6):
                    right[k] += matrix[v, k, 6 + j] * step[6 * body[v] + j]
                for j in range(begins[camera[i] + 1] - begins[camera[i]]):
                    right[k] += matrix[v, k, 12 + j] * step[begins[camera[i]] + j]
        out[i] = -(H_inverse[i] @ right)
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _view_terms(start, J, residual, weight):
    """Gauss-Newton matrices J^T W J (V, D, D) and gradients J^T W r (V, D) of the views."""
    n_views, d = len(start) - 1, J.shape[2]
    matrix, gradient = np.zeros((n_views, d, d)), np.zeros((n_views, d))
    for v in range(n_views):
        for n in range(start[v], start[v + 1]):
            if weight[n] == 0.0:
                continue
            for row in range(2):
                for a in range(d):
                    scaled = weight[n] * J[n, row, a]
                    gradient[v, a] += scaled * residual[n, row]
                    for b in range(a + 1):
                        matrix[v, a, b] += scaled * J[n, row, b]
        for a in range(d):
            for b in range(a):
                matrix[v, b, a] = matrix[v, a, b]
    return matrix, gradient
