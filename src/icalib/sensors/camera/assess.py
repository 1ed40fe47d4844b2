"""Residuals of cameras that a result keeps, and notes and warnings about corners and feature tracks."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.factor import Factor, FactorKey, of_type, pairs_of
from icalib.motion.keyframe_placement import usable
from icalib.motion.time_offsets import instants
from icalib.result import CornerResiduals, SensorFit, TrackResiduals
from icalib.result.excess import excess, times
from icalib.result.timeline import Timeline
from icalib.rig import Camera, Rig
from icalib.sensors.camera.circle_centres import centre_shifts
from icalib.sensors.camera.connected_bodies import words_on_left_out
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.corner_noise import NoiseModel
from icalib.sensors.camera.features.residual import FeatureFactor
from icalib.sensors.camera.features.surfaces import ON_PLANES
from icalib.sensors.camera.model import CameraNoise

MAX_NAMED_IMAGES = 10  # images that one sentence lists
N_LATER_VIEWS = 10  # later views of a feature, for which a note states the track noise as well
# RMS above which a warning is given: ten times the error of a detector, twice that of corners in blurred images.
POOR_CORNER_RMS_PX = 1.0
MANY_REJECTED_SHARE = 0.05  # of the corners or tracks of a camera, above which a warning is given
# Share of tracks on planes below which a warning is given. Rough walls leave a tenth where two thirds are expected.
FEW_ON_PLANES_SHARE = 0.1


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


def notes(inputs: Inputs, estimate: Estimate, timeline: Timeline) -> Iterator[str]:
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


def _outside_imu_notes(inputs: Inputs, estimate: Estimate, factors: Sequence[CornerFactor]) -> Iterator[str]:
    """Sentences on images that were taken while the IMU was not running."""
    if inputs.imu is None or inputs.rig.assumes_motion:
        return
    for camera in factors:
        t = instants(camera.stream, estimate.outcome.state.values)
        left_out = int((~usable(inputs.imu, t, inputs.rig.settings.max_gap_s)).sum())
        if left_out:
            yield f"{left_out} images of {camera.name} are left out: {inputs.imu.name} was not running then."


def _corner_notes(
    camera: Camera, factor: CornerFactor, model: NoiseModel, late: np.ndarray, estimate: Estimate
) -> Iterator[str]:
    """Sentences on noise, outliers and circle centres of one camera. late (M,) bool: images rejected as a whole."""
    if not len(factor.stream.uv):
        return
    yield f"{camera.name}: {_noise_words(model)}."
    if words := _rejected_words(factor.keep[~late[factor.stream.image]]):
        yield f"{camera.name}: {words}"
    if factor.bodies.target.radii.any():
        size = np.linalg.norm(centre_shifts(factor, estimate.outcome.state), axis=1)
        yield (
            f"{camera.name}: ellipses have their centres {np.sqrt((size**2).mean()):.3f} px (RMS, {size.max():.2f} px "
            "at most) beside the projected centres of their circles; the estimate takes it into account."
        )


def late_words(cameras: Sequence[CornerFactor], apart: Sequence[np.ndarray]) -> str:
    """A sentence on the images that were rejected because they are not simultaneous; "" if there are none.

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
        return ""
    named = ", ".join(first_of[keyframe] for keyframe in sorted(first_of)[:MAX_NAMED_IMAGES])
    which = f", the first {MAX_NAMED_IMAGES}" if len(first_of) > MAX_NAMED_IMAGES else ""
    return (
        f"{len(first_of)} sets of images of {' and '.join(names)} were not exposed together, or the rig moved between, "
        f"and are left out{which}: {named}."
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
    if model.tau:
        words += f", {' and '.join(f'{t:.3f}' for t in model.tau)} px common to an image"
    return words


def _feature_notes(estimate: Estimate) -> Iterator[str]:
    """Sentences on the number of feature tracks, their planes and their noise; none without tracks."""
    pairs = pairs_of(estimate.problem.factors, estimate.outcome.residuals, FeatureFactor)
    if not pairs:
        return
    factor, out = pairs[0]
    all_of_them = len(np.unique(np.concatenate([s.feature for s in factor.streams])))
    yield (
        f"{all_of_them} points of the scene were followed, in {factor.tracks.count} tracks that show where they are; "
        "tracks that do not, for lack of parallax, are left out."
    )
    if factor.surfaces is not None:
        plane = factor.on.plane[factor.on.plane >= 0]
        yield (
            f"{len(plane)} of the tracks lie on {len(np.unique(plane))} planes that LiDARs see, to within "
            f"{1e3 * factor.surfaces.noise:.1f} mm, as the rig file has it."
        )
    for camera, noise, root, stream in zip(factor.cameras, factor.noise, out.root, factor.streams, strict=True):
        share = f"{int((root > 0.0).sum())} of {len(stream.uv)}"
        grows = ""
        if noise.growth > 0.0:
            last = float(noise.sigma * np.sqrt(1.0 + noise.growth * N_LATER_VIEWS))
            grows = f" in the first view, {last:.3f} px after {N_LATER_VIEWS} more"
        yield f"{camera.name}: track noise {noise.sigma:.3f} px{grows}; {share} observations of tracks are in use."


def warnings(inputs: Inputs, estimate: Estimate) -> Iterator[str]:
    """A sentence if `points_on_planes_m` is set, but no or few tracked points lie on planes of LiDARs."""
    yield from plane_warnings(inputs.rig, estimate.problem.factors)


def plane_warnings(rig: Rig, factors: Mapping[FactorKey, Factor]) -> Iterator[str]:
    """A sentence if `points_on_planes_m` is set, but no tracked points lie on planes, or too few to exclude chance."""
    if rig.settings.points_on_planes_m == 0.0:
        return
    features = of_type(factors, FeatureFactor)
    on, tracks = sum(int((f.on.plane >= 0).sum()) for f in features), sum(f.tracks.count for f in features)
    if on == 0:
        yield (
            "no tracked points lie on planes of the LiDARs, so points_on_planes_m in the rig file has no effect; make "
            "it larger, or remove it if little is flat."
        )
    elif on < FEW_ON_PLANES_SHARE * tracks:
        yield (
            f"only {on} of the {tracks} tracks that cameras follow lie on planes of the LiDARs, so few that it may be "
            "chance; make points_on_planes_m in the rig file larger, or take it out where little is flat."
        )


def rejected_words(f: SensorFit) -> str | None:
    """A sentence if many corners or tracks of a camera are rejected; else None. f: its fit of one kind of residual."""
    if f.kind not in ("corners", "features") or f.rejected <= MANY_REJECTED_SHARE * 0.5 * f.count:
        return None
    share = f.rejected / (f.rejected + 0.5 * f.count)
    return f"{share:.0%} of the {f.kind} of {f.sensor} are rejected as outliers; look at its residuals in the report."


def misfit(camera: Camera, f: SensorFit, is_noise: bool) -> str | None:
    """A sentence if residuals are larger than the stated noise predicts, or corners fit worse than
    `POOR_CORNER_RMS_PX`; else None. f: fit of corners or of points on planes."""
    if f.kind == ON_PLANES and excess(f) > 1.0:
        return (
            f"tracked points of {f.sensor} lie {times(f)} farther from planes of the LiDARs than points_on_planes_m "
            "predicts; make it larger, or take it out where little is flat."
        )
    if f.kind != "corners":
        return None
    if f.rms is not None and f.rms > POOR_CORNER_RMS_PX:
        return (
            f"the corners of {f.sensor} fit to {f.rms:.1f} px only, ten times the error of a detector, and the cause "
            "is unknown. Check its camera model, fixed intrinsics, its topic, the target in the rig file, jumps of its "
            "clock, and blur of its images."
        )
    if excess(f) > 1.0 and camera.corner_noise_px is not None:
        return (
            f"residuals of the corners of {f.sensor} are {times(f)} larger than its corner_noise predicts, and the "
            "cause is unknown. Check its camera model, fixed intrinsics and its topic; if all are right, leave "
            "corner_noise out, and it is estimated."
        )
    return None


def length(camera: Camera, rig: Rig) -> str | None:
    """Text that names the camera's translation as the source of scale, if it is fixed or has a prior, and is not zero.

    Else None, as for the reference camera."""
    p = camera.translation
    stated = camera.name != rig.reference and p.mode != "free" and p.value is not None and bool(np.any(p.value))
    return f"the stated translation of {camera.name}" if stated else None
