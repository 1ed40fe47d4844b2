"""Sensor model of cameras: parameters, noise and factors of target corners and of feature tracks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from icalib.data.measurements import CornerStream, Measurements
from icalib.geometry.cameras import camera_model
from icalib.model.bodies import Bodies
from icalib.model.sensor_model import Clusters, Pass, SensorModel, model_of
from icalib.model.statistics import PassEnd
from icalib.motion.factor import Factor, FactorKey, of_type, pairs_of
from icalib.motion.time_offsets import instants
from icalib.optim.arrowhead import chain_cuts
from icalib.optim.state import Layout, State
from icalib.rig import LENS, Camera, ParameterSpec, Rig, Settings
from icalib.sensors.camera.bloom import with_bloom
from icalib.sensors.camera.circle_centres import with_circle_centres
from icalib.sensors.camera.connected_bodies import choose_bodies, restrict
from icalib.sensors.camera.corner_factor import CornerFactor, CornerNoise, CornerOutput
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
    scale_shift,
    with_jitter,
)
from icalib.sensors.camera.corner_outliers import inliers
from icalib.sensors.camera.corner_statistics import DELAY, SHIFT
from icalib.sensors.camera.edge_curvature import with_bent_edges
from icalib.sensors.camera.features.error_clusters import error_clusters
from icalib.sensors.camera.features.patch_curvature import with_curved_patches
from icalib.sensors.camera.features.residual import FeatureFactor
from icalib.sensors.camera.features.surfaces import Surfaces
from icalib.sensors.camera.features.track_selection import TrackSelection, next_selections, observed_at_keyframes
from icalib.sensors.camera.image_pairs import not_simultaneous
from icalib.sensors.camera.image_times import are_used, keyframes_of, on_common_images
from icalib.sensors.camera.spec import BLOOM
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

    keyframes = "images"

    def target_bodies(self, rig: Rig, recordings: Sequence[Measurements]) -> Bodies:
        """See `SensorModel`, and `choose_bodies`."""
        return choose_bodies(rig.target, recordings, rig.settings.board_shape, rig)

    def prepared(self, rig: Rig, bodies: Bodies, recording: Measurements) -> Measurements:
        """See `SensorModel`; corners and tracks of a camera get the same images."""
        return on_common_images(rig, restrict(bodies, recording))

    def is_estimated(self, sensor: Camera, spec: ParameterSpec, rig: Rig) -> bool:
        """See `SensorModel`. Bloom is estimated only if the target has edges that it shifts.

        Without an IMU, time offsets and the extrinsics of the reference camera are not estimated."""
        if rig.imu is None and (spec == TIME_OFFSET or (sensor.name == rig.reference and spec in MOUNTED)):
            return False
        return sensor.is_estimated(spec) and (spec != BLOOM or rig.blooms)

    def start_value(self, sensor: Camera, spec: ParameterSpec, rig: Rig) -> np.ndarray | None:
        """See `SensorModel`. Bloom that is not modelled is zero."""
        if spec == BLOOM and not rig.blooms:
            return np.zeros(BLOOM.size)
        return super().start_value(sensor, spec, rig)

    def widen_guess_sigma(self, sensor: Camera, layout: Layout, state: State, sigma: np.ndarray) -> None:
        """See `SensorModel`: errors of distortion coefficients add to those of fx and fy."""
        columns = layout.columns(sensor.name, *LENS)
        if (columns >= 0).all():
            sigma[columns[:2]] = np.hypot(sigma[columns[:2]], _focal_sigma(sensor, state, sigma[columns[4:]]))

    def first_noises(self, sensors: Sequence[Camera], rig: Rig, measurements: Measurements) -> dict[str, CameraNoise]:
        """For each camera the noise of the rig file or a default, with all corners and track observations in use."""
        noise, tracks = {}, {t.name: t for t in measurements.tracks}
        for camera, stream in zip(sensors, measurements.cameras, strict=True):
            model, keep = first_noise(camera), np.ones(len(stream.uv), dtype=bool)
            selection = TrackSelection.first(camera, tracks[camera.name]) if tracks else None
            late = np.zeros(len(stream.stamps_ns), dtype=bool)
            noise[camera.name] = CameraNoise(model, model.noise(stream, rig.settings), keep, late, selection)
        return noise

    def next_noises(
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

    def passes(self, sensors: Sequence[Camera], rig: Rig, measurements: Measurements) -> int:
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

    def still_factors(
        self, sensor: Camera, stream: CornerStream, noise: CameraNoise, at: Pass
    ) -> Iterator[CornerFactor]:
        """Yields the corner factor of the camera, as `factors` does."""
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
