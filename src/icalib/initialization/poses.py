"""Pose of a camera in front of the board, from each image alone."""

from __future__ import annotations

import numpy as np

from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import AprilGrid
from icalib.initialization.guess import BoardPoses
from icalib.initialization.pose_kernels import board_poses
from icalib.measurements import CornerStream

CORNERS_PER_IMAGE = 40  # more make a first guess slower, not better
_SCALE_PX = 1.0  # of the robust cost
_LIMIT_PX = 3.0
_INLIER_SHARE = 0.75


def thin(stream: CornerStream, images: np.ndarray, limit: int) -> tuple[np.ndarray, np.ndarray]:
    """Up to `limit` corners of each of `images` (m,), spread evenly over its list: indices (n,), start (m + 1,)."""
    count = np.diff(stream.start)[images]
    taken = np.minimum(count, limit)
    start = np.concatenate([[0], np.cumsum(taken)])
    rank = np.arange(start[-1]) - np.repeat(start[:-1], taken)
    share = np.repeat(count / np.maximum(taken, 1), taken)
    return np.repeat(stream.start[images], taken) + (rank * share).astype(np.int64), start


def find_poses(
    stream: CornerStream,
    model: str,
    params: np.ndarray,
    target: AprilGrid,
    images: np.ndarray | None = None,
    strict: bool = True,
) -> BoardPoses:
    """Board poses of `images` (m,), by default all, with the camera parameters params (P,).

    An image is ok where three quarters of its corners lie within about 3 px of a pose that has no rival, and where the
    camera is on the side of the board that most images show; without `strict`, where it has a pose at all.
    """
    images = np.arange(len(stream.stamps_ns)) if images is None else images
    index, start = thin(stream, images, CORNERS_PER_IMAGE)
    rays, valid = camera_model(model).unproject(params, stream.uv[index])
    image = np.repeat(np.arange(len(images)), np.diff(start))[valid]
    start = np.searchsorted(image, np.arange(len(images) + 1))
    R, p, ok = np.zeros((len(images), 3, 3)), np.zeros((len(images), 3)), np.zeros(len(images), dtype=np.bool_)
    xy = target.points[stream.point[index[valid]], :2]
    focal = 0.5 * (params[0] + params[1])
    share = _INLIER_SHARE if strict else 0.0
    board_poses(rays[valid], xy, start, _SCALE_PX / focal, _LIMIT_PX / focal, share, R, p, ok)
    if strict and ok.any():
        ok &= np.sign(p[:, 2]) == np.sign(np.median(p[ok, 2]))
    return BoardPoses(R, p, ok)
