"""From rig, measurements and a state to a `Problem`: one pass of the estimate."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.problem.inputs import Inputs, origin_difference
from icalib.estimate.problem.problem import ChainFactor, Problem
from icalib.geometry.cameras import camera_model
from icalib.model.bodies import SHAPE_SIGMA_M, SIZE
from icalib.model.sensor_model import Pass, SensorModel, kind_model, model_of
from icalib.motion.clocks import EARLY_S, instants
from icalib.motion.factor import Factor, keyed
from icalib.motion.independent_keyframes import IndependentKeyframes
from icalib.motion.keyframe_placement import MERGED_WITHIN_S, distinct, first_keyframes, place_keyframes, usable
from icalib.motion.poses import assign_keyframes, poses_at
from icalib.motion.sweep import Motion
from icalib.optim import pages
from icalib.optim.arrowhead import chain_cuts
from icalib.optim.calib_block import NOTHING
from icalib.optim.prior_factor import Prior
from icalib.optim.state import Block, Key, State
from icalib.rig import Camera, Parameter, Rig, Scheme, Sensor
from icalib.rig.scene import SHAPE_LABELS
from icalib.sensors import SENSOR_KINDS
from icalib.sensors.camera.bloom import bloom_direction
from icalib.sensors.camera.circle_centres import with_circle_centres
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.edge_curvature import with_bent_edges
from icalib.sensors.camera.features.feature_factor import FeatureFactor
from icalib.sensors.camera.features.patch_curvature import with_curved_patches
from icalib.sensors.camera.features.surfaces import Surfaces
from icalib.sensors.camera.features.tracks import TrackNoise
from icalib.sensors.imu.residual import ImuFactor
from icalib.sensors.sensor import TIME_OFFSET

NO_BLOOM = np.zeros((0, 2), dtype=np.float32)  # single precision: directions as such are near enough
CUT_S = 0.5


def _priors(inputs: Inputs) -> tuple[Prior, ...]:
    """All priors: those that belong to the model, those on nuisance parameters, and others that were given."""
    layout = inputs.layout
    priors = [
        Prior(layout.block(b, "shape"), np.zeros(len(SHAPE_LABELS)), SHAPE_SIGMA_M) for b in inputs.bodies.bending
    ]
    for block in layout.free:
        stated, spec = inputs.stated(block), inputs.specs[block.key]
        if stated is not None and spec.is_auxiliary and stated.mode == "free":
            priors.append(Prior(block, np.zeros(block.size), np.full(block.size, spec.prior_sigma)))
    return (*priors, *stated_priors(inputs))


def stated_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """All priors except the default ones on auxiliary parameters."""
    return (*_nuisance_priors(inputs), *given_priors(inputs))


def _nuisance_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """The priors on how imperfect sensors and targets are, whether the rig file gives them or they are the default."""
    priors, one = [], np.ones(1)
    for block in inputs.layout.free:
        stated = inputs.stated(block)
        if block.key == SIZE:
            priors.append(Prior(block, one, inputs.rig.target.size_sigma * one))
        elif block.is_nuisance and stated is not None:
            priors += _given(block, stated)
    return tuple(priors)


def given_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """The priors that the rig file gives on what is calibrated."""
    priors = []
    for block in inputs.layout.free:
        stated = inputs.stated(block)
        if stated is None or block.is_nuisance:
            continue
        is_clock = block.name == TIME_OFFSET.name
        shift = origin_difference(inputs.measurements, inputs.stream(block.sensor)) if is_clock else 0.0
        priors += _given(block, stated, shift)
    return tuple(priors)


def _given(block: Block, parameter: Parameter, shift: float = 0.0) -> list[Prior]:
    if parameter.mode != "prior" or parameter.value is None or parameter.sigma is None:
        return []
    value, sigma = parameter.value + shift, parameter.sigma
    if block.name == TIME_OFFSET.name:  # of a clock that restarts, the prior of each
        value, sigma = np.broadcast_to(value, block.size), np.broadcast_to(sigma, block.size)
    return [Prior(block, value, sigma)]


def image_times(inputs: Inputs, values: dict[Key, np.ndarray]) -> list[np.ndarray]:
    """Instants of each camera's images, seconds on the body's clock since its first stamp."""
    return [instants(c, values) for c in inputs.measurements.cameras]


def keyframe_times(inputs: Inputs, values: dict[Key, np.ndarray]) -> list[np.ndarray]:
    """Instants that keyframes are placed at, by sensor, seconds on the body's clock since its first stamp."""
    return [
        model.keyframe_times(sensor, inputs.stream(sensor.name), values, inputs.rig)
        for model, sensors in _keyframe_sources(inputs.rig)
        for sensor in sensors
    ]


def _keyframe_sources(rig: Rig) -> list[tuple[SensorModel, list[Sensor]]]:
    """The sensors of the first kind that places keyframes, and its model; of all kinds where the motion is an
    assumption that poses show."""
    found = []
    for kind in SENSOR_KINDS:
        model, own = kind_model(kind), [s for s in rig.sensors.values() if s.sensor_type == kind]
        if model.keyframes and own:
            found.append((model, own[:1] if model.only_first_places_keyframes else own))
    return found if rig.assumes_motion and rig.moves_by_poses else found[:1]


def resample(state: State, keyframes: np.ndarray, inputs: Inputs) -> State:
    """The same motion at other keyframes, by integrating the IMU from the nearest old one; without an IMU keyframes
    stay."""
    if inputs.imu is None:
        return state
    near = assign_keyframes("inertial", state.seconds, keyframes, inputs.imu.forwards)
    poses = poses_at("inertial", keyframes, near, state, inputs.imu, inputs.rig.gravity, False)
    starts = first_keyframes(inputs.imu, keyframes)
    return State(
        keyframes, poses.rotation, poses.position, poses.velocity, state.bias[near].copy(), state.values, starts
    )


def keyframes_for(inputs: Inputs, times: list[np.ndarray]) -> np.ndarray:
    """Keyframe times for images or scans at `times`. Raises EstimationError where clocks do not overlap."""
    settings = inputs.rig.settings
    if inputs.imu is None:
        return distinct(np.sort(np.concatenate(times)))
    hosts = times[:1] if settings.keyframes == "first-camera" else times
    keyframes = place_keyframes(inputs.imu, hosts, settings.keyframe_spacing_s, settings.max_gap_s)
    counts = np.diff((*first_keyframes(inputs.imu, keyframes), len(keyframes)))
    if counts.min() < 3:
        where = f"{inputs.parts[int(np.argmin(counts))].name}: " if len(inputs.parts) > 1 else ""
        raise EstimationError(
            f"{where}fewer than 3 {_hosts(inputs.rig)} fall within the recording of {inputs.imu.name}; check that the "
            "clocks overlap, or the time_offset in the rig file."
        )
    return keyframes


def _hosts(rig: Rig) -> str:
    model, sensors = _keyframe_sources(rig)[0]
    return f"{model.keyframes} of {', '.join(s.name for s in sensors)}"


@dataclass(frozen=True)
class Following:
    """Of tracks, by camera: their noise; keep (N,), observations in use; outliers (N,), those not in use because they
    stand out. cut: whether tracks are cut short."""

    noise: tuple[TrackNoise, ...]
    keep: tuple[np.ndarray, ...]
    outliers: tuple[np.ndarray, ...]
    cut: bool = False


def assemble(
    inputs: Inputs,
    state: State,
    noise: Mapping[str, Any],
    keep: Sequence[np.ndarray],
    held: np.ndarray = NOTHING,
    following: Following | None = None,
    coarse: bool = False,
) -> Problem:
    """The problem at the keyframes of `state`, everything frozen that a pass freezes: assignment, preintegration,
    corners on edges that the lens bends, or on straight ones where the lens is unknown (`coarse`).

    noise: by sensor, of the class that its kind has; keep: by camera (N,), corners in use; held: directions of the
    calibration parameters that are fixed, see Problem."""
    rig, layout = inputs.rig, inputs.layout
    factors = []
    scheme = rig.settings.scheme if inputs.imu is not None else "inertial"
    times = image_times(inputs, state.values)
    for camera, stream, t, k in zip(rig.cameras, inputs.measurements.cameras, times, keep, strict=True):
        own = [m.own[camera.name] for m in inputs.motions]
        keyframe = _keyframes_of(scheme, state, t, own, inputs.imu is not None and inputs.imu.forwards)
        seen = is_seen(inputs, t, state.seconds[keyframe])
        factor = CornerFactor(
            stream, camera_model(camera.model), inputs.imu, rig.gravity, scheme, stream.seconds, keyframe,
            k & np.repeat(seen, np.diff(stream.start)), noise[camera.name], NO_BLOOM, inputs.bodies, layout,
            len(state.seconds), tuple(images.start for images in own[1:]),
        )  # fmt: skip
        factor = factor if coarse else with_circle_centres(with_bent_edges(factor, state), state)
        factors.append(_with_bloom(factor, camera, state, rig) if rig.blooms else factor)
    # Beside one another, in a thread of its own: points of LiDARs use the solver's.
    with ThreadPoolExecutor(1) as aside:
        found = None if following is None else aside.submit(_features, inputs, state, tuple(factors), following)
        others = _others(inputs, state, noise, coarse)
        features = None if found is None else found.result()
    tracked = () if features is None else (features,)
    return Problem(
        layout, keyed((_chain(inputs, state), *factors, *tracked, *others)), _priors(inputs), inputs.tolerance, held,
        rig.has_target or rig.imu is None or (rig.assumes_motion and rig.moves_by_poses), not rig.assumes_motion,
    )  # fmt: skip


def motion_of(inputs: Inputs, state: State) -> Motion:
    """The IMU's motion as `state` has it."""
    assert inputs.imu is not None
    return Motion(state, inputs.imu, inputs.rig.gravity, inputs.rig.settings.max_gap_s)


def _others(inputs: Inputs, state: State, noise: Mapping[str, Any], coarse: bool) -> tuple[Factor, ...]:
    """Of all sensors but cameras and the IMU."""
    at, factors = _pass(inputs, state, coarse), []
    for sensor in inputs.sensors:
        model, own = model_of(sensor), (sensor, inputs.stream(sensor.name), noise[sensor.name], at)
        factors += model.still_factors(*own) if at.motion is None else model.factors(*own)
    return tuple(factors)


def _pass(inputs: Inputs, state: State, coarse: bool) -> Pass:
    if inputs.imu is not None:
        motion = motion_of(inputs, state)
        return Pass(inputs.rig, inputs.clouds, inputs.layout, state, motion, state.starts, coarse)
    begins = [part.begin - EARLY_S for part in inputs.parts[1:]]
    starts = (0, *(int(k) for k in np.searchsorted(state.seconds, begins)))
    return Pass(inputs.rig, inputs.clouds, inputs.layout, state, None, starts, coarse)


def _features(inputs: Inputs, state: State, cameras: tuple[CornerFactor, ...], following: Following) -> FeatureFactor:
    """Points of the scene, as tracks that the poses of `state` find."""
    settings = inputs.rig.settings
    streams = tuple(
        with_curved_patches(t, c.model, c.lens(state)) for t, c in zip(inputs.measurements.tracks, cameras, strict=True)
    )
    shown = on_the_chain(inputs, state, cameras)
    keep = tuple(k & s for k, s in zip(following.keep, shown, strict=True))
    loss = settings.loss, settings.loss_scale
    cuts, seams = chain_cuts(len(state.seconds)), state.starts[1:]
    if following.cut:
        cuts = (*cuts, *(int(k) + 1 for k in np.flatnonzero(np.diff(np.floor(state.seconds / CUT_S)))))
    surfaces = _surfaces(inputs, state, following.cut)
    factor = FeatureFactor.build(cameras, streams, following.noise, keep, loss, state, cuts, seams, surfaces)
    factor = replace(factor, outliers=following.outliers)
    return factor.coarse(state) if following.cut else factor


def on_the_chain(inputs: Inputs, state: State, cameras: tuple[CornerFactor, ...]) -> tuple[np.ndarray, ...]:
    """By camera, (N,) bool: observations of tracks in images that have a keyframe."""
    times, streams = image_times(inputs, state.values), inputs.measurements.tracks
    return tuple(
        np.repeat(is_seen(inputs, t, state.seconds[camera.keyframe]), np.diff(stream.start))
        for camera, stream, t in zip(cameras, streams, times, strict=True)
    )


def _surfaces(inputs: Inputs, state: State, coarse: bool) -> Surfaces | None:
    """Planes that points of the scene lie on, where the rig says that they do."""
    clouds, noise = inputs.clouds, inputs.rig.settings.points_on_planes_m
    if not clouds.count or noise == 0.0:
        return None
    at, planes = _pass(inputs, state, coarse), np.array([state.values[key] for key in clouds.keys])
    found = (model_of(s).points_on_planes(s, inputs.stream(s.name), at) for s in inputs.sensors)
    seen = (points for points in found if points is not None)
    return Surfaces.seen(clouds.keys, clouds.recording, planes, seen, noise, coarse)


def _keyframes_of(scheme: Scheme, state: State, times: np.ndarray, images: list[slice], forwards: bool) -> np.ndarray:
    """(n,) keyframe of each image at `times`, one of its own recording; `images` of each recording."""
    pairs = zip(images, state.recordings, strict=True)
    return np.concatenate([assign_keyframes(scheme, state.seconds[k], times[i], forwards) + k.start for i, k in pairs])


def _chain(inputs: Inputs, state: State) -> ChainFactor:
    if inputs.imu is None:
        return IndependentKeyframes(inputs.rig.reference, len(state.seconds))
    columns = inputs.layout.columns(inputs.imu.name, "intrinsics")
    return ImuFactor.build(inputs.imu, state, inputs.rig.gravity, columns[columns >= 0])


def is_seen(inputs: Inputs, times: np.ndarray, keyframes: np.ndarray) -> np.ndarray:
    """(n,) whether images at `times` can be used, each at its keyframe's instant: the IMU was running, or without one
    they were taken there."""
    if inputs.imu is None:
        return np.abs(times - keyframes) <= MERGED_WITHIN_S
    return usable(inputs.imu, times, inputs.rig.settings.max_gap_s)


def _with_bloom(factor: CornerFactor, camera: Camera, state: State, rig: Rig) -> CornerFactor:
    """The factor with the directions in which its corners bloom, frozen at `state`."""
    inwards = rig.target.tag_centers - rig.target.points
    params = factor.lens(state)
    direction = pages.zeros(factor.stream.uv.shape, np.float32)
    for own, X, R_cb in factor.in_camera(state):
        towards = np.einsum("nij,nj->ni", R_cb, inwards[factor.stream.point[own]])
        direction[own] = bloom_direction(factor.model, params, X, towards)
    return factor.with_direction(direction)


def start_values(inputs: Inputs, guess_values: dict[Key, np.ndarray]) -> dict[Key, np.ndarray]:
    """Values of all blocks: the guess, completed by what starts from zero."""
    rig, values = inputs.rig, guess_values | {SIZE: np.ones(1)}
    for name in inputs.bodies.bending:
        values[name, "shape"] = np.zeros(len(SHAPE_LABELS))
    for reference in inputs.bodies.names[:1]:
        values[reference, "rotation"], values[reference, "translation"] = np.eye(3), np.zeros(3)
    for sensor in rig.sensors.values():
        for spec in sensor.specs():
            value = model_of(sensor).start_value(sensor, spec, rig)
            if value is not None:
                values[sensor.name, spec.name] = value
    for sensor in rig.mounted:
        if (own := values.get((sensor.name, TIME_OFFSET.name))) is not None:
            values[sensor.name, TIME_OFFSET.name] = np.broadcast_to(own, inputs.clocks_of(sensor))
    return {key: np.ascontiguousarray(v, dtype=np.float64) for key, v in values.items()}
