"""Notes on the corners and feature tracks of cameras."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.factor import of_type, pairs_of
from icalib.motion.keyframe_placement import usable
from icalib.motion.time_offsets import instants
from icalib.result.timeline import Timeline
from icalib.rig import Camera
from icalib.sensors.camera.circle_centres import centre_shifts
from icalib.sensors.camera.connected_bodies import words_on_left_out
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.corner_noise import NoiseModel
from icalib.sensors.camera.features.residual import FeatureFactor
from icalib.sensors.camera.model import CameraNoise

MAX_NAMED_IMAGES = 10  # images that one sentence lists
N_LATER_VIEWS = 10  # later views of a feature, for which a note states the track noise as well


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
    if model.rate:
        yield (
            f"the clock of {camera.name}, whose stamps jitter, is corrected by {1e6 * model.rate:+.0f} ppm, by the "
            "other sensors."
        )
    if model.jitter_std > 0.0:
        yield (
            f"the stamps of {camera.name} jitter by {1e3 * model.jitter:.2g} +- {1e3 * model.jitter_std:.1g} ms "
            "(standard deviation), by the residuals along the image velocity; the standard deviations take it into "
            "account. Let the camera stamp its images for a better result."
        )
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
    if model.tau > 0.0:
        words += f", {model.tau:.3f} px common to an image"
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
