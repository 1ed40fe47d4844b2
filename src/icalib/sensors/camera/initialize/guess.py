"""The initial guess of cameras: calibration parameters, biases and camera poses.

Time offset and rotation of one camera relative to the IMU, from angular rates and values of the rig file.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from icalib.data.measurements import CornerStream, Measurements, TrackStream
from icalib.detection.images import Part, parts_of
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import Target
from icalib.geometry.targets.base import BOARD
from icalib.initialize.initializer import is_contradicted, known_value, nearest_about_axis
from icalib.initialize.rate_alignment import (
    RateAlignment,
    align_rates,
    alignment_as_stated,
    better_alignment,
    better_at_offset,
    check_two_axes,
    main_axis,
    rates_contradict,
    turns_about_two_axes,
)
from icalib.initialize.rate_correlation import GyroRotation, SensorRates
from icalib.motion.imu_data import ImuData, imu_data
from icalib.optim.state import Key
from icalib.rig import Camera, Rig
from icalib.sensors.camera.initialize.intrinsics import camera_params
from icalib.sensors.camera.initialize.target_poses import FlatPoints, TargetPoses, camera_rates, target_poses
from icalib.sensors.camera.model import taken_at_once
from icalib.sensors.sensor import TIME_OFFSET

# s; images closer in time count as simultaneous. Clocks synchronised by hardware agree to microseconds, and no camera
# takes images at 10 kHz.
MIN_IMAGE_SPACING_S = 1e-4


@dataclass(frozen=True)
class CameraGuess:
    """Initial guess of one camera.

    params: (P,) intrinsics and distortion, in the order of the camera model.
    offset: t_body - t_camera [s], each clock counted from its first stamp.
    rotation, position: R_body_cam (3, 3) and p_body_cam (3,) [m].
    poses: T_target_cam of each image; T_world_cam for a guess from feature tracks.
    """

    params: np.ndarray
    offset: float
    rotation: np.ndarray
    position: np.ndarray
    poses: TargetPoses


@dataclass(frozen=True)
class Guess:
    """Initial guess of all cameras of a rig, for one recording.

    gyro_bias: (3,) [rad/s]; accel_bias: (3,) [m/s^2].
    R_world_board: (3, 3) attitude of the target; world z is up, and both frames have the same origin. The identity
    without an IMU, and for a guess from feature tracks.
    scene: poses T_target_body of the target's bodies as in a state, keyed by body and parameter; empty for one body.
    """

    cameras: dict[str, CameraGuess]
    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    R_world_board: np.ndarray
    scene: dict[Key, np.ndarray] = field(default_factory=dict)

    def values(self) -> dict[Key, np.ndarray]:
        """The calibration parameters as in a state, keyed by sensor (or body) and parameter."""
        out: dict[Key, np.ndarray] = self.scene | {(BOARD, "tilt"): self.R_world_board}
        for name, c in self.cameras.items():
            out[name, "rotation"], out[name, "translation"] = c.rotation, c.position
            out[name, "time_offset"] = np.array([c.offset])
            out[name, "intrinsics"], out[name, "distortion"] = c.params[:4], c.params[4:]
        return out

    def biases(self, n: int) -> np.ndarray:
        """(n, 6) gyroscope and accelerometer biases, the same at all n keyframes."""
        return np.tile(np.concatenate([self.gyro_bias, self.accel_bias]), (n, 1))

    def body_poses(self, measurements: Measurements) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Poses of the body in the world, from the images of all cameras that have a pose.

        Returns instants (n,) [s] on the body's clock, strictly increasing, R_world_body (n, 3, 3) and p_world_body
        (n, 3) [m], and its variance (n,) [m^2] by noise of the corners. Images at most `MIN_IMAGE_SPACING_S` after
        another one are left out.
        """
        times, rotations, positions, variances = [], [], [], []
        for stream in measurements.cameras:
            c = self.cameras[stream.name]
            ok = c.poses.ok
            R = c.poses.rotation[ok] @ c.rotation.T
            times.append(stream.seconds[ok] + c.offset)
            rotations.append(self.R_world_board @ R)
            positions.append((c.poses.position[ok] - R @ c.position) @ self.R_world_board.T)
            variances.append((c.poses.per_px[ok] * np.median(c.poses.rms_px[ok])) ** 2)
        t = np.concatenate(times)
        order = np.argsort(t, kind="stable")
        order = order[np.diff(t[order], prepend=-np.inf) > MIN_IMAGE_SPACING_S]
        R, p, variance = (np.concatenate(x)[order] for x in (rotations, positions, variances))
        return t[order], R, p, variance


def relative_offset(value: np.ndarray, stream: CornerStream | TrackStream, measurements: Measurements) -> float:
    """Converts a time offset `value` (1,) [s] between raw stamps to one between clocks counted from first stamps.

    The clocks are those of `stream` and of the body, whose first stamp is `measurements.origin_ns`.
    """
    return float(value[0]) + (stream.origin_ns - measurements.origin_ns) * 1e-9


def chosen_offset(
    camera: Camera, rates: SensorRates, imu: ImuData, given: float | None, alignment: RateAlignment
) -> float:
    """The time offset [s] to start from: the value `given` by the rig file, or the estimate in `alignment`.

    Both are t_imu - t_camera, with each clock counted from its first stamp. A fixed value, or one with a prior, is
    kept. An initial guess far from the estimate is replaced only if the angular `rates` of the camera contradict it,
    because slow motion hardly determines an offset.
    """
    if given is None:
        return alignment.offset
    far = is_contradicted(TIME_OFFSET, np.array([given]), np.array([alignment.offset]))
    if known_value(camera.time_offset) is not None or not far:
        return given
    try:
        at_given = alignment_as_stated(imu, camera.name, rates, given, alignment.rotation)
    except EstimationError:  # the clocks do not overlap
        return alignment.offset
    return alignment.offset if rates_contradict(imu, rates, at_given) else given


def align_camera(
    camera: Camera, stream: CornerStream, rates: SensorRates, imu: ImuData, measurements: Measurements
) -> RateAlignment:
    """Rotation, time offset and gyroscope bias of `camera` from its angular `rates` and those of the IMU.

    Values of the rig file that are fixed or have a prior take precedence over the estimate. An initial guess of the rig
    file is used if the motion does not determine the value. Raises EstimationError if neither determines it.
    """
    alignment = _aligned_by_rates(camera, stream, rates, imu, measurements)
    offset, rotation = camera.time_offset.value, camera.rotation.value
    if rotation is None or (known_value(camera.rotation) is None and turns_about_two_axes(imu, rates, alignment)):
        return alignment
    at_given = alignment_as_stated(imu, camera.name, rates, alignment.offset, rotation)
    if offset is not None and known_value(camera.time_offset) is None:
        at_given = better_at_offset(imu, camera.name, rates, at_given, relative_offset(offset, stream, measurements))
    if known_value(camera.rotation) is not None or alignment.given or not rates_contradict(imu, rates, at_given):
        return at_given
    # The rates determine the rotation except about one axis. Only that component is taken from the guess.
    nearest = nearest_about_axis(main_axis(rates.rate), rotation, alignment.rotation)
    return better_alignment(
        imu, rates, at_given, alignment_as_stated(imu, camera.name, rates, alignment.offset, nearest)
    )


def _aligned_by_rates(
    camera: Camera, stream: CornerStream, rates: SensorRates, imu: ImuData, measurements: Measurements
) -> RateAlignment:
    """The alignment by angular rates.

    It has the time offset of the rig file if that is fixed or has a prior, or if the rates do not determine one. If
    they do not determine the rotation either, that of the rig file is used. Raises EstimationError if there is no such
    value, or the rates contradict it.
    """
    given, known = camera.time_offset.value, known_value(camera.time_offset)
    rotation, on_wheels = camera.rotation.value, bool(measurements.wheels)
    try:
        offset = None if known is None else relative_offset(known, stream, measurements)
        alignment = align_rates(imu, camera.name, rates, offset)
        if rotation is None:
            check_two_axes(imu, rates, alignment, camera.name, on_wheels)
    except EstimationError:
        if given is None:
            raise
        offset = relative_offset(given, stream, measurements)
        if rotation is None:
            alignment = align_rates(imu, camera.name, rates, offset)
            check_two_axes(imu, rates, alignment, camera.name, on_wheels)
        else:
            alignment = alignment_as_stated(imu, camera.name, rates, offset, rotation)
            if rates_contradict(imu, rates, alignment):
                raise
    return alignment


# Resolves the rotational ambiguity of symmetric targets consistently over the images of all cameras.
#
# A single image of such a target is consistent with several rotations of the target about its normal. Detection
# resolves them between successive images of one camera. Here the gyroscope bridges gaps between images, and the
# extrinsics make the choice consistent between cameras. Intrinsics do not depend on the choice; poses change by the
# known symmetry.

# Largest number of pairs of simultaneous images that determine the relative rotation of two cameras. The cost grows
# with its square, and the rotation only has to distinguish symmetries.
MAX_SYMMETRY_PAIRS = 60

ParamsByCamera = dict[str, np.ndarray]  # intrinsics and distortion (P,) by camera name


@dataclass(frozen=True)
class _Symmetries:
    """The g rotational symmetries of a flat target with n points, x' = rotation x + shift.

    number: (g, n) index of the point that each point is mapped to, as in `Target.turns`; rotation: (g, 3, 3); shift:
    (g, 3) [m].
    """

    number: np.ndarray
    rotation: np.ndarray
    shift: np.ndarray

    @classmethod
    def of(cls, target: Target) -> _Symmetries:
        """The symmetries of `target`: rotations about its normal through the mean of its points."""
        middle = target.points.mean(axis=0)
        x, number = target.points - middle, np.stack(target.turns)
        mapped = x[number]
        cosine = (x[:, 0] * mapped[..., 0] + x[:, 1] * mapped[..., 1]).sum(axis=1)
        sine = (x[:, 0] * mapped[..., 1] - x[:, 1] * mapped[..., 0]).sum(axis=1)
        rotation = so3.exp_many(np.arctan2(sine, cosine)[:, None] * np.array([0.0, 0.0, 1.0]))
        return cls(number, rotation, middle - rotation @ middle)


@dataclass(frozen=True)
class _Views:
    """Images of one target by one camera, with poses T_target_cam.

    rows: (N,) rows of their corners in the camera's stream."""

    camera: Camera
    rows: np.ndarray
    images: CornerStream
    poses: TargetPoses


class _CameraOnBody(NamedTuple):
    """Alignment of a camera with the body.

    rotation: R_body_cam (3, 3); offset: t_body - t_cam [s], t_cam since the camera's first image of the target."""

    rotation: np.ndarray
    offset: float


def resolve_symmetry(rig: Rig, recordings: Sequence[Measurements]) -> list[Measurements]:
    """The recordings with the points of each symmetric target numbered consistently.

    No number changes if the intrinsics of some camera are not found. The numbers of one camera do not change if its
    rotation relative to the body is not found.
    """
    if not rig.target.symmetric:
        return list(recordings)
    try:
        params = _params_by_camera(rig, recordings)
    except EstimationError:  # the initial guess raises this error again
        return list(recordings)
    for part in parts_of(rig.target):
        if part[1].symmetric:
            recordings = [_renumbered(rig, part, params, m) for m in recordings]
    return list(recordings)


def _params_by_camera(rig: Rig, recordings: Sequence[Measurements]) -> ParamsByCamera:
    """Intrinsics and distortion of all cameras with corner streams. Raises EstimationError if some are not found."""
    streams = {c.name: [s for m in recordings for s in m.cameras if s.name == c.name] for c in rig.cameras}
    return {
        c.name: camera_params(c, CornerStream.joined(streams[c.name]), rig.target)
        for c in rig.cameras
        if streams[c.name]
    }


def _renumbered(rig: Rig, part: Part, params: ParamsByCamera, measured: Measurements) -> Measurements:
    """One recording with the points of one target, `part` (name, target, index of its first point), renumbered."""
    _, target, first = part
    cameras = {c.name: c for c in rig.cameras}
    views = [_views_of(cameras[s.name], s, part, params[s.name]) for s in measured.cameras]
    symmetries = _Symmetries.of(target)
    streams = []
    chosen = _chosen_symmetries(rig, measured, views, symmetries)
    for stream, camera_views, symmetry in zip(measured.cameras, views, chosen, strict=True):
        point = stream.point.copy()
        point[camera_views.rows] = (
            first + symmetries.number[symmetry[camera_views.images.image], camera_views.images.point]
        )
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

    The attitude of the target relative to the body is propagated over the images of all cameras with a known rotation
    on the body: by the gyroscope, or unchanged across its gaps and without a gyroscope.
    """
    imu = imu_data(rig, measured)
    cameras = sorted((k for k, v in enumerate(views) if v.poses.ok.any()), key=lambda k: -views[k].poses.ok.sum())
    gyro = None
    if imu is None:
        mounted = _mounted_by_images(measured, views, cameras, symmetries)
    else:
        mounted, gyro = _mounted_by_imu(imu, measured, views, cameras)
    chosen = [np.zeros(len(camera_views.images.stamps_ns), dtype=int) for camera_views in views]
    t, camera, image = _in_temporal_order(views, mounted)
    R_start_body, section = _attitudes(gyro, t)
    last = -1
    R_last = np.eye(3)
    for v, (k, i) in enumerate(zip(camera, image, strict=True)):
        poses, R_body_cam = views[k].poses, mounted[k].rotation
        if not poses.ok[i]:  # as the previous image, with which detection made it consistent
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
    """All images of the `mounted` cameras, sorted by time.

    Returns instants on the body's clock [s], camera numbers and image numbers, (V,) each."""
    t = [views[k].images.seconds + mount.offset for k, mount in mounted.items()]
    camera = [np.full(len(seconds), k) for k, seconds in zip(mounted, t, strict=True)]
    image = [np.arange(len(seconds)) for seconds in t]
    t, camera, image = (np.concatenate(x) if x else np.zeros(0, dtype=int) for x in (t, camera, image))
    order = np.argsort(t, kind="stable")
    return t[order], camera[order], image[order]


def _attitudes(gyro: GyroRotation | None, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R_start_body (V, 3, 3) at instants t (V,) [s], and (V,) the number of the gap-free section of the gyroscope.

    Without a gyroscope, all attitudes are the identity, in one section.
    """
    if gyro is None:
        return np.tile(np.eye(3), (len(t), 1, 1)), np.zeros(len(t), dtype=int)
    inside = np.clip(t, gyro.imu.seconds[0], gyro.imu.seconds[-1])
    return gyro.at(inside), np.searchsorted([begin for begin, _ in gyro.imu.gaps], t)


def _mounted_by_imu(
    imu: ImuData, measured: Measurements, views: list[_Views], cameras: list[int]
) -> tuple[dict[int, _CameraOnBody], GyroRotation | None]:
    """Alignments of the `cameras` whose angular rates match the IMU's, and the integrated gyroscope, None without any.

    cameras: numbers, the camera with most poses first. The first alignment gives the gyroscope bias.
    """
    aligned = {}
    for k in cameras:
        camera_views = views[k]
        with suppress(EstimationError):
            aligned[k] = align_camera(
                camera_views.camera,
                camera_views.images,
                camera_rates(camera_views.images, camera_views.poses),
                imu,
                measured,
            )
    biases = [a.gyro_bias for a in aligned.values()]
    gyro = GyroRotation.integrate(imu, biases[0]) if biases else None
    return {k: _CameraOnBody(a.rotation, a.offset) for k, a in aligned.items()}, gyro


def _mounted_by_images(
    measured: Measurements, views: list[_Views], cameras: list[int], symmetries: _Symmetries
) -> dict[int, _CameraOnBody]:
    """Alignments of the `cameras` that simultaneous images connect to the first one, which is the body.

    Empty if none is connected, because one camera alone does not show how the target moved between its images.
    """
    given = [camera_views.camera.time_offset.value for camera_views in views]
    offsets = [
        relative_offset(np.zeros(1) if g is None else g, camera_views.images, measured)
        for g, camera_views in zip(given, views, strict=True)
    ]
    R_body_cam = {k: np.eye(3) for k in cameras[:1]}
    while len(R_body_cam) < len(cameras):
        pairs = {
            (a, b): _simultaneous(views[a], offsets[a], views[b], offsets[b])
            for a in R_body_cam
            for b in cameras
            if b not in R_body_cam
        }
        (a, b), best = max(pairs.items(), key=lambda item: len(item[1]))
        if not len(best):
            break
        R_body_cam[b] = R_body_cam[a] @ _common_rotation(views[a].poses, views[b].poses, best, symmetries)
    return {k: _CameraOnBody(R, offsets[k]) for k, R in R_body_cam.items()} if len(R_body_cam) > 1 else {}


def _simultaneous(a: _Views, offset_a: float, b: _Views, offset_b: float) -> np.ndarray:
    """(n, 2) indices of simultaneous images with poses of two cameras, spread over the recording.

    offset_a, offset_b: time offsets [s], clocks counted from first stamps; n is at most `MAX_SYMMETRY_PAIRS`."""
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

    Each pair gives one candidate T_a_b for each symmetry. The correct candidates agree; the wrong ones vary with the
    attitude of the target. For each candidate, the distances to the nearest candidate of every pair have a median. The
    candidate with the least median is returned. One radian counts as one median distance from the target.
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
