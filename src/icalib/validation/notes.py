"""What a reader should know of a result besides its numbers, one sentence each."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.evidence.corner_noise import NoiseModel
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.clocks import instants
from icalib.motion.factor import of_type, pairs_of
from icalib.motion.imu_data import ImuData
from icalib.motion.nodes import usable
from icalib.result.timeline import Timeline
from icalib.rig import ImuSensor
from icalib.sensors.camera.bodies import words_on_left_out
from icalib.sensors.camera.circle_centres import centre_shifts
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.feature_factor import FeatureFactor
from icalib.sensors.imu.spec import INTRINSICS_LABELS, class_of_sigma
from icalib.validation.robot import robot_notes
from icalib.validation.upwards import upwards_notes

MOST_NAMED = 10  # images
GROWN_VIEWS = 10  # after which the noise of tracks is told once more


def notes(inputs: Inputs, found: Estimate, timeline: Timeline) -> Iterator[str]:
    """Of the recordings, then of each kind of sensor."""
    for k, span in enumerate(timeline.spans if len(timeline.spans) > 1 else (), 1):
        number = f"recording {k}"
        name = number if span.name == number else f"{number}, {span.name}"
        yield f"{name}: {span.end - span.start:.1f} s from {span.origin_ns} ns on."
    yield from inputs.measurements.notes
    if words := words_on_left_out(inputs.bodies):
        yield words
    if inputs.imu is not None:
        yield from _imu_notes(inputs, inputs.imu, found, timeline)
    factors = of_type(found.problem.factors, CornerFactor)
    apart = found.judged.apart or tuple(np.zeros(len(c.node), dtype=bool) for c in factors)
    cameras = zip(inputs.rig.cameras, factors, found.judged.models, apart, strict=True)
    for camera, factor, model, late in cameras:
        if len(factor.stream.uv):
            yield f"{camera.name}: {_noise_words(model)}."
            if words := _rejected_words(factor.keep[~late[factor.stream.image]]):
                yield f"{camera.name}: {words}"
        if factor.bodies.target.radii.any() and len(factor.stream.uv):
            size = np.linalg.norm(centre_shifts(factor, found.outcome.state), axis=1)
            yield (
                f"{camera.name}: ellipses have their centres {np.sqrt((size**2).mean()):.3f} px (RMS, {size.max():.2f} "
                "px at most) beside the projected centres of their circles; the estimate takes it into account."
            )
    if words := late_words(factors, apart):
        yield words
    yield from _feature_notes(found)
    yield from robot_notes(inputs, found)
    yield from upwards_notes(inputs, found)


def _feature_notes(found: Estimate):
    pairs = pairs_of(found.problem.factors, found.outcome.residuals, FeatureFactor)
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
            last = float(noise.sigma * np.sqrt(1.0 + noise.growth * GROWN_VIEWS))
            grows = f" in the first view, {last:.3f} px after {GROWN_VIEWS} more"
        yield f"{camera.name}: track noise {noise.sigma:.3f} px{grows}; {share} observations of tracks are in use."


def _imu_notes(inputs: Inputs, imu: ImuData, found: Estimate, timeline: Timeline):
    assert inputs.rig.imu is not None
    n, most = inputs.rig.imu.noise, inputs.rig.settings.max_gap_s
    if inputs.rig.assumes_motion:
        yield (
            f"there is no IMU: the motion is assumed to be smooth, in a second its rate to change by {n.gyro_walk:.2g} "
            f"rad/s and its acceleration by {n.accel_walk:.2g} m/s^2 (standard deviations of each axis), as poses show."
        )
        return
    yield (
        f"IMU noise ({n.source}): gyro {n.gyro:.3g} rad/s/sqrt(Hz), walk {n.gyro_walk:.3g}; accelerometer "
        f"{n.accel:.3g} m/s^2/sqrt(Hz), walk {n.accel_walk:.3g}."
    )
    if words := _intrinsics_words(inputs.rig.imu):
        yield words
    for a, b in imu.gaps:
        how = "bridged" if b - a <= most else "left out, with the images in it"
        yield f"{imu.name} has a gap of {b - a:.3f} s at {timeline.words(a)}, {how}."
    for camera in of_type(found.problem.factors, CornerFactor):
        t = instants(camera.stream, found.outcome.state.values)
        left_out = int((~usable(imu, t, most)).sum())
        if left_out:
            yield f"{left_out} images of {camera.name} are left out: {imu.name} was not running then."


def _intrinsics_words(imu: ImuSensor) -> str:
    """What was assumed of the IMU's scale and misalignment, where they are estimated; else empty."""
    if imu.intrinsics.mode != "prior" or imu.intrinsics.sigma is None:
        return ""
    sigma = dict(zip(INTRINSICS_LABELS, imu.intrinsics.sigma.tolist(), strict=True))
    name = class_of_sigma(imu.intrinsics.sigma)
    whose = "from the rig file" if name is None else f"of {'an' if name[0] in 'aeiou' else 'a'} {name} IMU"
    turn = np.rad2deg(sigma["gyro_rotation_x"])
    return (
        f"prior of IMU intrinsics {whose}: scale {100.0 * sigma['accel_xx']:.2g} % (accelerometer), "
        f"{100.0 * sigma['gyro_xx']:.2g} % (gyroscope), rotation between them {turn:.2g} deg (standard deviations)."
    )


def late_words(cameras: Sequence[CornerFactor], apart: Sequence[np.ndarray]) -> str:
    """A sentence on the images that were rejected because they are not simultaneous; "" if there are none.

    apart: by camera (M,) bool. The images at one keyframe are a set, which is named by its first image.
    """
    first_of, names = {}, []
    for camera, late in zip(cameras, apart, strict=True):
        if late.any():
            names.append(camera.name)
        for node, stamp in zip(camera.node[late].tolist(), camera.stream.stamps_ns[late].tolist(), strict=True):
            first_of.setdefault(node, camera.stream.which(stamp))
    if not first_of:
        return ""
    named = ", ".join(first_of[node] for node in sorted(first_of)[:MOST_NAMED])
    which = f", the first {MOST_NAMED}" if len(first_of) > MOST_NAMED else ""
    return (
        f"{len(first_of)} sets of images of {' and '.join(names)} were not exposed together, or the rig moved between, "
        f"and are left out{which}: {named}."
    )


def _rejected_words(keep: np.ndarray) -> str:
    """`keep` (N,) bool: corners in use, of images that are not rejected as a whole."""
    count = int((~keep).sum())
    if not count:
        return ""
    share = f"{count} of {len(keep)} corners ({100.0 * count / len(keep):.2g} %)"
    return (
        f"{share} are rejected as outliers: their residuals are far larger than those of the same image and of corners "
        "nearby."
    )


def _noise_words(model: NoiseModel) -> str:
    words = f"corner noise {model.base:.3f} px"
    if model.misfit > 0.0:
        words += f", {model.misfit:.2g} px that the lens model does not follow"
    if model.exposure > 0.0:
        words += f", {1e3 * model.exposure:.2f} px of motion blur at 1000 px/s of image speed"
    if model.tau:
        words += f", {' and '.join(f'{t:.3f}' for t in model.tau)} px common to an image"
    return words
