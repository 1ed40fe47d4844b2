"""Builds the `Problem` of one pass from rig, measurements and a state."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.problem.inputs import Inputs, origin_difference
from icalib.estimate.problem.problem import Problem
from icalib.model.bodies import SHAPE_SIGMA_M, SIZE
from icalib.model.sensor_model import Pass, SensorModel, by_kind, model_of
from icalib.motion.factor import Factor, keyed
from icalib.motion.independent_keyframes import IndependentKeyframes
from icalib.motion.keyframe_placement import distinct, first_keyframes, place_keyframes
from icalib.motion.poses import assign_keyframes, poses_at
from icalib.motion.sweep import EstimatedMotion, gravity_of
from icalib.motion.time_offsets import RECORDING_MARGIN_S
from icalib.optim.calib_block import NO_DIRECTIONS
from icalib.optim.prior_factor import Prior
from icalib.optim.state import Block, Key, State
from icalib.rig import Parameter, Rig, Sensor
from icalib.rig.scene import GRAVITY, SHAPE_LABELS, WORLD
from icalib.sensors.sensor import TIME_OFFSET


def _priors(inputs: Inputs) -> tuple[Prior, ...]:
    """All priors: on the shapes of target boards, on auxiliary parameters of sensors, and `stated_priors`.

    Auxiliary parameters get no verdict, such as the edge bloom of a camera. Their prior is the default one, about zero,
    if the rig file leaves them free.
    """
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
    """Priors on nuisance parameters, and priors of the rig file on calibrated parameters."""
    return (*_nuisance_priors(inputs), *given_priors(inputs))


def _nuisance_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """Priors on nuisance parameters: size of the target, gravity, IMU intrinsics, and scale of a pose sensor.
    `inputs.rig` holds default priors if the user's rig file states none. The shape of a target is no nuisance parameter
    here."""
    rig, one, priors = inputs.rig, np.ones(1), []
    of_scene = {
        SIZE: (one, rig.target.size_sigma * one),
        (WORLD, GRAVITY.name): (rig.gravity * one, rig.gravity_sigma * one),
    }
    for block in inputs.layout.free:
        stated = inputs.stated(block)
        if block.key in of_scene:
            priors.append(Prior(block, *of_scene[block.key]))
        elif block.is_nuisance and stated is not None:
            priors += _given(block, stated)
    return tuple(priors)


def given_priors(inputs: Inputs) -> tuple[Prior, ...]:
    """Priors of the rig file on calibrated parameters, which are not nuisance parameters."""
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
    """Prior of a block as the rig file states it, its mean moved by `shift`; empty if the file states none."""
    if parameter.mode != "prior" or parameter.value is None or parameter.sigma is None:
        return []
    value, sigma = parameter.value + shift, parameter.sigma
    if block.name == TIME_OFFSET.name:  # a clock that restarts: the same prior in each recording
        value, sigma = np.broadcast_to(value, block.size), np.broadcast_to(sigma, block.size)
    return [Prior(block, value, sigma)]


def keyframe_times(inputs: Inputs, values: dict[Key, np.ndarray]) -> list[np.ndarray]:
    """Times at which keyframes are wanted, one array per sensor [s, body's clock since its first stamp]."""
    return [
        model.keyframe_times(sensor, inputs.stream(sensor.name), values, inputs.rig)
        for model, sensors in _keyframe_sources(inputs.rig)
        for sensor in sensors
    ]


def _keyframe_sources(rig: Rig) -> list[tuple[SensorModel, list[Sensor]]]:
    """Models and sensors that place keyframes: the first kind that can. If the rig assumes its motion and poses measure
    it, all kinds that can."""
    sources = [
        (model, placing)
        for model, sensors in by_kind(rig.sensors.values())
        if model.keyframes and (placing := list(model.placing_keyframes(sensors, rig)))
    ]
    return sources if rig.assumes_motion and rig.moves_by_poses else sources[:1]


def resample(state: State, keyframes: np.ndarray, inputs: Inputs) -> State:
    """The same motion at the times `keyframes`, by integrating the IMU from the nearest old keyframe. Without an IMU
    the state is returned as it is."""
    if inputs.imu is None:
        return state
    near = assign_keyframes("inertial", state.seconds, keyframes, inputs.imu.forwards)
    poses = poses_at("inertial", keyframes, near, state, inputs.imu, gravity_of(state, inputs.rig.gravity), False)
    starts = first_keyframes(inputs.imu, keyframes)
    return State(
        keyframes, poses.rotation, poses.position, poses.velocity, state.bias[near].copy(), state.values, starts
    )


def keyframes_for(inputs: Inputs, times: list[np.ndarray]) -> np.ndarray:
    """Keyframe times [s] for images or scans at `times`, one array per sensor. Raises EstimationError if clocks do not
    overlap."""
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


def assemble(
    inputs: Inputs,
    state: State,
    noise: Mapping[str, Any],
    fixed_directions: np.ndarray = NO_DIRECTIONS,
    coarse: bool = False,
) -> Problem:
    """The problem at the keyframes of `state`, with everything that a pass freezes: assignment to keyframes,
    preintegration, and corrections of measurements that depend on the state.

    noise: by sensor, of the noise class of its kind. fixed_directions (B, m): directions of the calibration parameters
    that are fixed, see `Problem`. coarse: an early pass, see `Pass`.
    """
    rig, at = inputs.rig, pass_at(inputs, state, coarse)
    factors = (*_between_keyframes(inputs, at), *_measured(inputs, noise, at))
    return Problem(
        inputs.layout, keyed(factors), _priors(inputs), inputs.tolerance, fixed_directions,
        # framed: whether the world frame is defined; levelled: whether gravity is known to point down in it
        rig.has_target or rig.imu is None or (rig.assumes_motion and rig.moves_by_poses), not rig.assumes_motion,
    )  # fmt: skip


def motion_of(inputs: Inputs, state: State) -> EstimatedMotion:
    """Motion of the IMU between the keyframes of `state`."""
    assert inputs.imu is not None
    return EstimatedMotion(state, inputs.imu, gravity_of(state, inputs.rig.gravity), inputs.rig.settings.max_gap_s)


def _measured(inputs: Inputs, noise: Mapping[str, Any], at: Pass) -> list[Factor]:
    """Factors of all sensors, kind by kind. Joint factors of several sensors are built concurrently in one separate
    thread, because LiDAR points already use the solver's threads."""
    factors_by_kind: list[tuple[list[Factor], Future[Sequence[Factor]]]] = []
    with ThreadPoolExecutor(1) as aside:
        for model, sensors in by_kind(inputs.sensors):
            sensor_factors: list[Factor] = []
            for s in sensors:
                measured = s, inputs.stream(s.name), noise[s.name], at
                sensor_factors += model.still_factors(*measured) if at.motion is None else model.factors(*measured)
            factors_by_kind.append(
                (sensor_factors, aside.submit(model.joint_factors, sensors, sensor_factors, noise, at))
            )
        return [factor for sensor_factors, joint in factors_by_kind for factor in (*sensor_factors, *joint.result())]


def pass_at(inputs: Inputs, state: State, coarse: bool = False) -> Pass:
    """Data from which factors are built at `state`."""
    if inputs.imu is not None:
        motion, starts = motion_of(inputs, state), state.starts
    else:
        begins = [part.begin - RECORDING_MARGIN_S for part in inputs.parts[1:]]
        motion, starts = None, (0, *(int(k) for k in np.searchsorted(state.seconds, begins)))
    return Pass(
        inputs.rig, inputs.association, inputs.layout, state, motion, starts, inputs.measurements, inputs.motions,
        inputs.bodies, coarse,
    )  # fmt: skip


def _between_keyframes(inputs: Inputs, at: Pass) -> Iterable[Factor]:
    """The `ChainFactor`, which is that of the IMU if there is one."""
    if inputs.imu is None:
        return (IndependentKeyframes(inputs.rig.reference, len(at.state.seconds)),)
    sensor = inputs.sensor(inputs.imu.name)
    return model_of(sensor).factors(sensor, inputs.stream(sensor.name), sensor.noise, at)


def start_values(inputs: Inputs, guess_values: dict[Key, np.ndarray]) -> dict[Key, np.ndarray]:
    """Values of all blocks: the guess, completed by start values of parameters that are not guessed."""
    rig, values = inputs.rig, guess_values | {SIZE: np.ones(1), (WORLD, GRAVITY.name): np.full(1, inputs.rig.gravity)}
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
        if (offset := values.get((sensor.name, TIME_OFFSET.name))) is not None:
            values[sensor.name, TIME_OFFSET.name] = np.broadcast_to(offset, inputs.clocks_of(sensor))
    return {key: np.ascontiguousarray(v, dtype=np.float64) for key, v in values.items()}
