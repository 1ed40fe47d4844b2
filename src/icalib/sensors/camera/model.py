"""Sensor model of cameras: parameters, noise and factors of target corners and of feature tracks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np

from icalib.base.remark import Remark
from icalib.data.measurements import CornerStream, Measurements
from icalib.errors import EstimationError
from icalib.geometry.cameras import camera_model
from icalib.geometry.targets import Target
from icalib.model.bodies import Bodies
from icalib.model.sensor_model import Clusters, Pass, PassEnd, SensorModel, model_of
from icalib.motion.factor import Factor, FactorKey, of_type, pairs_of
from icalib.motion.point_planes import PlaneAssociation
from icalib.motion.poses import MERGED_WITHIN_S, instants
from icalib.motion.sensor_pose import rate_slopes
from icalib.optim.arrowhead import chain_cuts
from icalib.optim.state import Layout, State
from icalib.rig import LENS, Camera, ParameterSpec, Rig, Settings
from icalib.sensors.camera.corner_bias import with_bent_edges, with_bloom, with_circle_centres
from icalib.sensors.camera.corner_factor import DELAY, SHIFT, CornerFactor, CornerNoise, CornerOutput
from icalib.sensors.camera.corner_noise import (
    INITIAL_COMMON_ERROR_PX,
    MAX_INITIAL_JITTER_S,
    WIDE_JITTER,
    NoiseModel,
    estimate_noise,
    first_noise,
    from_middle,
    image_flow,
    image_speed,
    inliers,
    scale_shift,
    with_jitter,
)
from icalib.sensors.camera.image_times import are_used, keyframes_of, not_simultaneous, on_common_images
from icalib.sensors.camera.spec import BLOOM, READOUT
from icalib.sensors.camera.track_factor import FeatureFactor
from icalib.sensors.camera.track_selection import TrackSelection, error_clusters, next_selections, observed_at_keyframes
from icalib.sensors.camera.track_surfaces import Surfaces, with_curved_patches
from icalib.sensors.sensor import MOUNTED, TIME_OFFSET

NO_BLOOM = np.zeros((0, 2), dtype=np.float32)  # directions without bloom; single precision is enough for directions
COEFFICIENT_STEP = 1e-4  # step of a distortion coefficient, for a difference quotient
COARSE_TRACK_S = 0.5  # s, longest track of an early pass: short tracks are cheap, and rough poses still fit them
ENOUGH_USED = 0.8  # share of track observations in use, above which no further pass is tried
MORE_USED = 1.1  # observations usable at the end of a pass over those in use, above which the pass is repeated


@dataclass(frozen=True)
class CameraNoise:
    """Noise and inliers of one camera.

    model: parameters of the corner noise; corners: the noise of each corner by this model. keep (N,) bool: corners in
    use. late (M,) bool: images that are rejected because they are not simultaneous with others of their keyframe.
    tracks: noise and inliers of its feature tracks; None if no camera has any.
    """

    model: NoiseModel
    corners: CornerNoise
    keep: np.ndarray
    late: np.ndarray
    tracks: TrackSelection | None = None


class CameraSensorModel(SensorModel[Camera, CameraNoise]):
    """Sensor model of cameras. Without an IMU, images with equal stamps are simultaneous."""

    def prepared(self, rig: Rig, recordings: Sequence[Measurements]) -> tuple[list[Measurements], Bodies]:
        """See `SensorModel` and `choose_bodies`; corners and tracks of a camera get the same images."""
        bodies = choose_bodies(rig.target, recordings, rig.settings.board_shape, rig)
        return [on_common_images(rig, restrict(bodies, recording)) for recording in recordings], bodies

    def is_estimated(self, sensor: Camera, spec: ParameterSpec, rig: Rig, association: PlaneAssociation) -> bool:
        """See `SensorModel`. Bloom is estimated only if the target has edges that it shifts.

        Without an IMU, time offsets, readout times and the extrinsics of the reference camera are not estimated."""
        if rig.imu is None and (spec in (TIME_OFFSET, READOUT) or (sensor.name == rig.reference and spec in MOUNTED)):
            return False
        return sensor.is_estimated(spec) and (spec != BLOOM or rig.blooms)

    def widen_guess_sigma(self, sensor: Camera, layout: Layout, state: State, sigma: np.ndarray) -> None:
        """See `SensorModel`: errors of distortion coefficients add to those of fx and fy."""
        columns = layout.columns(sensor.name, *LENS)
        if (columns >= 0).all():
            sigma[columns[:2]] = np.hypot(sigma[columns[:2]], _focal_sigma(sensor, state, sigma[columns[4:]]))

    def first_noise(self, sensors: Sequence[Camera], rig: Rig, measurements: Measurements) -> dict[str, CameraNoise]:
        """For each camera the noise of the rig file or a default, with all corners and track observations in use."""
        noise, tracks = {}, {t.name: t for t in measurements.tracks}
        for camera, stream in zip(sensors, measurements.cameras, strict=True):
            model, keep = first_noise(camera), np.ones(len(stream.uv), dtype=bool)
            selection = TrackSelection.first(camera, tracks[camera.name]) if tracks else None
            late = np.zeros(len(stream.stamps_ns), dtype=bool)
            noise[camera.name] = CameraNoise(model, model.noise(stream, rig.settings), keep, late, selection)
        return noise

    def next_noise(
        self, sensors: Sequence[Camera], noise: Mapping[str, CameraNoise], end: PassEnd
    ) -> dict[str, CameraNoise]:
        """For each camera the noise of the next pass.

        Rejects outliers and images that are not simultaneous. Estimates noise that the rig file does not state."""
        pairs, settings = pairs_of(end.factors, end.residuals, CornerFactor), end.rig.settings
        late, next_noise = _late_images(pairs, end), _next_tracks(sensors, noise, end)
        estimated = _noise_is_estimated(sensors, [c.stream for c, _ in pairs], bool(of_tracks(end.factors)), settings)
        for camera, (factor, out), apart in zip(sensors, pairs, late, strict=True):
            keep = inliers(factor, out, settings) & ~apart[factor.stream.image]
            next_noise[camera.name] = replace(next_noise[camera.name], keep=keep, late=apart)
            if estimated:
                model, corners = _next_corner_noise(camera, noise[camera.name].model, factor, out, end)
                next_noise[camera.name] = replace(next_noise[camera.name], model=model, corners=corners)
        return next_noise

    def passes(
        self, sensors: Sequence[Camera], rig: Rig, measurements: Measurements, association: PlaneAssociation
    ) -> int:
        """Passes needed to estimate noise and inliers: two with common errors of an image, else one, or zero.

        Outliers of tracks need a pass even if all noise is stated, because they show only once the lens is known."""
        settings, tracked = rig.settings, bool(measurements.tracks)
        estimated = _noise_is_estimated(sensors, measurements.cameras, tracked, settings)
        if not (estimated or (tracked and settings.outlier_std > 0.0)):
            return 0
        uneven = rig.imu is not None and any(s.jitter_s > 0.0 for s in measurements.cameras)
        return 2 if settings.common_error or uneven else 1

    def factors(self, sensor: Camera, stream: CornerStream, noise: CameraNoise, at: Pass) -> Iterator[CornerFactor]:
        """Yields the corner factor of the camera, which may have no corners."""
        yield corner_factor(sensor, stream, noise, at)

    def joint_factors(
        self, sensors: Sequence[Camera], factors: Sequence[Factor], noise: Mapping[str, CameraNoise], at: Pass
    ) -> tuple[FeatureFactor, ...]:
        """One factor of the feature tracks of all cameras; none without tracks."""
        cameras = tuple(f for f in factors if isinstance(f, CornerFactor))
        tracks = [selection for s in sensors if (selection := noise[s.name].tracks) is not None]
        return (feature_factor(cameras, tracks, at),) if tracks else ()

    def uses_more(self, used: Mapping[FactorKey, Factor], rebuilt: Callable[[], Mapping[FactorKey, Factor]]) -> bool:
        """See `SensorModel`: whether the final poses of the pass locate many more track points than its first poses."""
        (now,) = of_tracks(used) or (None,)
        if now is None or now.n_used > ENOUGH_USED * sum(int(k.sum()) for k in now.keep):
            return False
        return any(f.n_used > MORE_USED * now.n_used for f in of_tracks(rebuilt()))

    def clusters(self, factors: Mapping[FactorKey, Factor]) -> Iterator[Clusters]:
        """Clusters of corners and track observations whose errors may correlate, see `error_clusters`."""
        return error_clusters(of_type(factors, CornerFactor), of_tracks(factors))


def _focal_sigma(camera: Camera, state: State, sigma: np.ndarray) -> float:
    """Standard deviation of fx [px] due to errors of the distortion coefficients, with standard deviations `sigma`.

    A guess gives the scale at the image centre. In some models this scale depends on a coefficient, too: it is fx / (1
    + xi) in the unified model. An error of xi then changes fx.
    """
    model, fx = camera_model(camera.model), state.values[camera.name, "intrinsics"][0]
    lens = np.concatenate([state.values[camera.name, name] for name in LENS])
    steps = lens + COEFFICIENT_STEP * np.eye(len(lens))[4:]
    slope = (np.array([model.central_scale(p) for p in steps]) / model.central_scale(lens) - 1.0) / COEFFICIENT_STEP
    return float(fx * np.sqrt(((slope * sigma) ** 2).sum()))


def corner_factor(camera: Camera, stream: CornerStream, noise: CameraNoise, at: Pass) -> CornerFactor:
    """The corner factor of one camera, with lens and poses of `at`.

    Early (coarse) passes leave out the corrections of circle centres and edge curvature, which need a good lens."""
    rig, state, imu = at.rig, at.state, at.imu
    scheme = rig.settings.scheme if imu is not None else "inertial"
    seconds = stream.seconds + noise.model.rate * from_middle(stream)
    times, images = instants(stream, state.values, seconds), [part.rows[camera.name] for part in at.parts]
    keyframe = keyframes_of(scheme, state, times, images, imu)
    used = are_used(imu, times, state.seconds[keyframe], rig.settings.max_gap_s)
    gravity = 0.0 if at.motion is None else at.motion.gravity  # no effect without an IMU
    factor = CornerFactor(
        stream, camera_model(camera.model), imu, gravity, scheme, seconds, keyframe,
        noise.keep & np.repeat(used, np.diff(stream.start)), noise.corners, NO_BLOOM, at.bodies, at.layout,
        len(state.seconds), tuple(recording_images.start for recording_images in images[1:]),
        None if imu is None else camera.shutter,
        rate_slopes(state) if rig.assumes_motion and camera.rolling is not None else None,
    )  # fmt: skip
    factor = factor if at.coarse else with_circle_centres(with_bent_edges(factor, state), state)
    return with_bloom(factor, state) if rig.blooms else factor


def feature_factor(cameras: tuple[CornerFactor, ...], selected: Sequence[TrackSelection], at: Pass) -> FeatureFactor:
    """The factor of the feature tracks of all cameras whose points can be triangulated with the poses of `at`.

    selected: noise and inliers of each camera's tracks."""
    settings, state = at.rig.settings, at.state
    streams = tuple(
        with_curved_patches(t, c.model, c.lens(state)) for t, c in zip(at.measurements.tracks, cameras, strict=True)
    )
    observed = observed_at_keyframes(cameras, at.measurements.tracks, state, settings.max_gap_s)
    keep = tuple(selection.keep & s for selection, s in zip(selected, observed, strict=True))
    noise, outliers = tuple(s.noise for s in selected), tuple(s.outliers for s in selected)
    cuts = chain_cuts(len(state.seconds))
    if at.coarse:
        cuts = (*cuts, *(int(k) + 1 for k in np.flatnonzero(np.diff(np.floor(state.seconds / COARSE_TRACK_S)))))
    factor = FeatureFactor(
        cameras, streams, noise, keep, settings.loss, settings.loss_scale, cameras[0].layout, state.starts[1:],
        _surfaces(at), outliers,
    ).cut(state, cuts)  # fmt: skip
    return factor.coarse(state) if at.coarse else factor


def of_tracks(factors: Mapping[FactorKey, Factor]) -> tuple[FeatureFactor, ...]:
    """The factor of feature tracks in a tuple, which is empty without tracks."""
    return of_type(factors, FeatureFactor)


def _surfaces(at: Pass) -> Surfaces | None:
    """LiDAR planes that tracked points may lie on; None without planes, or if `points_on_planes_m` is 0."""
    association, noise, streams = at.association, at.rig.settings.points_on_planes_m, at.measurements.streams
    if not association.count or noise == 0.0:
        return None
    planes = np.array([at.state.values[key] for key in association.keys])
    clouds_of_sensors = (model_of(s).points_on_planes(s, streams[s.name], at) for s in at.rig.mounted)
    points_on_planes = (points for points in clouds_of_sensors if points is not None)
    return Surfaces.of_clouds(association.keys, association.recording, planes, points_on_planes, noise, at.coarse)


def _late_images(pairs: Sequence[tuple[CornerFactor, CornerOutput]], end: PassEnd) -> list[np.ndarray]:
    """For each camera (M,) bool: images that are not simultaneous with others of their keyframe.

    Tested only in rigs of cameras alone with two or more cameras; else all False."""
    settings = end.rig.settings
    if len(pairs) < 2 or not end.rig.cameras_alone or settings.outlier_std <= 0.0:
        return [np.zeros(len(c.keyframe), dtype=bool) for c, _ in pairs]
    return not_simultaneous([c for c, _ in pairs], [out for _, out in pairs], settings)


def _next_tracks(cameras: Sequence[Camera], noise: Mapping[str, CameraNoise], end: PassEnd) -> dict[str, CameraNoise]:
    """The present noise of each camera, with the track selection of the next pass."""
    next_noise = {c.name: noise[c.name] for c in cameras}
    for factor, out in pairs_of(end.factors, end.residuals, FeatureFactor):
        now = [selection for c in cameras if (selection := noise[c.name].tracks) is not None]
        tracks = next_selections(cameras, factor, out, now, end)
        for camera, selection in zip(cameras, tracks, strict=True):
            next_noise[camera.name] = replace(next_noise[camera.name], tracks=selection)
    return next_noise


def _next_corner_noise(
    camera: Camera, present: NoiseModel, factor: CornerFactor, out: CornerOutput, end: PassEnd
) -> tuple[NoiseModel, CornerNoise]:
    """The corner noise of the next pass, estimated from the residuals `out` of this pass with the noise `present`: its
    model, and the noise of each corner. Unchanged if the camera sees no target."""
    settings = end.rig.settings
    if not factor.sees_target:
        return first_noise(camera), factor.noise
    flow = image_flow(factor, end.state)
    speed = image_speed(factor, flow)
    model, large = estimate_noise(camera, settings, factor, out, speed)
    model = replace(model, rate=present.rate)
    fits = end.of(camera.name).fits if len(factor.noise.tau) else {}
    if settings.common_error:
        tau = scale_shift(present.tau, fits[SHIFT]) if present.tau else INITIAL_COMMON_ERROR_PX
        model = replace(model, tau=tau)
    if end.is_first and end.rig.imu is not None:
        model = replace(model, jitter=min(WIDE_JITTER * factor.stream.jitter_s, MAX_INITIAL_JITTER_S))
    elif present.jitter > 0.0 and len(factor.noise.tau) % 2:
        model = with_jitter(model, present, factor, out, fits[DELAY])
    # A large misfit of the lens model makes good corners look like outliers.
    model = replace(model, wide_loss=large and end.rig.cameras_alone)
    return model, model.noise(factor.stream, settings, speed, flow)


def _noise_is_estimated(
    cameras: Sequence[Camera], streams: Sequence[CornerStream], tracked: bool, settings: Settings
) -> bool:
    """Whether some noise of corners or tracks is estimated from residuals. streams: corners of each camera; tracked:
    whether there are feature tracks."""
    cornered = [c for c, s in zip(cameras, streams, strict=True) if len(s.uv)]
    return (
        (bool(cornered) and (settings.blur_noise or settings.common_error))
        or any(c.corner_noise_px is None for c in cornered)
        or (tracked and any(c.track_noise_px is None for c in cameras))
    )


MODEL = CameraSensorModel()


# Selects the bodies of a target whose poses are estimated: those that shared images connect.

MIN_SHARED_IMAGES = 3  # that show both of two bodies, for their relative pose to count as observed
MAX_NAMED_BODIES = 8  # in a sentence


def choose_bodies(target: Target, recordings: Sequence[Measurements], bent: bool, rig: Rig | None = None) -> Bodies:
    """The bodies in use: the one with most corners, which is the reference, and all that images connect to it.

    An image connects all bodies that it shows; connections through other bodies count. In a `rig` of cameras alone,
    simultaneous images of different cameras connect bodies, too. bent: whether shapes of bodies are estimated.

    Raises EstimationError if no corner was seen, or if a camera saw only bodies without connection to the reference.
    """
    streams = [c for m in recordings for c in m.cameras]
    n = len(target.bodies)
    if n == 0:
        return Bodies(target, ())
    count = sum((np.bincount(target.body[s.point], minlength=n) for s in streams), np.zeros(n, dtype=np.int64))
    if not count.any():
        raise EstimationError("no camera saw the target; check the target in the rig file.")
    together = _in_images(target.body, recordings, n)
    if rig is not None and rig.cameras_alone:
        together += sum(_at_once(target.body, rig, m, n) for m in recordings)
    reached = _tied_to(int(np.argmax(count)), together)
    lost = tuple(int(k) for k in np.flatnonzero(count) if k not in reached)
    _check_cameras(target, streams, reached, rig is not None and rig.imu is not None)
    return Bodies(target, reached, lost, bent, sized=target.size_sigma > 0.0)


def tied_by_images(bodies: Bodies, recordings: Sequence[Measurements]) -> list[tuple[int, ...]]:
    """The bodies in use, grouped by connection through images. The first group has the reference."""
    together = _in_images(bodies.target.body, recordings, len(bodies.target.bodies))
    left, groups = list(bodies.used), []
    while left:
        groups.append(_tied_to(left[0], together))
        left = [k for k in left if k not in groups[-1]]
    return groups


def _tied_to(first: int, together: np.ndarray) -> tuple[int, ...]:
    """Indices of the body `first`, then in increasing order of all bodies connected to it.

    together (n, n): number of images that show both bodies of a pair."""
    reached = [first]
    for k in reached:
        reached += [int(j) for j in np.flatnonzero(together[k] >= MIN_SHARED_IMAGES) if j not in reached]
    return (first, *sorted(reached[1:]))


def _in_images(body: np.ndarray, recordings: Sequence[Measurements], n: int) -> np.ndarray:
    """(n, n) number of images, of all recordings and cameras, that show both bodies of a pair.

    body (n_points,): index of the body of each point."""
    return sum((_together(body, c, n) for m in recordings for c in m.cameras), np.zeros((n, n), dtype=np.int64))


def _check_cameras(target: Target, streams: Sequence[CornerStream], used: Sequence[int], imu: bool) -> None:
    """Raises EstimationError naming a camera that saw bodies, but none of those in use.

    used: indices of these; imu: whether the rig has an IMU."""
    for name in dict.fromkeys(s.name for s in streams):
        bodies = np.unique(np.concatenate([target.body[s.point] for s in streams if s.name == name]))
        if len(bodies) and not np.isin(bodies, used).any():
            how = (
                "calibrate the cameras without the IMU, whose images may be synchronised"
                if imu
                else ("take images of all cameras at the same instants")
            )
            names, first = _listed([target.bodies[k] for k in bodies]), target.bodies[used[0]]
            raise EstimationError(
                f"{name} sees {names} only, and fewer than {MIN_SHARED_IMAGES} images determine its pose relative "
                f"to {first}; show both in the same images, or {how}."
            )


def _together(body: np.ndarray, stream: CornerStream, n: int) -> np.ndarray:
    """(n, n) number of images of `stream` that show both bodies of a pair."""
    pairs = np.unique(stream.image * n + body[stream.point])
    image, which = np.divmod(pairs, n)
    shows = np.zeros((len(stream.stamps_ns), n), dtype=np.float32)
    shows[image, which] = 1.0
    return np.rint(shows.T @ shows).astype(np.int64)


def _at_once(body: np.ndarray, rig: Rig, recording: Measurements, n: int) -> np.ndarray:
    """(n, n) number of instants at which one camera sees body i while another camera sees body j."""
    count, shows = np.zeros((n, n), dtype=np.int64), []
    for stream in recording.cameras:
        rows = np.zeros((len(stream.stamps_ns), n), dtype=np.int64)
        rows[stream.image, body[stream.point]] = 1
        shows.append(rows)
    times = camera_times(rig, recording, recording.origin_ns)
    for a, b in permutations(range(len(shows)), 2):
        i, j = taken_at_once(times[a], times[b])
        count += shows[a][i].T @ shows[b][j]
    return count


def camera_times(rig: Rig, recording: Measurements, origin_ns: int) -> list[np.ndarray]:
    """For each camera (M,) instants of its images [s since `origin_ns`], by the time offset of the rig file or zero."""
    given = [c.time_offset.value for c in rig.cameras]
    offsets_ns = [0 if v is None else round(float(v[0]) * 1e9) for v in given]
    pairs = zip(recording.cameras, offsets_ns, strict=True)
    return [(s.stamps_ns - origin_ns + offset_ns) * 1e-9 for s, offset_ns in pairs]


def taken_at_once(ta: np.ndarray, tb: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices i and j (k,) of images at ta (n,) and tb (m,) s that are at most `MERGED_WITHIN_S` apart."""
    j = np.clip(np.searchsorted(tb, ta - MERGED_WITHIN_S), 0, len(tb) - 1)
    i = np.flatnonzero(np.abs(tb[j] - ta) <= MERGED_WITHIN_S)
    return i, j[i]


def restrict(bodies: Bodies, recording: Measurements) -> Measurements:
    """The recording without corners of bodies that are not in use; corners of each image are sorted by body."""
    if len(bodies.target.bodies) == 1:
        return recording
    return recording.with_streams(*(_restricted(bodies, c) for c in recording.cameras))


def without_bodies(target: Target, names: Sequence[str], recording: Measurements) -> Measurements:
    """The recording without corners of the bodies called `names`, with a note on them."""
    kept = tuple(k for k, name in enumerate(target.bodies) if name not in names)
    cameras = [_restricted(Bodies(target, kept), c) for c in recording.cameras]
    sentence = f"ignored, because no image determines their poses relative to the others: {_listed(names)}."
    note = Remark("bodies_unconnected", sentence)
    return replace(recording.with_streams(*cameras), notes=(*recording.notes, note))


def _restricted(bodies: Bodies, stream: CornerStream) -> CornerStream:
    """The corners of bodies in use, sorted by body in each image. Images without such corners are left out."""
    body = bodies.target.body[stream.point]
    order = np.lexsort((body, stream.image))
    order = order[np.isin(body[order], bodies.used)]
    count = np.bincount(stream.image[order], minlength=len(stream.stamps_ns))
    return stream.of_rows(order, stream.stamps_ns[count > 0], count[count > 0])


def words_on_left_out(bodies: Bodies) -> Remark | None:
    """A sentence on the bodies that were seen but are not used; None if there are none."""
    if not bodies.left_out:
        return None
    names = [bodies.target.bodies[k] for k in bodies.left_out]
    return Remark(
        "bodies_seen_rarely",
        f"ignored, because fewer than {MIN_SHARED_IMAGES} images show them together with the others: {_listed(names)}.",
    )


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - MAX_NAMED_BODIES} more" if len(names) > MAX_NAMED_BODIES else ""
    return f"{', '.join(names[:MAX_NAMED_BODIES])}{more}"
