"""Resolves the rotational ambiguity of symmetric targets consistently over the images of all cameras.

A single image of such a target leaves several rotations of the sheet possible. Detection compares successive images of
one camera. Here the gyroscope bridges gaps between images, and the extrinsics make the choice consistent between
cameras. The intrinsics do not depend on the choice, and each pose changes with it in a known way.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icalib.data.measurements import CornerStream, Measurements
from icalib.detection.sightings import Part, parts_of
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import Target
from icalib.initialize.steps.gyro_rotation import GyroRotation
from icalib.initialize.steps.target_poses import FlatPoints, TargetPoses, camera_rates, target_poses
from icalib.motion.imu_data import ImuData, imu_data
from icalib.rig import Camera, Rig
from icalib.sensors.camera.connected_bodies import taken_at_once
from icalib.sensors.camera.initialize.align_camera import align_camera
from icalib.sensors.camera.initialize.boards.intrinsics import camera_params
from icalib.sensors.camera.initialize.guess import relative_offset

# Pairs of simultaneous images that give the relative rotation of two cameras. The cost grows with the square of the
# number, and the rotation has only to tell symmetries apart.
MAX_SYMMETRY_PAIRS = 60

ParamsByCamera = dict[str, np.ndarray]  # intrinsics and distortion (P,)


@dataclass(frozen=True)
class _Symmetries:
    """The g symmetries of a sheet of n points, x' = rotation x + shift.

    number: (g, n) the point that each point is mapped to, as `Target.turns`; rotation: (g, 3, 3); shift: (g, 3) [m].
    """

    number: np.ndarray
    rotation: np.ndarray
    shift: np.ndarray

    @classmethod
    def of(cls, target: Target) -> _Symmetries:
        """The symmetries of `target`, rotations about its normal."""
        middle = target.points.mean(axis=0)
        x, number = target.points - middle, np.stack(target.turns)
        mapped = x[number]
        cosine = (x[:, 0] * mapped[..., 0] + x[:, 1] * mapped[..., 1]).sum(axis=1)
        sine = (x[:, 0] * mapped[..., 1] - x[:, 1] * mapped[..., 0]).sum(axis=1)
        rotation = so3.exp_many(np.arctan2(sine, cosine)[:, None] * np.array([0.0, 0.0, 1.0]))
        return cls(number, rotation, middle - rotation @ middle)


@dataclass(frozen=True)
class _Views:
    """Images of one target by one camera, and their poses; rows: (N,) rows of their corners in the camera's stream."""

    camera: Camera
    rows: np.ndarray
    images: CornerStream
    poses: TargetPoses


class _CameraOnBody(NamedTuple):
    """rotation: R_body_cam (3, 3); offset: t_body - t_cam [s], t_cam counted from the camera's first such image."""

    rotation: np.ndarray
    offset: float


def resolve_symmetry(rig: Rig, recordings: Sequence[Measurements]) -> list[Measurements]:
    """The recordings with the points of each symmetric target numbered consistently.

    The numbers do not change if the intrinsics of a camera are not found. Those of a camera do not change if the motion
    does not determine its rotation relative to the body.
    """
    if not rig.target.symmetric:
        return list(recordings)
    try:
        params = _params_by_camera(rig, recordings)
    except EstimationError:  # the initial guess raises it again
        return list(recordings)
    for part in parts_of(rig.target):
        if part[1].symmetric:
            recordings = [_renumbered(rig, part, params, m) for m in recordings]
    return list(recordings)


def _params_by_camera(rig: Rig, recordings: Sequence[Measurements]) -> ParamsByCamera:
    """Intrinsics and distortion of all cameras that saw the target. Raises EstimationError if some are not found."""
    streams = {c.name: [s for m in recordings for s in m.cameras if s.name == c.name] for c in rig.cameras}
    return {
        c.name: camera_params(c, CornerStream.joined(streams[c.name]), rig.target)
        for c in rig.cameras
        if streams[c.name]
    }


def _renumbered(rig: Rig, part: Part, params: ParamsByCamera, measured: Measurements) -> Measurements:
    """One recording with the points of one target, `part`, numbered consistently."""
    _, target, first = part
    cameras = {c.name: c for c in rig.cameras}
    views = [_views_of(cameras[s.name], s, part, params[s.name]) for s in measured.cameras]
    symmetries = _Symmetries.of(target)
    streams = []
    chosen = _chosen_symmetries(rig, measured, views, symmetries)
    for stream, own, symmetry in zip(measured.cameras, views, chosen, strict=True):
        point = stream.point.copy()
        point[own.rows] = first + symmetries.number[symmetry[own.images.image], own.images.point]
        order = np.lexsort((point, stream.image))
        renumbered = replace(stream, point=point)
        streams.append(renumbered.of_rows(order, stream.stamps_ns, np.diff(stream.start)))
    return measured.with_streams(*streams)


def _views_of(camera: Camera, stream: CornerStream, part: Part, params: np.ndarray) -> _Views:
    """The images of the target `part` by `camera`, with poses by its intrinsics and distortion, params (P,)."""
    _, target, first = part
    rows = np.flatnonzero((stream.point >= first) & (stream.point < first + len(target.points)))
    count = np.bincount(stream.image[rows], minlength=len(stream.stamps_ns))
    images = stream.of_rows(rows, stream.stamps_ns[count > 0], count[count > 0])
    images = replace(images, point=images.point - first)
    return _Views(
        camera, rows, images, target_poses(images, camera_model(camera.model), params, FlatPoints(target.points))
    )


def _chosen_symmetries(
    rig: Rig, measured: Measurements, views: list[_Views], symmetries: _Symmetries
) -> list[np.ndarray]:
    """By camera, (M,) the number of the symmetry that makes each of its images consistent with the others.

    The attitude of the target is propagated from image to image of all cameras with a known rotation on the body: by
    the gyroscope, except across its gaps, or unchanged if there is no gyroscope.
    """
    imu = imu_data(rig, measured)
    cameras = sorted((k for k, v in enumerate(views) if v.poses.ok.any()), key=lambda k: -views[k].poses.ok.sum())
    gyro = None
    if imu is None:
        mounted = _mounted_by_images(measured, views, cameras, symmetries)
    else:
        mounted, gyro = _mounted_by_imu(imu, measured, views, cameras)
    chosen = [np.zeros(len(own.images.stamps_ns), dtype=int) for own in views]
    t, camera, image = _in_temporal_order(views, mounted)
    R_start_body, section = _attitudes(gyro, t)
    last = -1
    R_last = np.eye(3)
    for v, (k, i) in enumerate(zip(camera, image, strict=True)):
        poses, R_body_cam = views[k].poses, mounted[k].rotation
        if not poses.ok[i]:  # detection chose the symmetry of the image before
            chosen[k][i] = chosen[k][i - 1] if i else 0
            continue
        R_board_body = symmetries.rotation @ poses.rotation[i] @ R_body_cam.T
        if last >= 0:
            is_known = section[last] == section[v]
            expected = R_last @ R_start_body[last].T @ R_start_body[v] if is_known else R_last
            chosen[k][i] = int(np.argmax((R_board_body * expected).sum(axis=(1, 2))))  # the least angle
        last, R_last = v, R_board_body[chosen[k][i]]
    return chosen


def _in_temporal_order(
    views: list[_Views], mounted: dict[int, _CameraOnBody]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(V,) each: instant on the body's clock [s], camera and image of all images of the `mounted` cameras, by time."""
    t = [views[k].images.seconds + mount.offset for k, mount in mounted.items()]
    camera = [np.full(len(own), k) for k, own in zip(mounted, t, strict=True)]
    image = [np.arange(len(own)) for own in t]
    t, camera, image = (np.concatenate(x) if x else np.zeros(0, dtype=int) for x in (t, camera, image))
    order = np.argsort(t, kind="stable")
    return t[order], camera[order], image[order]


def _attitudes(gyro: GyroRotation | None, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_start_body (V, 3, 3) at instants t (V,) [s], and (V,) the section between gaps of the gyroscope of each.

    Without a gyroscope all are the identity.
    """
    if gyro is None:
        return np.tile(np.eye(3), (len(t), 1, 1)), np.zeros(len(t), dtype=int)
    inside = np.clip(t, gyro.imu.seconds[0], gyro.imu.seconds[-1])
    return gyro.at(inside), np.searchsorted([begin for begin, _ in gyro.imu.gaps], t)


def _mounted_by_imu(
    imu: ImuData, measured: Measurements, views: list[_Views], cameras: list[int]
) -> tuple[dict[int, _CameraOnBody], GyroRotation | None]:
    """The `cameras` whose angular rates match the IMU's, on the body, and the integrated gyroscope.

    cameras: numbers, the one with most poses first. Its estimate of the gyroscope bias is used.
    """
    aligned = {}
    for k in cameras:
        own = views[k]
        with suppress(EstimationError):
            aligned[k] = align_camera(own.camera, own.images, camera_rates(own.images, own.poses), imu, measured)
    biases = [a.gyro_bias for a in aligned.values()]
    gyro = GyroRotation.integrate(imu, biases[0]) if biases else None
    return {k: _CameraOnBody(a.rotation, a.offset) for k, a in aligned.items()}, gyro


def _mounted_by_images(
    measured: Measurements, views: list[_Views], cameras: list[int], symmetries: _Symmetries
) -> dict[int, _CameraOnBody]:
    """The `cameras` that simultaneous images connect to the first one, which is the body.

    Empty if none is connected: one camera alone does not tell how the target moved between its images.
    """
    given = [own.camera.time_offset.value for own in views]
    offsets = [
        relative_offset(np.zeros(1) if g is None else g, own.images, measured)
        for g, own in zip(given, views, strict=True)
    ]
    found = {k: np.eye(3) for k in cameras[:1]}
    while len(found) < len(cameras):
        pairs = {
            (a, b): _simultaneous(views[a], offsets[a], views[b], offsets[b])
            for a in found
            for b in cameras
            if b not in found
        }
        (a, b), best = max(pairs.items(), key=lambda item: len(item[1]))
        if not len(best):
            break
        found[b] = found[a] @ _common_rotation(views[a].poses, views[b].poses, best, symmetries)
    return {k: _CameraOnBody(R, offsets[k]) for k, R in found.items()} if len(found) > 1 else {}


def _simultaneous(a: _Views, offset_a: float, b: _Views, offset_b: float) -> np.ndarray:
    """(n, 2) pairs of simultaneous images of two cameras that have poses, spread over the recording."""
    ta, tb = a.images.seconds + offset_a, b.images.seconds + offset_b
    pairs = np.column_stack(taken_at_once(ta, tb))
    pairs = pairs[a.poses.ok[pairs[:, 0]] & b.poses.ok[pairs[:, 1]]]
    return (
        pairs[np.linspace(0, len(pairs) - 1, MAX_SYMMETRY_PAIRS).astype(int)]
        if len(pairs) > MAX_SYMMETRY_PAIRS
        else pairs
    )


def _common_rotation(a: TargetPoses, b: TargetPoses, pairs: np.ndarray, symmetries: _Symmetries) -> np.ndarray:
    """R_a_b (3, 3) of two cameras from simultaneous images; pairs: (n, 2) their numbers.

    Each pair gives one candidate T_a_b for each symmetry. The right candidates agree; the wrong ones depend on the
    attitude of the target. The candidate with the least median distance to the nearest candidate of each pair is taken.
    One radian counts as one median distance from the target.
    """
    i, j = pairs.T
    to_a = a.rotation[i].swapaxes(1, 2)
    R = to_a[:, None] @ symmetries.rotation @ b.rotation[j][:, None]
    moved = b.position[j] @ symmetries.rotation.swapaxes(1, 2)  # (g, n, 3)
    p = np.einsum("nab,gnb->nga", to_a, moved + symmetries.shift[:, None] - a.position[i])
    p /= np.median(np.linalg.norm(a.position[i], axis=1))
    n, g = R.shape[:2]
    R, p = R.reshape(n * g, 3, 3), p.reshape(n * g, 3)
    angle = np.linalg.norm(so3.log_many((R[:, None].swapaxes(-1, -2) @ R[None]).reshape(-1, 3, 3)), axis=1)
    distance = angle.reshape(n * g, n * g) + np.linalg.norm(p[:, None] - p[None], axis=2)
    nearest = distance.reshape(n * g, n, g).min(axis=2)
    return R[int(np.argmin(np.median(nearest, axis=1)))]
