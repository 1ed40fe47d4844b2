"""A camera's intrinsics from the target alone: focal length by trial, then a small bundle adjustment."""

from __future__ import annotations

from collections.abc import Iterator
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
from icalib.geometry.targets import Target
from icalib.geometry.vectors import cross
from icalib.initialize.steps.target_poses import MIN_POSE_CORNERS, FlatPoints, TargetPoses, target_poses, usable_rays
from icalib.rig import Camera
from icalib.sensors.camera.corner_factor import Views

TRIAL_IMAGES = 24
BUNDLE_IMAGES = 48
JUDGE_IMAGES = 300  # to tell valleys apart that differ by far less than the noise
FOCAL_TRIALS = np.geomspace(0.1, 3.0, 35)  # of the image width: 19 degrees for a pinhole, all round for a fisheye
ROUNDS = 25
FIRST = np.array([0, 1, 4])  # fx, fy and the strongest distortion
TIED = 1.05  # trials this much worse than the best are as good
NEAR = 1.5  # candidates with so many times the error of the best are in another valley: no closer look is needed
ALIKE = 1.002  # costs that the noise cannot tell apart: the plainer lens is taken
MOST_TIED = 5  # neighbours of the best, which lead to the same place
HUBER_PX = 1.5
GOOD_RMS_PX = 2.0
WELL_PX = 0.5  # less than what corner noise is presumed to be: the right valley
STARTS_ANYWHERE = "pinhole-equidistant"  # its start, r = f theta, is near every lens, wide and narrow


def camera_params(camera: Camera, stream: CornerStream, target: Target) -> np.ndarray:
    """(P,) what the rig gives, else from the corners, and so where these contradict a guess of the rig. Raises
    EstimationError if none are found that explain the corners."""
    model = camera_model(camera.model)
    given, fixed = _given(camera, guesses=True), _given(camera, guesses=False)
    if np.array_equal(given, fixed, equal_nan=True):
        if not np.isnan(given).any():
            return given
        return guess_intrinsics(*_one_body_each(stream, target), model, camera.resolution, given)
    alone, flat = _one_body_each(stream, target)
    trial = _spread_images(alone, TRIAL_IMAGES)
    found: list[np.ndarray] = []
    for known in (given, fixed):
        with suppress(EstimationError):
            found.append(
                known if not np.isnan(known).any() else guess_intrinsics(alone, flat, model, camera.resolution, known)
            )
            if _median_rms(trial, model, found[-1], flat) < GOOD_RMS_PX:
                return found[-1]
    if not found:
        return guess_intrinsics(alone, flat, model, camera.resolution, fixed)
    return min(found, key=lambda params: _median_rms(trial, model, params, flat))


def _given(camera: Camera, guesses: bool) -> np.ndarray:
    """(P,) what the rig fixes, or gives with a prior, and `guesses` too; NaN where it gives nothing."""
    given = np.full(len(camera_model(camera.model).parameter_names), np.nan)
    for part, parameter in ((slice(0, 4), camera.intrinsics), (slice(4, None), camera.distortion)):
        if parameter.value is not None and (guesses or parameter.mode != "free"):
            given[part] = parameter.value
    return given


def _one_body_each(stream: CornerStream, target: Target) -> tuple[CornerStream, FlatPoints]:
    """Each body in each image as an image of its own; of boards alone where there are any: a tag says little."""
    if len(target.bodies) == 1:
        return stream, FlatPoints(target.points)
    views = Views.of(stream, target.body)
    size = np.bincount(target.body)
    boards = size[views.body] >= MIN_POSE_CORNERS
    used = np.flatnonzero(boards if boards.any() else ~boards)
    rows = np.isin(views.of_corners(0, len(views.image)), used)
    alone = stream.of_rows(rows, stream.stamps_ns[views.image[used]], np.diff(views.start)[used])
    return alone, FlatPoints(target.points, MIN_POSE_CORNERS if boards.any() else int(size.min()))


def guess_intrinsics(
    stream: CornerStream, target: FlatPoints, model: CameraModel, resolution: tuple[int, int], given: np.ndarray
) -> np.ndarray:
    """Model parameters (P,) that explain the corners. Raises EstimationError if none are found that do.

    given (P,): values that are held, NaN for those to be found.
    """
    bundle = _spread_images(stream, BUNDLE_IMAGES)
    candidates = _candidates(stream, bundle, model, _starts(model, resolution, given), target, np.isnan(given))
    if _best_rms(bundle, model, candidates, target) > WELL_PX:
        starts = _starts_by_another(bundle, model, resolution, given, target)
        candidates += _candidates(stream, bundle, model, starts, target, np.isnan(given))
    candidates = _near_the_best(bundle, model, candidates, target)
    params = _cheapest(_spread_images(stream, JUDGE_IMAGES), model, candidates, target, np.flatnonzero(np.isnan(given)))
    rms = _median_rms(bundle, model, params, target)
    if not rms < GOOD_RMS_PX:
        raise EstimationError(
            f"{stream.name}: no intrinsics of model {model.name} explain the corners (best median error "
            f"{rms:.1f} px); check model, resolution and target in the rig file, or give intrinsics."
        )
    return params


def _best_rms(stream: CornerStream, model: CameraModel, found: list[np.ndarray], target: FlatPoints) -> float:
    """Of the parameters `found`, over the images [px]; infinity where there are none."""
    return min((_median_rms(stream, model, params, target) for params in found), default=np.inf)


def _starts_by_another(
    stream: CornerStream, model: CameraModel, resolution: tuple[int, int], given: np.ndarray, target: FlatPoints
) -> Iterator[np.ndarray]:
    """Parameters (1, P) that project as the lens found in the model `STARTS_ANYWHERE` does, where corners are.

    From no distortion, a bundle adjustment of a polynomial that a wide lens bends far can end in another valley.
    """
    other = camera_model(STARTS_ANYWHERE)
    unknown = np.full(len(other.parameter_names), np.nan)
    unknown[:4] = given[:4]
    if model.name == other.name or not np.isnan(given[4:]).any():
        return
    found = _candidates(stream, stream, other, _starts(other, resolution, unknown), target, np.isnan(unknown))
    for params in found:
        rays, _, usable = usable_rays(stream.uv, other, params)
        for distortion in model.start_distortions:
            start = np.array([*params[:4], *distortion])
            start[:2] *= other.central_scale(params) / model.central_scale(start)
            seen = usable & model.project(start, rays)[1]
            if 2 * seen.sum() > len(start):
                with suppress(np.linalg.LinAlgError):
                    fitted = fit_rays(model, start, rays[seen], stream.uv[seen])
                    yield np.where(np.isnan(given), fitted, given)[None]


def _candidates(
    stream: CornerStream,
    bundle: CornerStream,
    model: CameraModel,
    kinds: Iterator[np.ndarray],
    target: FlatPoints,
    wanted: np.ndarray,
) -> list[np.ndarray]:
    """Parameters (P,) that a bundle adjustment of those `wanted` (P,) finds from each kind of lens, started at its best
    focal length; those that are nearly the same, once."""
    trial, found = _spread_images(stream, TRIAL_IMAGES), []
    for starts in kinds:
        good = _good_starts(trial, model, starts, target)
        if len(model.start_distortions) == 1:  # one valley: the best after a rough fit leads into it
            good = [_roughly_fitted(trial, model, good, target, wanted)]
        for start in good:
            with suppress(np.linalg.LinAlgError):
                params = _fit(bundle, model, start, target, wanted)
                if not any(np.allclose(params, other, rtol=1e-2, atol=1e-3) for other in found):
                    found.append(params)
    return found


def _good_starts(trial: CornerStream, model: CameraModel, starts: np.ndarray, target: FlatPoints) -> np.ndarray:
    """The rows of `starts` (F, P) that explain the corners best; several, far apart, where they are about as good: a
    target that is always seen from straight ahead looks the same through every focal length."""
    medians = np.array([_median_rms(trial, model, start, target) for start in starts])
    good = np.flatnonzero(medians <= TIED * medians.min())
    return starts[np.unique(good[[0, len(good) // 2, -1]])] if len(good) > MOST_TIED else starts[[np.argmin(medians)]]


def _fit(
    bundle: CornerStream, model: CameraModel, params: np.ndarray, target: FlatPoints, wanted: np.ndarray
) -> np.ndarray:
    """The `wanted` (P,) of `params`: focal length and the strongest distortion first, the rest once these are near."""
    for stage in (FIRST, np.arange(len(params))):
        if wanted[stage].any():
            params, _ = _bundle(bundle, model, params, target, stage[wanted[stage]])
    return params


def _roughly_fitted(
    trial: CornerStream, model: CameraModel, starts: np.ndarray, target: FlatPoints, wanted: np.ndarray
) -> np.ndarray:
    """(P,) the best of `starts` after focal length and the strongest distortion were fitted, where `wanted` (P,)."""
    if len(starts) == 1 or not wanted[FIRST].any():
        return starts[0]
    fitted = []
    for start in starts:
        with suppress(np.linalg.LinAlgError):
            fitted.append(_bundle(trial, model, start, target, FIRST[wanted[FIRST]]))
    return min(fitted, key=lambda pair: pair[1])[0] if fitted else starts[0]


def _near_the_best(
    stream: CornerStream, model: CameraModel, found: list[np.ndarray], target: FlatPoints
) -> list[np.ndarray]:
    """Those of `found` whose error is near the least. To judge all of them on many images takes seconds."""
    rms = [_median_rms(stream, model, params, target) for params in found]
    return [params for params, error in zip(found, rms, strict=True) if error <= NEAR * min(rms)]


def _median_rms(stream: CornerStream, model: CameraModel, params: np.ndarray, target: FlatPoints) -> float:
    """Over the images [px]."""
    return float(np.median(target_poses(stream, model, params, target).rms_px))


def _cheapest(
    stream: CornerStream, model: CameraModel, found: list[np.ndarray], target: FlatPoints, free: np.ndarray
) -> np.ndarray:
    """The candidate that costs least: a model of two shape parameters can settle in the wrong valley.

    The difference is small against the noise, so all are judged on the same images. Zeros where there is none.
    """
    if len(found) <= 1:
        return found[0] if found else np.zeros(len(model.parameter_names))
    used = np.all([_used(target_poses(stream, model, p, target)) for p in found], axis=0)
    judged: list[tuple[float, np.ndarray]] = []
    for params in found:
        with suppress(np.linalg.LinAlgError):
            params, cost = _bundle(stream, model, params, target, free, used)
            judged.append((cost, params))
    if not judged:
        return found[0]
    least = min(cost for cost, _ in judged)
    alike = [params for cost, params in judged if cost <= ALIKE * least]
    return min(alike, key=lambda params: float(np.linalg.norm(params[4:])))


def _used(poses: TargetPoses) -> np.ndarray:
    """(M,) bool: images whose pose is worth starting from."""
    return poses.rms_px < np.maximum(4.0 * np.median(poses.rms_px), 1.0)


def _starts(model: CameraModel, resolution: tuple[int, int], given: np.ndarray) -> Iterator[np.ndarray]:
    """For each kind of lens that the model starts from, parameters (F, P) with every focal length to try.

    The trials are of the scale in the image's centre, which is not fx in every model. What is `given` is kept.
    """
    width, height = resolution
    for distortion in model.start_distortions:
        params = np.array([1.0, 1.0, 0.5 * (width - 1), 0.5 * (height - 1), *distortion])
        starts = np.tile(params, (len(FOCAL_TRIALS), 1))
        starts[:, :2] = FOCAL_TRIALS[:, None] * width / model.central_scale(params)
        starts = np.where(np.isnan(given), starts, given)
        yield starts if np.isnan(given[:2]).any() else starts[:1]
        if not np.isnan(given[4:]).any():
            return


def _spread_images(stream: CornerStream, wanted: int) -> CornerStream:
    """About `wanted` images with many corners, spread over the recording."""
    count = np.diff(stream.start)
    rich = np.flatnonzero(count >= min(np.median(count), 40))
    chosen = rich[np.unique(np.linspace(0, len(rich) - 1, wanted).astype(int))]
    rows = np.concatenate([np.arange(int(stream.start[i]), int(stream.start[i + 1])) for i in chosen])
    return stream.of_rows(rows, stream.stamps_ns[chosen], count[chosen])


def _bundle(
    stream: CornerStream,
    model: CameraModel,
    params: np.ndarray,
    target: FlatPoints,
    free: np.ndarray,
    used: np.ndarray | None = None,
) -> tuple[np.ndarray, float]:
    """Levenberg-Marquardt over the `free` parameters and all poses, each image's pose eliminated.

    used (M,) bool: the images, by default those whose pose is worth starting from. Returns the parameters (P,) and the
    robust cost.
    """
    poses = target_poses(stream, model, params, target)
    own = np.flatnonzero(_used(poses) if used is None else used)
    seen, R, p, damping = _Seen.of(stream, target, own), poses.rotation[own], poses.position[own], 1e-3
    sums = _sums(seen, model, params, free, R, p)
    for _ in range(ROUNDS):
        step = -np.linalg.solve(sums.S + damping * np.diag(np.diag(sums.S)), sums.g)
        trial = params.copy()
        trial[free] += step
        d = -(sums.H_inv @ (sums.gp + (sums.C @ step)[:, :, None]))[:, :, 0]
        R1, p1 = R @ so3.exp_many(np.ascontiguousarray(d[:, :3])), p + (R @ d[:, 3:, None])[:, :, 0]
        tried = _sums(seen, model, trial, free, R1, p1)
        if tried.cost < sums.cost:
            done = sums.cost - tried.cost < 1e-6 * sums.cost
            params, R, p, sums = trial, R1, p1, tried
            damping *= 0.2
            if done:
                break
        else:
            damping *= 10.0
            if damping > 1e6:
                break
    return params, sums.cost


class _Seen(NamedTuple):
    """Corners of m images: uv (N, 2) px, points (N, 3) in the frame of the body, image (N,) of each; those of image i
    are start[i]:start[i + 1]."""

    uv: np.ndarray
    points: np.ndarray
    image: np.ndarray
    start: np.ndarray

    @classmethod
    def of(cls, stream: CornerStream, target: FlatPoints, own: np.ndarray) -> _Seen:
        """Those of the images `own` (m,)."""
        rows = np.flatnonzero(np.isin(stream.image, own))
        count = np.diff(stream.start)[own]
        start = np.concatenate([[0], np.cumsum(count)])
        return cls(stream.uv[rows], target.points[stream.point[rows]], np.repeat(np.arange(len(own)), count), start)


class _LensSums(NamedTuple):
    """Robust cost; Schur complement S (n, n) and gradient g (n,) of the free parameters; for the step of each image's
    pose its inverse normal matrix H_inv (m, 6, 6), what it shares with the parameters, C (m, 6, n), and its gradient
    gp (m, 6, 1)."""

    cost: float
    S: np.ndarray
    g: np.ndarray
    H_inv: np.ndarray
    C: np.ndarray
    gp: np.ndarray


def _sums(
    seen: _Seen, model: CameraModel, params: np.ndarray, free: np.ndarray, R: np.ndarray, p: np.ndarray
) -> _LensSums:
    """At camera poses R (m, 3, 3), p (m, 3) in the frame of the body."""
    ends = list(pairwise(seen.start))
    X = np.concatenate([(seen.points[a:b] - p[i]) @ R[i] for i, (a, b) in enumerate(ends)])
    uv, valid, Jx, Jp = model.project_with_jacobians(params, X)
    r = np.where(valid[:, None], uv - seen.uv, 0.0)
    size = np.sqrt((r**2).sum(axis=1))
    beyond = size > HUBER_PX
    cost = float(np.where(beyond, HUBER_PX * (size - 0.5 * HUBER_PX), 0.5 * size**2).sum())
    # Corners that the model cannot see cost as much as bad ones, or it would learn to look away.
    cost += float((~valid).sum()) * HUBER_PX * 20.0
    w = np.repeat(np.where(beyond, HUBER_PX / np.maximum(size, 1e-12), 1.0) * valid, 2)[:, None]
    A = np.concatenate([cross(Jx, X[:, None, :]), -Jx], axis=2).reshape(-1, 6)
    B, rr = Jp[:, :, free].reshape(-1, len(free)), r.ravel()
    Aw, Bw = A * w, B * w
    rows = [slice(2 * a, 2 * b) for a, b in ends]
    H_inv = np.linalg.inv(_products(Aw, A, rows) + 1e-9 * np.eye(6))
    C, gp = _products(Aw, B, rows), _products(Aw, rr, rows)[:, :, None]
    taken = C.transpose(0, 2, 1) @ H_inv
    S = (_products(Bw, B, rows) - taken @ C).sum(axis=0)
    g = (_products(Bw, rr, rows) - (taken @ gp)[:, :, 0]).sum(axis=0)
    return _LensSums(cost, S, g, H_inv, C, gp)


def _products(A: np.ndarray, B: np.ndarray, rows: list[slice]) -> np.ndarray:
    """(m, ...) A^T B of each of m slices of the rows of A (N, a) and B (N, ...)."""
    return np.array([A[k].T @ B[k] for k in rows]).reshape(len(rows), A.shape[1], *B.shape[1:])
