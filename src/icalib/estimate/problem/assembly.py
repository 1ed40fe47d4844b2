"""From rig, measurements and a state to a `Problem`: one pass of the estimate."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.problem.inputs import Inputs, origin_difference
from icalib.estimate.problem.problem import ChainFactor, Problem
from icalib.estimate.problem.robot import NO_ROBOT, RobotNoise, robot_factors
from icalib.geometry.cameras import camera_model
from icalib.motion.clocks import EARLY_S, instants
from icalib.motion.factor import Factor, keyed
from icalib.motion.free_nodes import FreeNodes
from icalib.motion.nodes import MERGED_WITHIN_S, distinct, first_nodes, place_nodes, usable
from icalib.motion.poses import assign_nodes, poses_at
from icalib.motion.sweep import Motion
from icalib.optim import pages
from icalib.optim.arrowhead import chain_cuts
from icalib.optim.calib_block import NOTHING
from icalib.optim.prior_factor import Prior
from icalib.optim.state import Key, Layout, State
from icalib.rig import Camera, ImuSensor, Parameter, Rig, Scheme
from icalib.rig.scene import SHAPE_LABELS
from icalib.sensors.camera.board import SHAPE_SIGMA_M, bloom_direction
from icalib.sensors.camera.bodies import SIZE
from icalib.sensors.camera.circle_centres import with_circle_centres
from icalib.sensors.camera.corner_factor import CornerFactor, CornerNoise
from icalib.sensors.camera.edge_curvature import with_bent_edges
from icalib.sensors.camera.features.feature_factor import FeatureFactor
from icalib.sensors.camera.features.patch_curvature import with_curved_patches
from icalib.sensors.camera.features.surfaces import Surfaces
from icalib.sensors.camera.features.tracks import TrackNoise
from icalib.sensors.imu.residual import ImuFactor
from icalib.sensors.imu.spec import N_INTRINSICS
from icalib.sensors.lidar.lidar_binning import points_on_planes
from icalib.sensors.pose.factors import still_factors

BLOOM_SIGMA_PX = 1.0
NO_BLOOM = np.zeros((0, 2), dtype=np.float32)  # single precision: directions as such are near enough
CUT_S = 0.5


def _priors(inputs: Inputs) -> tuple[Prior, ...]:
    """All priors: those that belong to the model, those on nuisance parameters, and others that were given."""
    rig, layout = inputs.rig, inputs.layout
    priors = [
        Prior(layout.block(b, "shape"), np.zeros(len(SHAPE_LABELS)), SHAPE_SIGMA_M) for b in inputs.bodies.bending
    ]
    for camera in rig.cameras if rig.blooms else ():
        if camera.bloom.mode == "free":
            priors.append(Prior(layout.block(camera.name, "bloom"), np.zeros(1), np.full(1, BLOOM_SIGMA_PX)))
    return (*priors, *stated_priors(inputs))


def stated_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """Those on nuisance parameters, and others that the rig file gives."""
    return (*_nuisance_priors(inputs), *given_priors(inputs))


def _nuisance_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """The priors on how imperfect sensors and targets are, whether the rig file gives them or they are the default."""
    imu, layout, one = inputs.rig.imu, inputs.layout, np.ones(1)
    priors = [] if imu is None else _given(layout, imu.name, "intrinsics", imu.intrinsics)
    sigmas = {SIZE: inputs.rig.target.size_sigma} | {(p.name, "scale"): p.scale_sigma for p in inputs.rig.poses}
    priors += [Prior(b, one, sigmas[b.key] * one) for b in layout.free if b.key in sigmas]
    return tuple(priors)


def given_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """The priors that the rig file gives on what is calibrated."""
    priors = []
    names = {s.name: s for s in inputs.sensors}
    for block in inputs.layout.free:
        if block.sensor not in names or block.is_nuisance:
            continue
        difference = origin_difference(inputs.measurements, inputs.stream(block.sensor))
        shift = difference if block.name == "time_offset" else 0.0
        given = getattr(names[block.sensor], block.name)
        priors += _given(inputs.layout, block.sensor, block.name, given, shift)
    return tuple(priors)


def _given(layout: Layout, sensor: str, name: str, parameter: Parameter, shift: float = 0.0) -> list[Prior]:
    block = layout.block(sensor, name)
    if block.start is None or parameter.mode != "prior" or parameter.value is None or parameter.sigma is None:
        return []
    value, sigma = parameter.value + shift, parameter.sigma
    if name == "time_offset":  # of a clock that restarts, the prior of each
        value, sigma = np.broadcast_to(value, block.size), np.broadcast_to(sigma, block.size)
    return [Prior(block, value, sigma)]


def image_times(inputs: Inputs, values: dict[Key, np.ndarray]) -> list[np.ndarray]:
    """Instants of each camera's images, seconds on the body's clock since its first stamp."""
    return [instants(c, values) for c in inputs.measurements.cameras]


def host_times(inputs: Inputs, values: dict[Key, np.ndarray]) -> list[np.ndarray]:
    """Instants that nodes are placed at, by sensor, seconds on the body's clock since its first stamp: those of images,
    or without cameras those of scans, or without either those of poses, as many as are needed; both where motion is
    assumed that poses show."""
    assumed = inputs.rig.assumes_motion and inputs.rig.moves_by_poses
    images = image_times(inputs, values) if inputs.rig.cameras else []
    if images and not assumed:
        return images
    if inputs.rig.lidars:
        return [instants(x, values) for x in inputs.measurements.lidars]
    first, imu = inputs.measurements.poses[0], inputs.rig.imu or ImuSensor  # its default
    return [*images, instants(first, values, thinned(first.seconds, imu.pose_keyframes_s))]


def thinned(times: np.ndarray, apart: float) -> np.ndarray:
    """The first of `times` (n,), in order, in each stretch of `apart` seconds, and the last of all."""
    k = np.flatnonzero(np.diff(np.floor(times / apart + 1e-6), prepend=-1.0))
    return times[np.append(k, len(times) - 1)] if k[-1] < len(times) - 1 else times[k]


def resample(state: State, nodes: np.ndarray, inputs: Inputs) -> State:
    """The same motion at other nodes, by integrating the IMU from the nearest old one; without an IMU nodes stay."""
    if inputs.imu is None:
        return state
    near = assign_nodes("inertial", state.seconds, nodes, inputs.imu.forwards)
    poses = poses_at("inertial", nodes, near, state, inputs.imu, inputs.rig.gravity, False)
    starts = first_nodes(inputs.imu, nodes)
    return State(nodes, poses.rotation, poses.position, poses.velocity, state.bias[near].copy(), state.values, starts)


def nodes_for(inputs: Inputs, times: list[np.ndarray]) -> np.ndarray:
    """Node times for images or scans at `times`. Raises EstimationError where clocks do not overlap."""
    settings = inputs.rig.settings
    if inputs.imu is None:
        return distinct(np.sort(np.concatenate(times)))
    hosts = times[:1] if settings.keyframes == "first-camera" else times
    nodes = place_nodes(inputs.imu, hosts, settings.keyframe_spacing_s, settings.max_gap_s)
    counts = np.diff((*first_nodes(inputs.imu, nodes), len(nodes)))
    if counts.min() < 3:
        where = f"{inputs.parts[int(np.argmin(counts))].name}: " if len(inputs.parts) > 1 else ""
        raise EstimationError(
            f"{where}fewer than 3 {_hosts(inputs.rig)} fall within the recording of {inputs.imu.name}; check that the "
            "clocks overlap, or the time_offset in the rig file."
        )
    return nodes


def _hosts(rig: Rig) -> str:
    what, sensors = ("images", rig.cameras) if rig.cameras else ("scans", rig.lidars)
    if not sensors:
        what, sensors = "poses", rig.poses[:1]
    return f"{what} of {', '.join(s.name for s in sensors)}"


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
    noise: Sequence[CornerNoise],
    keep: Sequence[np.ndarray],
    held: np.ndarray = NOTHING,
    following: Following | None = None,
    robot: RobotNoise = NO_ROBOT,
    straight: bool = False,
) -> Problem:
    """The problem at the nodes of `state`, everything frozen that a pass freezes: nodes, assignment, preintegration,
    corners on edges bent by its lens, unless they stay on `straight` ones. held: directions of the calibration
    parameters that stay, see Problem."""
    rig, layout = inputs.rig, inputs.layout
    factors = []
    scheme = rig.settings.scheme if inputs.imu is not None else "inertial"
    times = image_times(inputs, state.values)
    for i, (camera, stream, t, n, k) in enumerate(
        zip(rig.cameras, inputs.measurements.cameras, times, noise, keep, strict=True)
    ):
        own = [m.images[i] for m in inputs.motions]
        node = _nodes_of(scheme, state, t, own, inputs.imu is not None and inputs.imu.forwards)
        seen = is_seen(inputs, t, state.seconds[node])
        factor = CornerFactor(
            stream, camera_model(camera.model), inputs.imu, rig.gravity, scheme, stream.seconds, node,
            k & np.repeat(seen, np.diff(stream.start)), n, NO_BLOOM, inputs.bodies, layout,
            len(state.seconds), tuple(images.start for images in own[1:]),
        )  # fmt: skip
        factor = factor if straight else with_circle_centres(with_bent_edges(factor, state), state)
        factors.append(_with_bloom(factor, camera, state, rig) if rig.blooms else factor)
    # Beside one another, in a thread of its own: points of LiDARs use the solver's.
    with ThreadPoolExecutor(1) as aside:
        found = None if following is None else aside.submit(_features, inputs, state, tuple(factors), following)
        others = _others(inputs, state, robot)
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


def _others(inputs: Inputs, state: State, noise: RobotNoise) -> tuple[Factor, ...]:
    if inputs.imu is None:
        begins = [part.begin - EARLY_S for part in inputs.parts[1:]]
        starts = (0, *(int(k) for k in np.searchsorted(state.seconds, begins)))
        return still_factors(inputs.measurements.poses, noise.posing, state, starts, inputs.layout)
    motion = motion_of(inputs, state)
    return robot_factors(inputs.rig, inputs.measurements, inputs.clouds, noise, motion, inputs.layout)


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
    """By camera, (N,) bool: observations of tracks in images that have a node."""
    times, streams = image_times(inputs, state.values), inputs.measurements.tracks
    return tuple(
        np.repeat(is_seen(inputs, t, state.seconds[camera.node]), np.diff(stream.start))
        for camera, stream, t in zip(cameras, streams, times, strict=True)
    )


def _surfaces(inputs: Inputs, state: State, coarse: bool) -> Surfaces | None:
    """Planes that points of the scene lie on, where the rig says that they do."""
    clouds, noise = inputs.clouds, inputs.rig.settings.points_on_planes_m
    if not clouds.count or noise == 0.0:
        return None
    motion, planes = motion_of(inputs, state), np.array([state.values[key] for key in clouds.keys])
    pairs = zip(inputs.measurements.lidars, clouds.plane, strict=True)
    seen = (points_on_planes(motion, stream, plane) for stream, plane in pairs)
    return Surfaces.seen(clouds.keys, clouds.recording, planes, seen, noise, coarse)


def _nodes_of(scheme: Scheme, state: State, times: np.ndarray, images: list[slice], forwards: bool) -> np.ndarray:
    """(n,) node of each image at `times`, one of its own recording; `images` of each recording."""
    pairs = zip(images, state.recordings, strict=True)
    return np.concatenate([assign_nodes(scheme, state.seconds[k], times[i], forwards) + k.start for i, k in pairs])


def _chain(inputs: Inputs, state: State) -> ChainFactor:
    if inputs.imu is None:
        return FreeNodes(inputs.rig.body, len(state.seconds))
    columns = inputs.layout.columns(inputs.imu.name, "intrinsics")
    return ImuFactor.build(inputs.imu, state, inputs.rig.gravity, columns[columns >= 0])


def is_seen(inputs: Inputs, times: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """(n,) whether images at `times` can be used, each at its node's instant: the IMU was running, or without one they
    were taken there."""
    if inputs.imu is None:
        return np.abs(times - nodes) <= MERGED_WITHIN_S
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
    one = np.ones(1)
    values = guess_values | {SIZE: one} | {(p.name, "scale"): one for p in inputs.rig.poses}
    for name in inputs.bodies.bending:
        values[name, "shape"] = np.zeros(len(SHAPE_LABELS))
    for reference in inputs.bodies.names[:1]:
        values[reference, "rotation"], values[reference, "translation"] = np.eye(3), np.zeros(3)
    if (imu := inputs.rig.imu) is not None:
        given = imu.intrinsics.value
        values[imu.name, "intrinsics"] = np.zeros(N_INTRINSICS) if given is None else given.copy()
    for camera in inputs.rig.cameras:
        bloom = camera.bloom.value if inputs.rig.blooms else None
        values[camera.name, "bloom"] = np.zeros(1) if bloom is None else bloom.copy()
    for sensor in (*inputs.rig.cameras, *inputs.rig.lidars, *inputs.rig.wheels, *inputs.rig.poses):
        if (own := values.get((sensor.name, "time_offset"))) is not None:
            values[sensor.name, "time_offset"] = np.broadcast_to(own, inputs.clocks_of(sensor))
    return {key: np.ascontiguousarray(v, dtype=np.float64) for key, v in values.items()}
