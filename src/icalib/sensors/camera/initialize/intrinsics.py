"""Intrinsics and distortion of one camera from images of the target.

Focal lengths are tried on a grid. Bundle adjustments refine the best of them, and the candidate with the least
reprojection error is returned. Each flat body in an image is treated as a separate image, so that relative poses of
bodies are not needed.

Bundle adjustment of one camera's parameters and the poses of its images, each image showing one body.

Levenberg-Marquardt with Huber's loss; the pose of each image is eliminated by the Schur complement.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from icalib.data.measurements import CornerStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.cameras.convert import fit_rays
from icalib.geometry.small import cross
from icalib.geometry.targets import Target
from icalib.rig import Camera
from icalib.sensors.camera.corner_factor import Views
from icalib.sensors.camera.initialize.target_poses import (
    MIN_POSE_CORNERS,
    FlatPoints,
    TargetPoses,
    target_poses,
    usable_rays,
)

# Numbers of images, spread over the recording: to compare start values, to adjust all parameters, and to compare the
# results. The last is largest, because results may differ by far less than the noise of a corner.
FOCAL_TRIAL_IMAGES = 24
ADJUSTED_IMAGES = 48
COMPARISON_IMAGES = 300
MIN_RICH_CORNERS = 40  # an image with so many corners is eligible, even if most images have more

# Focal lengths to try, in image widths, 10 % apart: fields of view from 19 deg (pinhole) to a full sphere (fisheye).
FOCAL_TRIAL_WIDTHS = np.geomspace(0.1, 3.0, 35)
STRONGEST_PARAMS = np.array([0, 1, 4])  # fx, fy and the first distortion coefficient, which has the largest effect

# Ratio of median errors below which start values count as equal, given the pose noise of few images.
EQUAL_START_RATIO = 1.05
MAX_NEIGHBOURING_STARTS = 5  # equally good grid points; more are spread too far to belong to one minimum
# Ratio to the least median error above which a candidate is certainly another local minimum, and dropped to save time.
MAX_CANDIDATE_RATIO = 1.5
EQUAL_COST_RATIO = 1.002  # costs within this ratio differ by less than their noise over `COMPARISON_IMAGES`

MAX_INTRINSICS_RMS_PX = 2.0  # px, of the median image; detected corners err by tenths of a pixel, wrong models by more
EXPECTED_RMS_PX = 0.5  # px, of the median image; a better fit than this is the global minimum
FALLBACK_MODEL = "pinhole-equidistant"  # its start, r = f theta, is close to narrow and wide lenses


def camera_params(camera: Camera, stream: CornerStream, target: Target) -> np.ndarray:
    """(P,) intrinsics and distortion: those of the rig file, else estimates from corners.

    Initial guesses of the rig file that the corners contradict are replaced by estimates. Raises EstimationError if no
    parameters explain the corners.
    """
    model = camera_model(camera.model)
    stated, fixed = _stated(camera, with_guesses=True), _stated(camera, with_guesses=False)
    if np.array_equal(stated, fixed, equal_nan=True):
        if not np.isnan(stated).any():
            return stated
        return guess_intrinsics(*_one_body_per_image(stream, target), model, camera.resolution, stated)
    images, points = _one_body_per_image(stream, target)
    trial = _spread_images(images, FOCAL_TRIAL_IMAGES)
    candidates: list[np.ndarray] = []
    for known in (stated, fixed):
        with suppress(EstimationError):
            is_complete = not np.isnan(known).any()
            candidates.append(
                known if is_complete else guess_intrinsics(images, points, model, camera.resolution, known)
            )
            if _median_rms(trial, model, candidates[-1], points) < MAX_INTRINSICS_RMS_PX:
                return candidates[-1]
    if not candidates:
        return guess_intrinsics(images, points, model, camera.resolution, fixed)
    return min(candidates, key=lambda params: _median_rms(trial, model, params, points))


CLEARER_FIT = 0.8  # ratio of errors: below it another model fits clearly better; noise alone gives 0.95 and more


def fitting_model(
    stream: CornerStream, target: Target, resolution: tuple[int, int], names: Sequence[str]
) -> tuple[str, dict[str, float]]:
    """The camera model among `names` that fits the corners clearly better than the first, else the first; and the error
    [px] of each, of the median image. Infinite if a model fits no lens."""
    images, points = _one_body_per_image(stream, target)
    errors: dict[str, float] = {}
    for name in names:
        model, errors[name] = camera_model(name), np.inf
        with suppress(EstimationError):
            unknown = np.full(len(model.parameter_names), np.nan)
            params = guess_intrinsics(images, points, model, resolution, unknown)
            errors[name] = _median_rms(images, model, params, points)
    best = min(errors, key=lambda name: errors[name])
    return (best if errors[best] < CLEARER_FIT * errors[names[0]] else names[0]), errors


def _stated(camera: Camera, with_guesses: bool) -> np.ndarray:
    """(P,) values of the rig file that are fixed or have a prior; also initial guesses if `with_guesses`; else NaN."""
    stated = np.full(len(camera_model(camera.model).parameter_names), np.nan)
    for part, parameter in ((slice(0, 4), camera.intrinsics), (slice(4, None), camera.distortion)):
        if parameter.value is not None and (with_guesses or parameter.mode != "free"):
            stated[part] = parameter.value
    return stated


def _one_body_per_image(stream: CornerStream, target: Target) -> tuple[CornerStream, FlatPoints]:
    """The stream with each body of an image as a separate image, and the points of the bodies.

    If a body with `MIN_POSE_CORNERS` points or more (a board) was seen, smaller bodies (tags) are left out, because
    four corners constrain the lens weakly.
    """
    if len(target.bodies) == 1:
        return stream, FlatPoints(target.points)
    views = Views.of(stream, target.body)
    size = np.bincount(target.body)
    boards = size[views.body] >= MIN_POSE_CORNERS
    used = np.flatnonzero(boards if boards.any() else ~boards)
    rows = np.isin(views.of_corners(0, len(views.image)), used)
    images = stream.of_rows(rows, stream.stamps_ns[views.image[used]], np.diff(views.start)[used])
    return images, FlatPoints(target.points, MIN_POSE_CORNERS if boards.any() else int(size.min()))


def guess_intrinsics(
    stream: CornerStream, target: FlatPoints, model: CameraModel, resolution: tuple[int, int], known: np.ndarray
) -> np.ndarray:
    """Model parameters (P,) that explain the corners; known (P,): fixed values, NaN for those to be estimated.

    Raises EstimationError if no parameters explain the corners.
    """
    free = np.isnan(known)
    images = _spread_images(stream, ADJUSTED_IMAGES)
    candidates = _candidates(stream, images, model, _starts(model, resolution, known), target, free)
    if _least_rms(images, model, candidates, target) > EXPECTED_RMS_PX:
        starts = _starts_by_fallback_model(images, model, resolution, known, target)
        candidates += _candidates(stream, images, model, starts, target, free)
    candidates = _without_local_minima(images, model, candidates, target)
    many = _spread_images(stream, COMPARISON_IMAGES)
    params = _least_cost(many, model, candidates, target, np.flatnonzero(free))
    rms = _median_rms(images, model, params, target)
    if not rms < MAX_INTRINSICS_RMS_PX:
        raise EstimationError(
            f"{stream.name}: no intrinsics of model {model.name} explain the corners (best median error "
            f"{rms:.1f} px); check model, resolution and target in the rig file, or give intrinsics."
        )
    return params


def _least_rms(stream: CornerStream, model: CameraModel, candidates: list[np.ndarray], target: FlatPoints) -> float:
    """The least median error [px] of all `candidates`; infinity if there are none."""
    return min((_median_rms(stream, model, params, target) for params in candidates), default=np.inf)


def _starts_by_fallback_model(
    stream: CornerStream, model: CameraModel, resolution: tuple[int, int], known: np.ndarray, target: FlatPoints
) -> Iterator[np.ndarray]:
    """Start values (1, P) that project like the intrinsics estimated with `FALLBACK_MODEL`, where corners were seen.

    From zero distortion, a bundle adjustment of polynomial distortion may end in a local minimum on a wide lens.
    """
    fallback = camera_model(FALLBACK_MODEL)
    unknown = np.full(len(fallback.parameter_names), np.nan)
    unknown[:4] = known[:4]
    if model.name == fallback.name or not np.isnan(known[4:]).any():
        return
    starts = _starts(fallback, resolution, unknown)
    for params in _candidates(stream, stream, fallback, starts, target, np.isnan(unknown)):
        rays, _, usable = usable_rays(stream.uv, fallback, params)
        for distortion in model.start_distortions:
            start = np.array([*params[:4], *distortion])
            start[:2] *= fallback.central_scale(params) / model.central_scale(start)
            visible = usable & model.project(start, rays)[1]
            if 2 * visible.sum() > len(start):
                with suppress(np.linalg.LinAlgError):
                    fitted = fit_rays(model, start, rays[visible], stream.uv[visible])
                    yield np.where(np.isnan(known), fitted, known)[None]


def _candidates(
    stream: CornerStream,
    images: CornerStream,
    model: CameraModel,
    starts_by_distortion: Iterator[np.ndarray],
    target: FlatPoints,
    free: np.ndarray,
) -> list[np.ndarray]:
    """Distinct parameters (P,) that bundle adjustments over `images` find, with the parameters `free` (P,) bool.

    For each start distortion the adjustments begin at the best focal lengths.
    """
    trial, candidates = _spread_images(stream, FOCAL_TRIAL_IMAGES), []
    for starts in starts_by_distortion:
        good = _good_starts(trial, model, starts, target)
        if len(model.start_distortions) == 1:  # the cost has one minimum: the best after a rough fit leads to it
            good = [_best_after_rough_fit(trial, model, good, target, free)]
        for start in good:
            with suppress(np.linalg.LinAlgError):
                params = _adjusted(images, model, start, target, free)
                if not any(np.allclose(params, other, rtol=1e-2, atol=1e-3) for other in candidates):
                    candidates.append(params)
    return candidates


def _good_starts(trial: CornerStream, model: CameraModel, starts: np.ndarray, target: FlatPoints) -> np.ndarray:
    """The best of the start values `starts` (F, P) as (1, P); up to three spread ones if many are equally good.

    This happens if all images show the target fronto-parallel, because then all focal lengths fit equally.
    """
    medians = np.array([_median_rms(trial, model, start, target) for start in starts])
    good = np.flatnonzero(medians <= EQUAL_START_RATIO * medians.min())
    if len(good) > MAX_NEIGHBOURING_STARTS:
        return starts[np.unique(good[[0, len(good) // 2, -1]])]
    return starts[[np.argmin(medians)]]


def _adjusted(
    images: CornerStream, model: CameraModel, params: np.ndarray, target: FlatPoints, free: np.ndarray
) -> np.ndarray:
    """`params` (P,) after bundle adjustments of the `free` ones: the strongest alone, then all together."""
    for stage in (STRONGEST_PARAMS, np.arange(len(params))):
        if free[stage].any():
            params, _ = adjust_intrinsics(images, model, params, target, stage[free[stage]])
    return params


def _best_after_rough_fit(
    trial: CornerStream, model: CameraModel, starts: np.ndarray, target: FlatPoints, free: np.ndarray
) -> np.ndarray:
    """(P,) the start value with the least cost after an adjustment of its strongest `free` parameters."""
    if len(starts) == 1 or not free[STRONGEST_PARAMS].any():
        return starts[0]
    fitted = []
    for start in starts:
        with suppress(np.linalg.LinAlgError):
            fitted.append(adjust_intrinsics(trial, model, start, target, STRONGEST_PARAMS[free[STRONGEST_PARAMS]]))
    return min(fitted, key=lambda pair: pair[1])[0] if fitted else starts[0]


def _without_local_minima(
    stream: CornerStream, model: CameraModel, candidates: list[np.ndarray], target: FlatPoints
) -> list[np.ndarray]:
    """The candidates whose median error is at most `MAX_CANDIDATE_RATIO` times the least one."""
    rms = [_median_rms(stream, model, params, target) for params in candidates]
    return [params for params, error in zip(candidates, rms, strict=True) if error <= MAX_CANDIDATE_RATIO * min(rms)]


def _median_rms(stream: CornerStream, model: CameraModel, params: np.ndarray, target: FlatPoints) -> float:
    """The RMS reprojection error [px] of the median image."""
    return float(np.median(target_poses(stream, model, params, target).rms_px))


def _least_cost(
    stream: CornerStream, model: CameraModel, candidates: list[np.ndarray], target: FlatPoints, free: np.ndarray
) -> np.ndarray:
    """The candidate (P,) with the least cost after an adjustment of the parameters numbered `free` (n,).

    The costs of local minima differ little against the noise, so all are computed over the same images. Among equal
    costs, the candidate with least distortion is returned; zeros if there are no candidates.
    """
    if len(candidates) <= 1:
        return candidates[0] if candidates else np.zeros(len(model.parameter_names))
    used = np.all([has_good_pose(target_poses(stream, model, p, target)) for p in candidates], axis=0)
    adjusted: list[tuple[float, np.ndarray]] = []
    for params in candidates:
        with suppress(np.linalg.LinAlgError):
            params, cost = adjust_intrinsics(stream, model, params, target, free, used)
            adjusted.append((cost, params))
    if not adjusted:
        return candidates[0]
    least = min(cost for cost, _ in adjusted)
    equal = [params for cost, params in adjusted if cost <= EQUAL_COST_RATIO * least]
    return min(equal, key=lambda params: float(np.linalg.norm(params[4:])))


def _starts(model: CameraModel, resolution: tuple[int, int], known: np.ndarray) -> Iterator[np.ndarray]:
    """For each start distortion of the model, start values (F, P) with every focal length to try.

    Focal lengths are scales in the image centre, which differ from fx in some models. known (P,): values that are kept,
    NaN for the others.
    """
    width, height = resolution
    for distortion in model.start_distortions:
        params = np.array([1.0, 1.0, 0.5 * (width - 1), 0.5 * (height - 1), *distortion])
        starts = np.tile(params, (len(FOCAL_TRIAL_WIDTHS), 1))
        starts[:, :2] = FOCAL_TRIAL_WIDTHS[:, None] * width / model.central_scale(params)
        starts = np.where(np.isnan(known), starts, known)
        yield starts if np.isnan(known[:2]).any() else starts[:1]
        if not np.isnan(known[4:]).any():
            return


def _spread_images(stream: CornerStream, wanted: int) -> CornerStream:
    """About `wanted` images with many corners, spread over the recording."""
    count = np.diff(stream.start)
    rich = np.flatnonzero(count >= min(np.median(count), MIN_RICH_CORNERS))
    chosen = rich[np.unique(np.linspace(0, len(rich) - 1, wanted).astype(int))]
    rows = np.concatenate([np.arange(int(stream.start[i]), int(stream.start[i + 1])) for i in chosen])
    return stream.of_rows(rows, stream.stamps_ns[chosen], count[chosen])


MAX_INTRINSICS_STEPS = 25  # of Levenberg-Marquardt; a good start needs about five
INTRINSICS_HUBER_PX = 1.5  # px; a few times the noise of detected corners
UNSEEN_COST_PX2 = 20.0 * INTRINSICS_HUBER_PX  # px^2, of a corner that the model cannot project
INTRINSICS_COST_TOLERANCE = 1e-6  # relative decrease of the cost at which the adjustment has converged
MAX_RMS_RATIO = 4.0  # of an image to the median one; the pose of an image with more is likely wrong
MIN_REJECTED_RMS_PX = 1.0  # px; images with less are never rejected


def has_good_pose(poses: TargetPoses) -> np.ndarray:
    """(M,) bool: images whose pose is a good start value."""
    return poses.rms_px < np.maximum(MAX_RMS_RATIO * np.median(poses.rms_px), MIN_REJECTED_RMS_PX)


def adjust_intrinsics(
    stream: CornerStream,
    model: CameraModel,
    params: np.ndarray,
    target: FlatPoints,
    free: np.ndarray,
    used: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Parameters (P,) and robust cost [px^2] after a bundle adjustment of those numbered `free` (n,) and all poses.

    params: (P,) start values; used: (M,) bool, images in use, by default those with a good pose. Raises LinAlgError if
    the normal equations are singular.
    """
    poses = target_poses(stream, model, params, target)
    images = np.flatnonzero(has_good_pose(poses) if used is None else used)
    corners = _Corners.of(stream, target, images)
    R, p, damping = poses.rotation[images], poses.position[images], 1e-3
    system = _linearised(corners, model, params, free, R, p)
    for _ in range(MAX_INTRINSICS_STEPS):
        step = -np.linalg.solve(system.S + damping * np.diag(np.diag(system.S)), system.g)
        trial = params.copy()
        trial[free] += step
        trial_R, trial_p = system.moved_poses(step, R, p)
        after = _linearised(corners, model, trial, free, trial_R, trial_p)
        if after.cost < system.cost:
            has_converged = system.cost - after.cost < INTRINSICS_COST_TOLERANCE * system.cost
            params, R, p, system = trial, trial_R, trial_p, after
            damping *= 0.2
            if has_converged:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    return params, system.cost


class _Corners(NamedTuple):
    """Corners of m images, one image after the other.

    uv: (N, 2) [px]; points: (N, 3) [m] in the frame of the body; start: (m + 1,), image i has the corners
    start[i]:start[i + 1].
    """

    uv: np.ndarray
    points: np.ndarray
    start: np.ndarray

    @classmethod
    def of(cls, stream: CornerStream, target: FlatPoints, images: np.ndarray) -> _Corners:
        """The corners of the images numbered `images` (m,)."""
        rows = np.flatnonzero(np.isin(stream.image, images))
        start = np.concatenate([[0], np.cumsum(np.diff(stream.start)[images])])
        return cls(stream.uv[rows], target.points[stream.point[rows]], start)


class _IntrinsicsSystem(NamedTuple):
    """Normal equations of n free parameters, with the poses of m images eliminated.

    cost: robust cost [px^2]; S (n, n), g (n,): Schur complement and gradient; H_pose_inverse (m, 6, 6), g_pose
    (m, 6, 1): inverse block and gradient of each pose; C (m, 6, n): blocks between poses and parameters.
    """

    cost: float
    S: np.ndarray
    g: np.ndarray
    H_pose_inverse: np.ndarray
    C: np.ndarray
    g_pose: np.ndarray

    def moved_poses(self, step: np.ndarray, R: np.ndarray, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Poses R (m, 3, 3), p (m, 3) after back-substitution of the `step` (n,) of the parameters."""
        d = -(self.H_pose_inverse @ (self.g_pose + (self.C @ step)[:, :, None]))[:, :, 0]
        return R @ so3.exp_many(np.ascontiguousarray(d[:, :3])), p + (R @ d[:, 3:, None])[:, :, 0]


def _linearised(
    corners: _Corners, model: CameraModel, params: np.ndarray, free: np.ndarray, R: np.ndarray, p: np.ndarray
) -> _IntrinsicsSystem:
    """The normal equations at camera poses R_body_cam (m, 3, 3) and p_body_cam (m, 3)."""
    ends = list(pairwise(corners.start))
    X = np.concatenate([(corners.points[a:b] - p[i]) @ R[i] for i, (a, b) in enumerate(ends)])
    uv, valid, J_point, J_params = model.project_with_jacobians(params, X)
    r = np.where(valid[:, None], uv - corners.uv, 0.0)
    size = np.sqrt((r**2).sum(axis=1))
    is_large, k = size > INTRINSICS_HUBER_PX, INTRINSICS_HUBER_PX
    cost = float(np.where(is_large, k * (size - 0.5 * k), 0.5 * size**2).sum())
    # Corners that cannot be projected have the cost of outliers, or parameters that project fewer would fit best.
    cost += float((~valid).sum()) * UNSEEN_COST_PX2
    weight = np.repeat(np.where(is_large, k / np.maximum(size, 1e-12), 1.0) * valid, 2)[:, None]
    J_pose = np.concatenate([cross(J_point, X[:, None, :]), -J_point], axis=2).reshape(-1, 6)
    J_free, residual = J_params[:, :, free].reshape(-1, len(free)), r.ravel()
    weighted_pose, weighted_free = J_pose * weight, J_free * weight
    rows = [slice(2 * a, 2 * b) for a, b in ends]
    H_pose_inverse = np.linalg.inv(_products(weighted_pose, J_pose, rows) + 1e-9 * np.eye(6))
    C, g_pose = _products(weighted_pose, J_free, rows), _products(weighted_pose, residual, rows)[:, :, None]
    eliminated = C.transpose(0, 2, 1) @ H_pose_inverse
    S = (_products(weighted_free, J_free, rows) - eliminated @ C).sum(axis=0)
    g = (_products(weighted_free, residual, rows) - (eliminated @ g_pose)[:, :, 0]).sum(axis=0)
    return _IntrinsicsSystem(cost, S, g, H_pose_inverse, C, g_pose)


def _products(A: np.ndarray, B: np.ndarray, rows: list[slice]) -> np.ndarray:
    """(m, a, ...) products A^T B over each of m slices `rows` of the rows of A (N, a) and B (N, ...)."""
    return np.array([A[k].T @ B[k] for k in rows]).reshape(len(rows), A.shape[1], *B.shape[1:])
