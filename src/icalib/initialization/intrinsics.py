"""Intrinsics and distortion of a camera from the target, where the rig gives none."""

from __future__ import annotations

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry.cameras import CameraModel, camera_model
from icalib.geometry.targets import AprilGrid
from icalib.initialization.bundle import Views, adjust, reprojection_errors
from icalib.initialization.poses import find_poses
from icalib.measurements import CornerStream
from icalib.rig import Camera

_FOCAL_BY_WIDTH = np.geomspace(0.15, 5.0, 36)
_SCAN_IMAGES = 40
_POOL = 200  # images among which those to adjust are chosen
_ADJUST_IMAGES = 40
_WORST_PX = 30.0  # what an image without a pose counts in the scan
_CENTRE_SIGMA = 0.1  # principal point, of the width
_DISTORTION_SIGMA = 1.0
_FOCAL_SIGMA = 3.0  # of the focal length itself
_MIN_IMAGES = 4
_MIN_SHARE = 0.5  # of all images must be explained in the end


def find_intrinsics(camera: Camera, stream: CornerStream, target: AprilGrid) -> np.ndarray:
    """Parameters (P,) of the camera's model; intrinsics or distortion with a value in the rig keep it.

    A scan over focal lengths, then a bundle adjustment over 40 different views. Raises EstimationError where the
    target is not seen well enough, or where half of the images do not fit what was found.
    """
    model = camera_model(camera.model)
    size = len(model.parameter_names)
    intrinsics, distortion = camera.intrinsics.value, camera.distortion.value
    start = np.zeros(size) if distortion is None else np.concatenate([np.zeros(4), distortion])
    if intrinsics is not None:
        start[:4] = intrinsics
        if distortion is not None:
            return start
    rich = _rich_images(stream)
    if len(rich) < _MIN_IMAGES:
        raise EstimationError(_advice(camera, f"only {len(rich)} images show enough of the target"))
    if intrinsics is None:
        start[2:4] = 0.5 * (np.array(camera.resolution) - 1.0)
        start[:2] = _scan_focal_length(camera, stream, target, start, rich)
    sigma = np.full(size, 0.0 if distortion is not None else _DISTORTION_SIGMA)
    sigma[:2] = 0.0 if intrinsics is not None else _FOCAL_SIGMA * start[0]
    sigma[2:4] = 0.0 if intrinsics is not None else _CENTRE_SIGMA * camera.resolution[0]
    params = _adjust_in_stages(camera, model, stream, target, start, sigma, rich)
    ok = find_poses(stream, camera.model, params, target, rich).ok
    if ok.mean() < _MIN_SHARE:
        raise EstimationError(_advice(camera, f"only {ok.sum()} of {len(ok)} images fit what was found"))
    return params


def _advice(camera: Camera, reason: str) -> str:
    return (
        f"the intrinsics of {camera.name} cannot be found from the target ({reason}); check model, resolution and target "
        f"in the rig file, or give {camera.name} intrinsics: {{guess: [fx, fy, cx, cy]}}."
    )


def _rich_images(stream: CornerStream) -> np.ndarray:
    """Images with at least half of the corners that the fuller ones show."""
    count = np.diff(stream.start)
    return np.flatnonzero(count >= max(8.0, 0.5 * np.quantile(count, 0.9)))


def _evenly(images: np.ndarray, n: int) -> np.ndarray:
    return images[np.unique(np.linspace(0, len(images) - 1, min(n, len(images))).astype(np.int64))]


def _views(stream: CornerStream, target: AprilGrid, images: np.ndarray) -> Views:
    index = np.concatenate([np.arange(stream.start[i], stream.start[i + 1]) for i in images])
    start = np.concatenate([[0], np.cumsum(np.diff(stream.start)[images])])
    return Views(target.points[stream.point[index]], stream.uv[index], start)


def _posed(
    camera: Camera, stream: CornerStream, target: AprilGrid, params: np.ndarray, images: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """R_cam_board, t_cam_board of the images, and which of them have any pose, well fitting or not."""
    poses = find_poses(stream, camera.model, params, target, images, strict=False)
    R = poses.R_board_cam.transpose(0, 2, 1)
    return R, -np.einsum("mij,mj->mi", R, poses.p_board_cam), poses.ok


def _scan_focal_length(
    camera: Camera, stream: CornerStream, target: AprilGrid, start: np.ndarray, rich: np.ndarray
) -> float:
    """Focal length [px] at which rigid views of the plane explain the images best, by their median errors."""
    images = _evenly(rich, _SCAN_IMAGES)
    views, model = _views(stream, target, images), camera_model(camera.model)
    costs = []
    for focal in _FOCAL_BY_WIDTH * camera.resolution[0]:
        params = np.concatenate([[focal, focal], start[2:]])
        R, t, has = _posed(camera, stream, target, params, images)
        error = reprojection_errors(model, params, R, t, views)
        by_image = np.array([np.median(error[a:b]) for a, b in zip(views.start[:-1], views.start[1:], strict=True)])
        costs.append(np.mean(np.where(has, np.minimum(by_image, _WORST_PX), _WORST_PX)))
    return float(_FOCAL_BY_WIDTH[int(np.argmin(costs))] * camera.resolution[0])


def _adjust_in_stages(
    camera: Camera,
    model: CameraModel,
    stream: CornerStream,
    target: AprilGrid,
    start: np.ndarray,
    sigma: np.ndarray,
    rich: np.ndarray,
) -> np.ndarray:
    """Bundle adjustment with the principal point held at first, then with all; poses anew in between."""
    params = start
    centre_held = sigma.copy()
    centre_held[2:4] = 0.0
    for stage in (centre_held, sigma):
        if not stage.any():
            continue
        images = _different_views(camera, stream, target, params, rich)
        R, t, has = _posed(camera, stream, target, params, images)
        if has.sum() < _MIN_IMAGES:
            raise EstimationError(_advice(camera, f"only {has.sum()} images have a pose"))
        params, _, _ = adjust(model, params, R[has], t[has], _views(stream, target, images[has]), stage)
    return params


def _different_views(
    camera: Camera, stream: CornerStream, target: AprilGrid, params: np.ndarray, rich: np.ndarray
) -> np.ndarray:
    """Up to 40 images that differ most in where the board stands, how large and how oblique: farthest point sampling."""
    pool = _evenly(rich, _POOL)
    R, t, has = _posed(camera, stream, target, params, pool)
    pool, R, t = pool[has], R[has], t[has]
    if len(pool) <= _ADJUST_IMAGES:
        return pool
    centre = t + R @ target.points.mean(axis=0)
    distance = np.linalg.norm(centre, axis=1, keepdims=True)
    feature = np.concatenate([2.0 * centre / distance, R[:, :, 2], np.log(distance)], axis=1)
    chosen = [int(np.argmin(np.linalg.norm(feature - np.median(feature, axis=0), axis=1)))]
    gap = np.full(len(pool), np.inf)
    while len(chosen) < _ADJUST_IMAGES:
        gap = np.minimum(gap, np.linalg.norm(feature - feature[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(gap)))
    return pool[np.sort(chosen)]
