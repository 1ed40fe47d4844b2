"""Numbers the points of rotationally symmetric targets alike in the images of all cameras.

One image does not show which of several turns of the sheet it sees. Detection compares neighbouring images of a camera.
The gyroscope, and cameras that see the target at the same instant, tell more: they bridge gaps, and they number the
images of several cameras alike. The lens does not depend on the turn, and a pose changes with it in a known way.
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

MOST_PAIRS = 60  # of images taken together; more hardly change how two cameras stand to each other

Lenses = dict[str, np.ndarray]  # parameters (P,) by camera


@dataclass(frozen=True)
class _Turns:
    """Turns of the sheet that no image shows, as x' = rotation x + shift: rotation (g, 3, 3), shift (g, 3) m."""

    number: np.ndarray  # (g, n) as `Target.turns`
    rotation: np.ndarray
    shift: np.ndarray

    @classmethod
    def of(cls, target: Target) -> _Turns:
        middle = target.points.mean(axis=0)
        x, number = target.points - middle, np.stack(target.turns)
        turned = x[number]
        cosine = (x[:, 0] * turned[..., 0] + x[:, 1] * turned[..., 1]).sum(axis=1)
        sine = (x[:, 0] * turned[..., 1] - x[:, 1] * turned[..., 0]).sum(axis=1)
        rotation = so3.exp_many(np.arctan2(sine, cosine)[:, None] * np.array([0.0, 0.0, 1.0]))
        return cls(number, rotation, middle - rotation @ middle)


@dataclass(frozen=True)
class _Views:
    """What a camera saw of one target: rows (N,) of the corners in its stream, the images that show it, their poses."""

    camera: Camera
    rows: np.ndarray
    images: CornerStream
    poses: TargetPoses


class _Mount(NamedTuple):
    """rotation: R_body_cam; offset: t_body - t_cam, the latter since the camera's first image of the target [s]."""

    rotation: np.ndarray
    offset: float


def resolve_symmetry(rig: Rig, recordings: Sequence[Measurements]) -> list[Measurements]:
    """The recordings, with the points of each symmetric target renumbered.

    Numbers stay where no lens is found, and those of a camera stay where the motion does not show how it is mounted.
    """
    if not rig.target.symmetric:
        return list(recordings)
    try:
        lenses = _lenses(rig, recordings)
    except EstimationError:  # the first guess raises it again
        return list(recordings)
    for part in parts_of(rig.target):
        if part[1].symmetric:
            recordings = [_renumbered(rig, part, lenses, m) for m in recordings]
    return list(recordings)


def _lenses(rig: Rig, recordings: Sequence[Measurements]) -> Lenses:
    """Of all cameras that saw the target. Raises EstimationError where the lens of one is not found."""
    streams = {c.name: [s for m in recordings for s in m.cameras if s.name == c.name] for c in rig.cameras}
    return {
        c.name: camera_params(c, CornerStream.joined(streams[c.name]), rig.target)
        for c in rig.cameras
        if streams[c.name]
    }


def _renumbered(rig: Rig, part: Part, lenses: Lenses, measured: Measurements) -> Measurements:
    """One recording, with the points of one target renumbered."""
    _, target, first = part
    cameras = {c.name: c for c in rig.cameras}
    views = [_views_of(cameras[s.name], s, part, lenses[s.name]) for s in measured.cameras]
    turns = _Turns.of(target)
    streams = []
    for stream, own, turn in zip(measured.cameras, views, _chosen_turns(rig, measured, views, turns), strict=True):
        point = stream.point.copy()
        point[own.rows] = first + turns.number[turn[own.images.image], own.images.point]
        order = np.lexsort((point, stream.image))
        renumbered = replace(stream, point=point)
        streams.append(renumbered.of_rows(order, stream.stamps_ns, np.diff(stream.start)))
    return measured.with_streams(*streams)


def _views_of(camera: Camera, stream: CornerStream, part: Part, params: np.ndarray) -> _Views:
    _, target, first = part
    rows = np.flatnonzero((stream.point >= first) & (stream.point < first + len(target.points)))
    count = np.bincount(stream.image[rows], minlength=len(stream.stamps_ns))
    images = stream.of_rows(rows, stream.stamps_ns[count > 0], count[count > 0])
    images = replace(images, point=images.point - first)
    return _Views(
        camera, rows, images, target_poses(images, camera_model(camera.model), params, FlatPoints(target.points))
    )


def _chosen_turns(rig: Rig, measured: Measurements, views: list[_Views], turns: _Turns) -> list[np.ndarray]:
    """Of each camera (M,) the index of the turn that each of its images needs.

    The attitude of the target is carried from view to view of all cameras that have a mount: by the gyroscope, but not
    across its gaps, or unchanged where there is none.
    """
    imu = imu_data(rig, measured)
    seen = sorted((k for k, v in enumerate(views) if v.poses.ok.any()), key=lambda k: -views[k].poses.ok.sum())
    gyro = None
    if imu is None:
        mounts = _mounts_beside(measured, views, seen, turns)
    else:
        mounts, gyro = _mounts_by_imu(imu, measured, views, seen)
    chosen = [np.zeros(len(own.images.stamps_ns), dtype=int) for own in views]
    t, camera, image = _in_temporal_order(views, mounts)
    turned, section = _turned(gyro, t)
    last = -1
    R_last = np.eye(3)
    for v, (k, i) in enumerate(zip(camera, image, strict=True)):
        poses, mount = views[k].poses, mounts[k]
        if not poses.ok[i]:  # detection numbered it as the image before
            chosen[k][i] = chosen[k][i - 1] if i else 0
            continue
        R_board_body = turns.rotation @ poses.rotation[i] @ mount.rotation.T
        if last >= 0:
            expected = R_last @ turned[last].T @ turned[v] if section[last] == section[v] else R_last
            chosen[k][i] = int(np.argmax((R_board_body * expected).sum(axis=(1, 2))))  # the least angle
        last, R_last = v, R_board_body[chosen[k][i]]
    return chosen


def _in_temporal_order(views: list[_Views], mounts: dict[int, _Mount]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(V,) each: instant on the body's clock [s], camera and image of all views of cameras that have a mount."""
    t = [views[k].images.seconds + mount.offset for k, mount in mounts.items()]
    camera = [np.full(len(own), k) for k, own in zip(mounts, t, strict=True)]
    image = [np.arange(len(own)) for own in t]
    t, camera, image = (np.concatenate(x) if x else np.zeros(0, dtype=int) for x in (t, camera, image))
    order = np.argsort(t, kind="stable")
    return t[order], camera[order], image[order]


def _turned(gyro: GyroRotation | None, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How the body turned until instants (V,) [s], (V, 3, 3), and in which section between gaps of the gyroscope they
    are, (V,). No turn where nothing measured it."""
    if gyro is None:
        return np.tile(np.eye(3), (len(t), 1, 1)), np.zeros(len(t), dtype=int)
    inside = np.clip(t, gyro.imu.seconds[0], gyro.imu.seconds[-1])
    return gyro.at(inside), np.searchsorted([begin for begin, _ in gyro.imu.gaps], t)


def _mounts_by_imu(
    imu: ImuData, measured: Measurements, views: list[_Views], seen: list[int]
) -> tuple[dict[int, _Mount], GyroRotation | None]:
    """Of the cameras `seen`, those with most poses first, that turn as the IMU does; and how that turned, without the
    bias that the first shows."""
    aligned = {}
    for k in seen:
        own = views[k]
        with suppress(EstimationError):
            aligned[k] = align_camera(own.camera, own.images, camera_rates(own.images, own.poses), imu, measured)
    biases = [a.gyro_bias for a in aligned.values()]
    gyro = GyroRotation.integrate(imu, biases[0]) if biases else None
    return {k: _Mount(a.rotation, a.offset) for k, a in aligned.items()}, gyro


def _mounts_beside(measured: Measurements, views: list[_Views], seen: list[int], turns: _Turns) -> dict[int, _Mount]:
    """Of the cameras `seen` that images taken together tie to the first, which is the body. None where there is no
    other: a camera alone does not show how the target turned between its images."""
    given = [own.camera.time_offset.value for own in views]
    offsets = [
        relative_offset(np.zeros(1) if g is None else g, own.images, measured)
        for g, own in zip(given, views, strict=True)
    ]
    found = {k: np.eye(3) for k in seen[:1]}
    while len(found) < len(seen):
        pairs = {
            (a, b): _together(views[a], offsets[a], views[b], offsets[b]) for a in found for b in seen if b not in found
        }
        (a, b), together = max(pairs.items(), key=lambda item: len(item[1]))
        if not len(together):
            break
        found[b] = found[a] @ _common_rotation(views[a].poses, views[b].poses, together, turns)
    return {k: _Mount(R, offsets[k]) for k, R in found.items()} if len(found) > 1 else {}


def _together(a: _Views, offset_a: float, b: _Views, offset_b: float) -> np.ndarray:
    """(n, 2) images of two cameras that were taken at the same instant, spread over the recording, with poses."""
    ta, tb = a.images.seconds + offset_a, b.images.seconds + offset_b
    pairs = np.column_stack(taken_at_once(ta, tb))
    pairs = pairs[a.poses.ok[pairs[:, 0]] & b.poses.ok[pairs[:, 1]]]
    return pairs[np.linspace(0, len(pairs) - 1, MOST_PAIRS).astype(int)] if len(pairs) > MOST_PAIRS else pairs


def _common_rotation(a: TargetPoses, b: TargetPoses, together: np.ndarray, turns: _Turns) -> np.ndarray:
    """R_a_b of two cameras, the same at all instants: of the turns that each pair of images may need, the right ones
    give poses that are alike, the wrong ones poses that depend on how the target is oriented.

    The pose with the least median distance to the nearest candidate of each pair is taken. Distances are in radians,
    and in distances from the target.
    """
    i, j = together.T
    to_a = a.rotation[i].swapaxes(1, 2)
    R = to_a[:, None] @ turns.rotation @ b.rotation[j][:, None]
    moved = b.position[j] @ turns.rotation.swapaxes(1, 2)  # (g, n, 3)
    p = np.einsum("nab,gnb->nga", to_a, moved + turns.shift[:, None] - a.position[i])
    p /= np.median(np.linalg.norm(a.position[i], axis=1))
    n, g = R.shape[:2]
    R, p = R.reshape(n * g, 3, 3), p.reshape(n * g, 3)
    angle = np.linalg.norm(so3.log_many((R[:, None].swapaxes(-1, -2) @ R[None]).reshape(-1, 3, 3)), axis=1)
    apart = angle.reshape(n * g, n * g) + np.linalg.norm(p[:, None] - p[None], axis=2)
    nearest = apart.reshape(n * g, n, g).min(axis=2)
    return R[int(np.argmin(np.median(nearest, axis=1)))]
