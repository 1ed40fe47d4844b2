"""Assessment of cameras: what a result keeps and says of them, and causes of a wrong result that lie in them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from icalib.base.remark import Remark
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs
from icalib.geometry import so3
from icalib.motion.factor import Factor, FactorKey, of_type, pairs_of
from icalib.motion.poses import instants, usable
from icalib.observability.assessor import AssessedEstimate, Assessment, Assessor, Cause, Remedy
from icalib.optim.state import State
from icalib.result import ParameterGroup, SensorFit
from icalib.result.calibration import Timeline
from icalib.result.quantities import excess, is_small, ratio, times
from icalib.rig import Camera, Rig
from icalib.sensors.camera.assess.lenses import (
    ambiguities,
    is_far_guess,
    swapped_words,
    wrong_lenses,
    wrong_models,
    wrong_resolutions,
)
from icalib.sensors.camera.corner_bias import centre_shifts
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.corner_noise import NoiseModel
from icalib.sensors.camera.model import CameraNoise, words_on_left_out
from icalib.sensors.camera.spec import BLOOM, INTRINSICS, LENS, READOUT
from icalib.sensors.camera.stream import CornerResiduals, TrackResiduals
from icalib.sensors.camera.track_factor import FeatureFactor
from icalib.sensors.camera.track_surfaces import ON_PLANES
from icalib.sensors.sensor import ROTATION, TRANSLATION

LARGE_BLOOM_PX = 0.8  # px; a warning above it: ink and overexposure shift edges by about a third of it


def assess(a: AssessedEstimate) -> Assessment:
    """What results say of this kind of sensor."""
    return Assessment(
        residuals=residuals(a.inputs, a.estimate, a.timeline),
        notes=notes(a.inputs, a.estimate, a.timeline),
        ambiguities=ambiguities(a.inputs, a.estimate, a.fits),
        warnings=warnings(a.inputs, a.estimate),
        value_warnings=value_warnings(a.groups),
        causes=causes(a),
        clock_causes=clock_causes(a.inputs, a.estimate),
        unreliable=unreliable(a.inputs.rig, a.estimate.problem.factors),
        many_rejected=many_rejected(a.fits),
        overstated_noise=overstated_noise(a.inputs.rig, a.fits),
    )


def causes(a: AssessedEstimate) -> Iterator[Cause]:
    """Cameras that are swapped, wrong resolutions, rolling shutters, fixed intrinsics of another camera, and camera
    models that do not follow the lens."""
    inputs, estimate = a.inputs, a.estimate
    yield from swapped_cameras(inputs.rig.cameras, a.groups)
    yield from wrong_resolutions(inputs, estimate, a.groups)
    yield from rolling_shutters(a)
    yield from wrong_lenses(inputs, a.relaxed_rig, a.factor)
    yield from wrong_models(inputs, estimate)


def keyframe_instants(inputs: Inputs, state: State) -> Iterator[tuple[str, np.ndarray]]:
    """Stream key and instants (M,) of the images of each camera, s on the body's clock since its first stamp."""
    yield from ((c.key, instants(c, state.values)) for c in inputs.measurements.cameras)


def value_warnings(groups: Sequence[ParameterGroup]) -> Iterator[Remark]:
    """A sentence for each camera whose edge bloom is too large for overexposure or ink."""
    for g in groups:
        if g.name == BLOOM.name and abs(g.value[0]) > LARGE_BLOOM_PX:
            where = "in" if g.value[0] > 0.0 else "out"
            yield Remark(
                "corners_shifted_on_tags",
                f"the corners of {g.sensor} lie {abs(g.value[0]):.1f} px too far {where} on their tags, more than "
                "light and ink do; check tag_size and tag_spacing (the gap over tag_size) of the target.",
            )


def length(camera: Camera, rig: Rig) -> str | None:
    """Text that names the camera's translation as the source of scale, if it is fixed or has a prior, and is not zero.

    Else None, as for the reference camera."""
    p = camera.translation
    stated = camera.name != rig.reference and p.mode != "free" and p.value is not None and bool(np.any(p.value))
    return f"the stated translation of {camera.name}" if stated else None


# Warnings on corners and tracks: residuals larger or smaller than their stated noise predicts, and many outliers.

# RMS above which a warning is given: ten times the error of a detector, twice that of corners in blurred images.
POOR_CORNER_RMS_PX = 1.0
MANY_REJECTED_SHARE = 0.05  # of the corners or tracks of a camera, above which a warning is given
# Share of tracks on planes below which a warning is given. Rough walls leave a tenth where two thirds are expected.
FEW_ON_PLANES_SHARE = 0.1


def warnings(inputs: Inputs, estimate: Estimate) -> Iterator[Remark]:
    """A sentence if `points_on_planes_m` is set, but no or few tracked points lie on planes of LiDARs; and on rolling
    shutters of a rig whose motion is assumed."""
    yield from _plane_warnings(inputs.rig, estimate.problem.factors)
    rolling = [camera.name for camera in inputs.rig.cameras if camera.rolling]
    if inputs.rig.assumes_motion and rolling:
        yield Remark(
            "rolling_shutter_without_imu",
            f"without an IMU the motion during the readout of {' and '.join(rolling)} is assumed to be smooth: errors "
            "of the readout time and of the lens reach three standard deviations. Add an IMU.",
        )


def _plane_warnings(rig: Rig, factors: Mapping[FactorKey, Factor]) -> Iterator[Remark]:
    """A sentence if `points_on_planes_m` is set, but no tracked points lie on planes, or too few to exclude chance."""
    if rig.settings.points_on_planes_m == 0.0:
        return
    features = of_type(factors, FeatureFactor)
    on, tracks = sum(int((f.on.plane >= 0).sum()) for f in features), sum(f.tracks.count for f in features)
    if on == 0:
        yield Remark(
            "no_tracked_points_on_planes",
            "no tracked points lie on planes of the LiDARs, so points_on_planes_m in the rig file has no effect; make "
            "it larger, or remove it if little is flat.",
        )
    elif on < FEW_ON_PLANES_SHARE * tracks:
        yield Remark(
            "few_tracked_points_on_planes",
            f"only {on} of the {tracks} tracks that cameras follow lie on planes of the LiDARs, so few that it may be "
            "chance; make points_on_planes_m in the rig file larger, or take it out where little is flat.",
        )


def unreliable(rig: Rig, factors: Mapping[FactorKey, Factor]) -> Iterator[str]:
    """Kinds of residuals that mean nothing: those of points on planes if so few lie there that it may be chance."""
    if any(_plane_warnings(rig, factors)):
        yield ON_PLANES


def many_rejected(fits: Sequence[SensorFit]) -> Iterator[Remark]:
    """A sentence for each camera of which many corners or tracks are rejected."""
    for f in fits:
        if f.kind in ("corners", "features") and f.rejected > MANY_REJECTED_SHARE * 0.5 * f.count:
            share = f.rejected / (f.rejected + 0.5 * f.count)
            yield Remark(
                "many_outliers_rejected",
                f"{share:.0%} of the {f.kind} of {f.sensor} are rejected as outliers; look at its residuals in the "
                "report.",
            )


def overstated_noise(rig: Rig, fits: Sequence[SensorFit]) -> Iterator[Remark]:
    """A sentence that names all cameras whose stated corner noise is too large.

    The trajectory then follows the IMU, and its residuals become small, too."""
    stated = {c.name for c in rig.cameras if c.corner_noise_px is not None}
    small = [f for f in fits if f.kind == "corners" and f.sensor in stated and is_small(f)]
    if small:
        sizes = " and ".join(f"{f.sensor} {ratio(f):.2g}x" for f in small)
        yield Remark(
            "corner_noise_overstated",
            f"residuals of corners are smaller than corner_noise predicts ({sizes}); standard deviations are too "
            "large. Leave corner_noise out, and it is estimated.",
        )


def misfit(camera: Camera, f: SensorFit, is_noise: bool) -> Remark | None:
    """A sentence if residuals are larger than the stated noise predicts, or corners fit worse than
    `POOR_CORNER_RMS_PX`; else None. f: fit of corners or of points on planes."""
    if f.kind == ON_PLANES and excess(f) > 1.0:
        return Remark(
            "tracked_points_off_planes",
            f"tracked points of {f.sensor} lie {times(f)} farther from planes of the LiDARs than points_on_planes_m "
            "predicts; make it larger, or take it out where little is flat.",
        )
    if f.kind != "corners":
        return None
    if f.rms is not None and f.rms > POOR_CORNER_RMS_PX:
        return Remark(
            "corners_fit_poorly",
            f"the corners of {f.sensor} fit to {f.rms:.1f} px only, ten times the error of a detector, and the cause "
            "is unknown. Check its camera model, fixed intrinsics, its topic, the target in the rig file, jumps of its "
            "clock, and blur of its images.",
        )
    if excess(f) > 1.0 and camera.corner_noise_px is not None:
        return Remark(
            "corner_noise_understated",
            f"residuals of the corners of {f.sensor} are {times(f)} larger than its corner_noise predicts, and the "
            "cause is unknown. Check its camera model, fixed intrinsics and its topic; if all are right, leave "
            "corner_noise out, and it is estimated.",
        )
    return None


# Cameras whose rows are exposed one after the other, or that are modelled as simultaneous but are not exposed together:
# residuals of the latter follow the image speed.

FASTEST_GAP_S = 1.0  # s between images; over more, their difference does not show the image speed
FOLLOWS_SPEED = 0.25  # least share of the squared residuals that the lag explains, in each of both cameras


def clock_causes(inputs: Inputs, estimate: Estimate) -> Iterator[Cause]:
    """A cause if the first two cameras of a rig without an IMU are not exposed together."""
    lag = _lag_between_cameras(inputs, estimate)
    if lag is not None:
        yield Cause(_words(lag), lag.gain, True)


def rolling_shutters(a: AssessedEstimate) -> Iterator[Cause]:
    """A cause for each camera with a rolling shutter, which also explains why fixed lenses contradict the data."""
    lenses = tuple((camera.name, group) for camera in a.inputs.rig.cameras for group in LENS)
    for e in a.effects:
        if e.spec is READOUT and e.differs:
            size = f"{1e3 * abs(e.value[0]):.3g} +- {1e3 * e.std[0]:.1g} ms"
            known = f"{e.sensor} has a rolling shutter, whose rows are exposed over {size}"
            note = f"{known}, and its readout time was estimated, too; write shutter: {{rolling: rows}}."
            remedy = Remedy(partial(_with_rows, name=e.sensor), Remark("rolling_shutter_estimated", note))
            sentence = Remark("rolling_shutter", f"{known}. Write shutter: {{rolling: rows}}.")
            yield Cause(sentence, e.gain, e.moves > 1.0, lenses, remedy)


def _with_rows(rig: Rig, name: str) -> Rig:
    """The rig with a rolling shutter of the camera `name`."""
    return rig.with_sensors(replace(rig.sensors[name], rolling="rows"))


@dataclass(frozen=True)
class _Lag:
    """Camera `second` is exposed `seconds` after camera `first`, according to residuals that follow the image speed.
    share: of the squared residuals that the lag explains; gain: decrease of chi^2."""

    first: str
    second: str
    seconds: float
    share: float
    gain: float


def _lag_between_cameras(inputs: Inputs, estimate: Estimate) -> _Lag | None:
    """The lag between the first two cameras of a rig without an IMU, whose images are modelled as simultaneous. None if
    it explains less than FOLLOWS_SPEED of the squared residuals of either camera."""
    cameras = pairs_of(estimate.problem.factors, estimate.outcome.residuals, CornerFactor)
    if inputs.rig.imu is not None or len(cameras) < 2:
        return None
    lags = []
    for camera, out in cameras[:2]:
        v, known = image_velocity(camera.stream.image, camera.stream.point, camera.stream.uv, camera.stream.seconds)
        known &= out.root > 0.0
        r, v = out.residual[known].astype(np.float64), v[known]
        square, along = float((r**2).sum()), float((r * v).sum())
        if not (known.any() and square > 0.0 and (v**2).sum() > 0.0):
            return None
        # Residuals are predicted minus measured. A late image shows points farther along their motion.
        coefficient = along / float((v**2).sum())
        weight = float((out.root[known].astype(np.float64) ** 2).mean())
        lags.append((-coefficient, along * coefficient / square, along * coefficient * weight))
    (a, share_a, gain_a), (b, share_b, gain_b) = lags
    if a * b >= 0.0 or min(share_a, share_b) < FOLLOWS_SPEED:
        return None
    return _Lag(cameras[0][0].name, cameras[1][0].name, b - a, min(share_a, share_b), gain_a + gain_b)


def image_velocity(
    image: np.ndarray, point: np.ndarray, uv: np.ndarray, seconds: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Velocity (N, 2) px/s of each corner, from the images before and after, and (N,) whether both show the corner."""
    count = int(point.max(initial=-1)) + 1
    table = np.full((len(seconds), count, 2), np.nan)
    table[image, point] = uv
    speed = np.full_like(table, np.nan)
    if len(seconds) > 2:
        step = seconds[2:] - seconds[:-2]
        speed[1:-1] = (table[2:] - table[:-2]) / step[:, None, None]
        speed[1:-1][step > 2.0 * FASTEST_GAP_S] = np.nan
    velocity = speed[image, point]
    known = np.asarray(np.isfinite(velocity).all(axis=1))
    return np.where(known[:, None], velocity, 0.0), known


def _words(lag: _Lag) -> Remark:
    """A sentence that two cameras are not exposed together."""
    first, second = (lag.first, lag.second) if lag.seconds > 0.0 else (lag.second, lag.first)
    return Remark(
        "cameras_not_simultaneous",
        f"{first} and {second} are not exposed together: residuals follow the image speed, as if {second} were about "
        f"{1e3 * abs(lag.seconds):.0f} ms late. Trigger the cameras together, hold the rig still for each pair of "
        "images, or record an IMU too: each camera then has a time offset of its own.",
    )


# Cameras that are swapped in the rig file.

GIVEN = (ROTATION, TRANSLATION, INTRINSICS)
FAR = 0.5  # prior standard deviations of initial guesses: 5 cm, 3 deg, 8 px
MUCH_NEARER = 0.3  # ratio of the distances of swapped to unswapped values, below which cameras count as swapped


def swapped_cameras(cameras: Sequence[Camera], groups: Sequence[ParameterGroup]) -> Iterator[Cause]:
    """Pairs of cameras that seem to be swapped: the estimate of each is near the stated values of the other."""
    estimates = {(g.sensor, g.name): g.value for g in groups}
    for a, b in combinations(cameras, 2):
        distances = _distance(a, estimates, a.name), _distance(b, estimates, b.name)
        crossed_distances = _distance(a, estimates, b.name), _distance(b, estimates, a.name)
        if max(distances) > FAR and max(crossed_distances) < MUCH_NEARER * max(distances):
            yield Cause(swapped_words(a.name, b.name), np.inf, True)


def _distance(camera: Camera, estimates: dict[tuple[str, str], np.ndarray], name: str) -> float:
    """Largest distance between the estimate of the camera `name` and the stated values of `camera`, in prior standard
    deviations of a guess."""
    distance = 0.0
    for spec in GIVEN:
        given, value = getattr(camera, spec.name).value, estimates.get((name, spec.name))
        if given is None or value is None:
            continue
        off = so3.value_change(given, value)
        distance = max(distance, float(np.linalg.norm(off)) / spec.prior_sigma)
    return distance


# Notes on the corners and feature tracks of cameras.

MAX_NAMED_IMAGES = 10  # images that one sentence lists
N_LATER_VIEWS = 10  # later views of a feature, for which a note states the track noise as well


def notes(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[Remark]:
    """Sentences on noise and outliers of corners and tracks, and on images that are left out."""
    if words := words_on_left_out(inputs.bodies):
        yield words
    factors = of_type(estimate.problem.factors, CornerFactor)
    yield from _outside_imu_notes(inputs, estimate, factors)
    noise: list[CameraNoise] = [estimate.measurement_model.noise[c.name] for c in inputs.rig.cameras]
    for camera, factor, camera_noise in zip(inputs.rig.cameras, factors, noise, strict=True):
        yield from _corner_notes(camera, factor, camera_noise.model, camera_noise.late, estimate)
    if words := late_words(factors, [camera_noise.late for camera_noise in noise]):
        yield words
    yield from _feature_notes(estimate)


def _outside_imu_notes(inputs: Inputs, estimate: Estimate, factors: Sequence[CornerFactor]) -> Iterator[Remark]:
    """Sentences on images that were taken while the IMU was not running."""
    if inputs.imu is None or inputs.rig.assumes_motion:
        return
    for camera in factors:
        t = instants(camera.stream, estimate.outcome.state.values)
        left_out = int((~usable(inputs.imu, t, inputs.rig.settings.max_gap_s)).sum())
        if left_out:
            sentence = f"{left_out} images of {camera.name} are left out: {inputs.imu.name} was not running then."
            yield Remark("images_outside_imu", sentence)


def _corner_notes(
    camera: Camera, factor: CornerFactor, model: NoiseModel, late: np.ndarray, estimate: Estimate
) -> Iterator[Remark]:
    """Sentences on noise, outliers and circle centres of one camera. late (M,) bool: images rejected as a whole."""
    if not len(factor.stream.uv):
        return
    yield Remark("corner_noise_estimated", f"{camera.name}: {_noise_words(model)}.")
    if model.rate:
        yield Remark(
            "image_clock_corrected",
            f"the clock of {camera.name}, whose stamps jitter, is corrected by {1e6 * model.rate:+.0f} ppm, by the "
            "other sensors.",
        )
    if model.jitter_std > 0.0:
        yield Remark(
            "image_stamps_jitter",
            f"the stamps of {camera.name} jitter by {1e3 * model.jitter:.2g} +- {1e3 * model.jitter_std:.1g} ms "
            "(standard deviation), by the residuals along the image velocity; the standard deviations take it into "
            "account. Let the camera stamp its images for a better result.",
        )
    if words := _rejected_words(factor.keep[~late[factor.stream.image]]):
        yield Remark("corners_rejected", f"{camera.name}: {words}")
    if factor.bodies.target.radii.any():
        size = np.linalg.norm(centre_shifts(factor, estimate.outcome.state), axis=1)
        yield Remark(
            "circle_centres_shifted",
            f"{camera.name}: ellipses have their centres {np.sqrt((size**2).mean()):.3f} px (RMS, {size.max():.2f} px "
            "at most) beside the projected centres of their circles; the estimate takes it into account.",
        )


def late_words(cameras: Sequence[CornerFactor], apart: Sequence[np.ndarray]) -> Remark | None:
    """A sentence on the images that were rejected because they are not simultaneous; None if there are none.

    apart: for each camera (M,) bool, its rejected images. All images at one keyframe are a set; its first image names
    the set.
    """
    first_of, names = {}, []
    for camera, late in zip(cameras, apart, strict=True):
        if late.any():
            names.append(camera.name)
        for keyframe, stamp in zip(camera.keyframe[late].tolist(), camera.stream.stamps_ns[late].tolist(), strict=True):
            first_of.setdefault(keyframe, camera.stream.which(stamp))
    if not first_of:
        return None
    named = ", ".join(first_of[keyframe] for keyframe in sorted(first_of)[:MAX_NAMED_IMAGES])
    which = f", the first {MAX_NAMED_IMAGES}" if len(first_of) > MAX_NAMED_IMAGES else ""
    return Remark(
        "images_not_simultaneous",
        f"{len(first_of)} sets of images of {' and '.join(names)} were not exposed together, or the rig moved between, "
        f"and are left out{which}: {named}.",
    )


def _rejected_words(keep: np.ndarray) -> str:
    """A sentence on the number of outliers; "" if there are none.

    keep (N,) bool: corners in use, without those of images that are rejected as a whole."""
    count = int((~keep).sum())
    if not count:
        return ""
    share = f"{count} of {len(keep)} corners ({100.0 * count / len(keep):.2g} %)"
    return (
        f"{share} are rejected as outliers: their residuals are far larger than those of the same image and of corners "
        "nearby."
    )


def _noise_words(model: NoiseModel) -> str:
    """Text that lists the terms of the corner noise."""
    words = f"corner noise {model.base:.3f} px"
    if model.misfit > 0.0:
        words += f", {model.misfit:.2g} px that the lens model does not follow"
    if model.exposure > 0.0:
        words += f", {1e3 * model.exposure:.2f} px of motion blur at 1000 px/s of image speed"
    if model.tau > 0.0:
        words += f", {model.tau:.3f} px common to an image"
    return words


def _feature_notes(estimate: Estimate) -> Iterator[Remark]:
    """Sentences on the number of feature tracks, their planes and their noise; none without tracks."""
    pairs = pairs_of(estimate.problem.factors, estimate.outcome.residuals, FeatureFactor)
    if not pairs:
        return
    factor, out = pairs[0]
    all_of_them = len(np.unique(np.concatenate([s.feature for s in factor.streams])))
    yield Remark(
        "feature_tracks_used",
        f"{all_of_them} points of the scene were followed, in {factor.tracks.count} tracks that show where they are; "
        "tracks that do not, for lack of parallax, are left out.",
    )
    if factor.surfaces is not None:
        plane = factor.on.plane[factor.on.plane >= 0]
        yield Remark(
            "tracks_on_planes",
            f"{len(plane)} of the tracks lie on {len(np.unique(plane))} planes that LiDARs see, to within "
            f"{1e3 * factor.surfaces.noise:.1f} mm, as the rig file has it.",
        )
    for camera, noise, root, stream in zip(factor.cameras, factor.noise, out.root, factor.streams, strict=True):
        share = f"{int((root > 0.0).sum())} of {len(stream.uv)}"
        grows = ""
        if noise.growth > 0.0:
            last = float(noise.sigma * np.sqrt(1.0 + noise.growth * N_LATER_VIEWS))
            grows = f" in the first view, {last:.3f} px after {N_LATER_VIEWS} more"
        sentence = f"{camera.name}: track noise {noise.sigma:.3f} px{grows}; {share} observations of tracks are in use."
        yield Remark("track_noise_estimated", sentence)


# Residuals of cameras that a result keeps: of corners of the target, and of feature tracks.


def residuals(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[CornerResiduals | TrackResiduals]:
    """Yields the corner residuals of each camera, then the track residuals of each camera if there are tracks."""
    yield from _corner_residuals(estimate, timeline)
    yield from _track_residuals(estimate, timeline)


def _corner_residuals(estimate: Estimate, timeline: Timeline) -> Iterator[CornerResiduals]:
    """Yields the corner residuals of each camera. A camera that saw no target has images without corners."""
    for i, (camera, corners) in enumerate(pairs_of(estimate.problem.factors, estimate.outcome.residuals, CornerFactor)):
        stream = camera.stream
        yield CornerResiduals(
            camera.name,
            _seconds(estimate, timeline, i),
            stream.start,
            stream.point,
            stream.uv,
            corners.residual,
            camera.noise.sigma,
            corners.root == 0.0,
        )


def _track_residuals(estimate: Estimate, timeline: Timeline) -> Iterator[TrackResiduals]:
    """Yields the track residuals of each camera; nothing if there are no tracks."""
    pairs = pairs_of(estimate.problem.factors, estimate.outcome.residuals, FeatureFactor)
    if not pairs:
        return
    factor, out = pairs[0]
    for i, (camera, stream) in enumerate(zip(factor.cameras, factor.streams, strict=True)):
        unused = (out.root[i] == 0.0)[:, None]
        residual = np.where(unused, np.nan, out.residual[i]).astype(np.float32)
        distance = np.linalg.norm(out.points[factor.tracks.camera == i], axis=1)
        yield TrackResiduals(
            camera.name,
            float(np.median(distance)) if len(distance) else None,
            _seconds(estimate, timeline, i),
            stream.start,
            stream.feature,
            stream.uv,
            residual,
            factor.sigmas[i].astype(np.float32),
            factor.outliers[i],
        )


def _seconds(estimate: Estimate, timeline: Timeline, index: int) -> np.ndarray:
    """(M,) instants [s] of the images of camera `index`, on the time axis of the result."""
    stream = of_type(estimate.problem.factors, CornerFactor)[index].stream
    return timeline.on_result_clock(instants(stream, estimate.outcome.state.values), timeline.recordings_of(stream.key))


ASSESSOR = Assessor(assess, misfit, keyframe_instants=keyframe_instants, length=length, is_far_guess=is_far_guess)
