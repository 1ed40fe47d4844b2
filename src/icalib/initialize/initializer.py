"""How a kind of sensor takes part in the initial guess, and steps that guesses of several kinds share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from math import sqrt
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from icalib.data.measurements import Measurements
from icalib.data.recordings import naming
from icalib.errors import EstimationError
from icalib.estimate.inputs import Inputs, inputs_for, origin_difference
from icalib.geometry import so3
from icalib.geometry.targets import NoTarget
from icalib.initialize.smooth_trajectory import BodyPoses, SmoothTrajectory
from icalib.kinds import initializers
from icalib.model.sensor_model import FRAME, frame_of
from icalib.motion.imu_data import imu_data
from icalib.optim.state import Key, State
from icalib.rig import Parameter, ParameterSpec, Rig, Sensor
from icalib.sensors.sensor import MOUNTED_NAMES, TRANSLATION

# How the sensors of one kind take part in the initial guess, an `Initializer`. A kind overrides what it supports. The
# defaults are those of a sensor that does not show the motion and needs no guess.
#
# Largest spacing of keyframes if smooth motion is assumed in place of an IMU.
#
# Between keyframes the motion is propagated with constant angular rate and acceleration. White angular acceleration of
# density `turning` [rad/s^2/sqrt(Hz)] adds a rotation of turning sqrt(t^3 / 3) in t seconds. White jerk of density
# `jerking` [m/s^3/sqrt(Hz)] adds a displacement of jerking sqrt(t^5 / 20) (integrated Wiener processes). Both must
# stay below MAX_PROPAGATION_SHARE of the measurement noise. Poses are at most half a spacing from their keyframe.
# Increments span a whole spacing h, and their noise grows with sqrt(h).
#
# The upward direction: by gravity, or by a level frame of a sensor if gravity is not observed.

S = TypeVar("S", bound=Sensor)
Values = dict[Key, np.ndarray]
InputsWithMotion = tuple[Inputs, State]  # inputs, and a state whose poses are the trajectory
InitialGuess = tuple[Inputs, State, Values]  # inputs, start state, values to which unobservable parameters are reset

# Ranks of the kinds that show the motion, the preferred one first: see `MotionSource`.
BY_TARGET, BY_SCANS, BY_TRACKS, BY_POSES, BY_POSITIONS, BY_DEAD_RECKONING, BY_READINGS = range(7)


class MotionSource(NamedTuple):
    """rank: among the kinds that show the motion, the smallest is preferred; sensors: names of those that show it."""

    rank: int
    sensors: tuple[str, ...]


@dataclass(frozen=True)
class BodyTrajectory:
    """Poses of the body in each recording, without an IMU. values: of the sensors, estimated with them; conventions:
    recordings with measurements converted from another convention, each with a sentence that names it; reference: the
    sensor whose poses they are, if the rig's own `reference` shows the motion less well."""

    poses: list[BodyPoses]
    values: Values = field(default_factory=dict)
    conventions: Iterable[tuple[str, list[Measurements]]] = ()
    reference: str = ""


@dataclass(frozen=True)
class FailedEstimate:
    """Why an estimate failed. converges: whether the estimate of a changed rig converges; None during an attempt, as
    fallbacks may succeed."""

    rig: Rig
    recordings: Sequence[Measurements]
    error: EstimationError
    converges: Callable[[Rig], bool] | None = None


class OtherMotionError(EstimationError):
    """Measurements of a sensor do not follow the motion that other sensors show, or do not overlap with it in time."""


class UnusableMeasurementsError(EstimationError):
    """Some measurements cannot be used. The guess may succeed without them."""

    def usable(self, rig: Rig, recording: Measurements) -> Measurements:
        """The recording without these measurements."""
        raise NotImplementedError


class Initializer(Generic[S]):
    """The interface of one kind of sensor to the initial guess. `sensors` are those of this kind, in the order of the
    rig file."""

    asks_for_vertical = False  # whether its sensors are aligned last, because they need the vertical
    hosts_keyframes = False  # whether keyframes are at its measurements even if another kind shows the motion
    prior_factor = 1.0  # on the densities of the assumed motion, if a sensor of this kind is the body
    refined_alone = True  # whether its trajectory is refined even if no other sensor is aligned to it
    moves_keyframes = False  # whether keyframes are placed again after the refinement, which changes its time offset

    def prepared(self, rig: Rig, recordings: Sequence[Measurements]) -> Sequence[Measurements]:
        """The recordings without measurements of this kind that must not be used, and with those that had several
        interpretations resolved to one."""
        return recordings

    def motion_source(self, rig: Rig) -> MotionSource | None:
        """The sensors of this kind that show the motion of `rig`; None if it does not show the motion."""
        return None

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        """A state with the trajectory and a guess of the sensors, from their measurements and the IMU's. inputs: of
        `motion_source` and the IMU alone. fallback: returns inputs and trajectory by the next kind in rank.

        Raises EstimationError if the sensors do not show the motion.
        """
        raise NotImplementedError

    def refined(self, inputs: Inputs, source_inputs: Inputs, state: State) -> InitialGuess:
        """Refines the result of `trajectory` by a solve, so that other sensors can be aligned to it. Returns `inputs`,
        those of all sensors, with what changed in `source_inputs`, those of `motion_source`; state, and the guess to
        which unobservable parameters are reset."""
        raise NotImplementedError

    def place(self, inputs: Inputs, state: State, sensors: Sequence[S]) -> Values:
        """Calibration parameters of `sensors` and of their frames: values of the rig file, or values that align them to
        the trajectory in `state`. Raises EstimationError if neither determines them."""
        return {}

    def associated(self, inputs: Inputs, state: State) -> InitialGuess:
        """Associates measurements that need the extrinsics of all sensors. `state` has the trajectory and a guess of
        all sensors. Returns inputs, state, and the changed values of the guess."""
        return inputs, state, {}

    def explained(self, failed: FailedEstimate) -> EstimationError | None:
        """The error that tells why the estimate failed, if the cause is known; else None."""
        return None

    # Without an IMU

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> BodyTrajectory:
        """Poses of the body in each recording. The body is the reference sensor if it is of this kind, else the first
        of `motion_source`. Raises EstimationError if the sensors do not show the poses."""
        raise NotImplementedError

    def start_at_rest(
        self, rig: Rig, recordings: Sequence[Measurements], body_poses: Sequence[BodyPoses], values: Values
    ) -> InitialGuess | None:
        """The whole initial guess if all measurements were taken at rest, so that no motion is assumed; else None.
        body_poses, values: those of `BodyTrajectory`. Raises EstimationError if sensors of this kind measure too rarely
        to show a motion."""
        return None

    def longest_spacing(self, rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
        """The largest spacing of keyframes [s] at which the error of the assumed motion is small against the noise of
        sensors of this kind."""
        return np.inf


def initializer_of(sensor: Sensor) -> Initializer[Any]:
    """The initializer of the sensor's kind."""
    return initializers()[sensor.sensor_type]


def kinds_of(rig: Rig) -> list[Initializer[Any]]:
    """Initializers of all kinds of which `rig` has a sensor, in the order of `SENSOR_KINDS`."""
    types = {s.sensor_type for s in rig.mounted}
    return [initializer for kind, initializer in initializers().items() if kind in types]


def motion_kinds(rig: Rig) -> list[Initializer[Any]]:
    """Initializers of the kinds that show the motion of `rig`, by rank, the preferred one first."""
    ranked = {kind: source.rank for kind in kinds_of(rig) if (source := kind.motion_source(rig)) is not None}
    return sorted(ranked, key=lambda kind: ranked[kind])


def sources_of(kind: Initializer[Any], rig: Rig) -> tuple[str, ...]:
    """Names of the sensors of a kind in `motion_kinds` that show the motion."""
    source = kind.motion_source(rig)
    assert source is not None
    return source.sensors


def keyframe_hosts(sensors: Iterable[Sensor]) -> list[Sensor]:
    """Those of `sensors` at whose measurements keyframes are, even if another kind shows the motion."""
    return [s for s in sensors if initializer_of(s).hosts_keyframes]


def place_sensors(inputs: Inputs, state: State, sensors: Iterable[Sensor]) -> Values:
    """Values of all `sensors`, aligned to the trajectory in `state`, kind by kind. Kinds with `asks_for_vertical` come
    last."""
    out: Values = {}
    sensors = list(sensors)
    for kind in sorted(initializers().values(), key=lambda kind: kind.asks_for_vertical):
        if of_kind := [s for s in sensors if initializer_of(s) is kind]:
            out |= kind.place(inputs, replace(state, values=state.values | out), of_kind)
    return out


def inputs_of_sensors(inputs: Inputs, recordings: Sequence[Measurements], names: Sequence[str]) -> Inputs:
    """Inputs of the sensors `names` and the IMU alone, on the time base of `inputs`."""
    rig = inputs.rig
    if len(names) == len(rig.mounted):
        return inputs
    imus = [] if rig.imu is None else [rig.imu.name]
    chosen = rig.only(*imus, *names)
    if not any(s.sees_target for s in chosen.mounted):
        chosen = chosen.only(*chosen.sensors, target=NoTarget())
    return inputs_for(chosen, [m.only(*chosen.sensors) for m in recordings], inputs)


MAX_PROPAGATION_SHARE = 0.25  # propagation error over measurement noise: it adds 6 % to the variance


@dataclass(frozen=True)
class SmoothMotion:
    """The assumed motion: densities `turning` [rad/s^2/sqrt(Hz)] and `jerking` [m/s^3/sqrt(Hz)] of the body, and its
    trajectory in each recording."""

    paths: Sequence[SmoothTrajectory]
    turning: float
    jerking: float

    def spacing_for_poses(self, rotation_noise: float, position_noise: float) -> float:
        """The largest spacing [s] for poses with noise of these standard deviations [rad, m]."""
        return min(
            2.0 * (3.0 * (MAX_PROPAGATION_SHARE * rotation_noise / self.turning) ** 2) ** (1 / 3),
            2.0 * (20.0 * (MAX_PROPAGATION_SHARE * position_noise / self.jerking) ** 2) ** 0.2,
        )

    def spacing_for_increments(self, rotation_noise: float, position_noise: float) -> float:
        """The largest spacing [s] for increments with noise of these densities [rad/sqrt(s), m/sqrt(s)]."""
        return min(
            sqrt(3.0) * MAX_PROPAGATION_SHARE * rotation_noise / self.turning,
            (20.0 * (MAX_PROPAGATION_SHARE * position_noise / self.jerking) ** 2) ** 0.25,
        )


# Cosine between the vehicle's axis of rotation and z of a frame: a frame more than 45 degrees off is not level
MIN_LEVEL_COSINE = 0.7


@dataclass(frozen=True)
class Verticals:
    """candidates: upward unit vectors (3,) in IMU axes, the more likely one first; level_sensor: the sensor whose level
    frame decides between both directions, or None."""

    candidates: tuple[np.ndarray, ...]
    level_sensor: str | None = None


def possible_verticals(inputs: Inputs, state: State) -> Verticals:
    """Upward directions by gravity. Without an IMU, the main axis of rotation of the vehicle, whose sign follows from
    the level frame of a sensor. Without such a frame both signs are possible: a vehicle whose left and right are
    swapped drives upside down."""
    if not inputs.rig.assumes_motion:
        return Verticals((np.einsum("nji,j->i", state.rotation, [0.0, 0.0, 1.0]),))
    assert inputs.imu is not None
    axis = np.linalg.svd(inputs.imu.gyro.T @ inputs.imu.gyro)[0][:, 0]
    along, level = _vertical_by_frames(inputs, state, axis)
    return Verticals((np.sign(along) * axis,), level) if level else Verticals((axis, -axis))


def level_sensor(inputs: Inputs, state: State) -> str | None:
    """The sensor whose level frame shows the upward direction, for a rig without an IMU. None if there is no such
    sensor."""
    turns = state.bias[:, :3]  # of an assumed motion: minus the angular rate
    return _vertical_by_frames(inputs, state, np.linalg.svd(turns.T @ turns)[0][:, 0])[1]


def _vertical_by_frames(inputs: Inputs, state: State, axis: np.ndarray) -> tuple[float, str | None]:
    """The upward component of the main axis of rotation `axis` (3,) in the IMU's axes, and the sensor whose frame shows
    it."""
    in_world = np.einsum("nij,j->i", state.rotation, axis) / len(state.rotation)
    for sensor in inputs.rig.mounted:
        frame = state.values.get((frame_of(sensor.name, 0), FRAME[0])) if sensor.has_level_frame else None
        if frame is not None and abs(along := float(in_world @ frame[:, 2])) > MIN_LEVEL_COSINE:
            return along, sensor.name
    return 0.0, None


# Values of the rig file that the data contradict.
#
# An initial guess has no weight in the estimate, so a contradicted guess is replaced by the value that the data show.
# A fixed value is not replaced. If it is far off, the solver does not converge, so `refuse_far_off` reports it before
# the solve.
#
# Extrinsics and time offsets that the rig file gives, with offsets relative to the first stamps.

MAX_GUESS_SIGMAS = 4.0  # prior standard deviations of a guess: a larger deviation contradicts it
FACTOR_PRIOR_SIGMA = 0.1  # prior standard deviation of the logarithm of a guessed length or factor


def is_contradicted(spec: ParameterSpec, guess: np.ndarray, estimate: np.ndarray) -> bool:
    """Whether a `guess` deviates from the `estimate` by more than MAX_GUESS_SIGMAS prior standard deviations."""
    return largest_deviation(spec, guess, estimate) > MAX_GUESS_SIGMAS


def largest_deviation(spec: ParameterSpec, guess: np.ndarray, estimate: np.ndarray) -> float:
    """The largest deviation of a guess from an estimate, over the prior standard deviation of a guess. Infinite if a
    length or factor is not positive."""
    if spec.manifold == "rotation":
        return float(np.linalg.norm(so3.log(np.ascontiguousarray(guess.T @ estimate)))) / spec.prior_sigma
    if spec.is_positive:
        if (guess <= 0.0).any() or (estimate <= 0.0).any():
            return np.inf
        return float(np.abs(np.log(estimate / guess)).max()) / FACTOR_PRIOR_SIGMA
    return float(np.abs(estimate - guess).max()) / spec.prior_sigma


def merged_value(
    spec: ParameterSpec, parameter: Parameter, stated: np.ndarray | None, estimate: np.ndarray
) -> np.ndarray:
    """Start value of a parameter: `stated`, the value of the rig file in the form that a state has. It is `estimate`
    instead if the rig file has no value, or only a guess that `estimate` contradicts."""
    if stated is None or (parameter.mode == "free" and is_contradicted(spec, stated, estimate)):
        return estimate
    return stated


_REFUSES_FAR_OFF = ContextVar("_REFUSES_FAR_OFF", default=False)


class MotionContradictedError(EstimationError):
    """A sensor contradicts the motion that another sensor measured."""


class FarOffError(EstimationError):
    """A length or a lever arm that the rig file fixes is far from the initial guess by the data."""


@contextmanager
def refusing_far_off() -> Iterator[None]:
    """Within this context `refuse_far_off` raises; outside it does nothing."""
    token = _REFUSES_FAR_OFF.set(True)
    try:
        yield
    finally:
        _REFUSES_FAR_OFF.reset(token)


def refuse_far_off(sensor: Sensor, estimates: dict[Key, np.ndarray]) -> None:
    """Raises FarOffError if a fixed length or lever arm of the sensor contradicts its estimate. Needs the context
    `refusing_far_off`."""
    for (_, name), value in estimates.items() if _REFUSES_FAR_OFF.get() else ():
        stated, spec = getattr(sensor, name), sensor.spec(name)
        checked = spec.is_positive or spec == TRANSLATION
        if checked and stated.mode == "fixed" and is_contradicted(spec, stated.value, value):
            raise FarOffError(f"{sensor.name}: {name} in the rig file contradicts the data.")


def merged_values(
    sensor: Sensor, stated: dict[Key, np.ndarray], estimates: dict[Key, np.ndarray]
) -> dict[Key, np.ndarray]:
    """Start values of a sensor: `stated` values of the rig file, completed by `estimates`. An estimate replaces a guess
    that it contradicts. It also replaces a prior on a length or factor, as the solver may not recover from a wrong
    one."""
    replaced = {
        key
        for key, value in stated.items()
        if key in estimates
        and _is_replaceable(sensor, key[1])
        and is_contradicted(sensor.spec(key[1]), value, estimates[key])
    }
    return estimates | {key: value for key, value in stated.items() if key not in replaced}


def _is_replaceable(sensor: Sensor, name: str) -> bool:
    """Whether an estimate may replace the value of the rig file for the parameter `name`."""
    mode = getattr(sensor, name).mode
    return mode == "free" or (mode == "prior" and sensor.spec(name).is_positive)


def has_guesses(sensor: Sensor, stated: dict[Key, np.ndarray]) -> bool:
    """Whether some of the `stated` values are guesses: neither fixed nor with a prior."""
    return any(getattr(sensor, name).mode == "free" for _, name in stated)


def merged_translation(guess: np.ndarray, estimate: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """The `guess` of a translation (3,) m, corrected by the `estimate` of covariance (3, 3) m^2. Components along
    principal axes of the covariance are replaced if the estimate is more certain than a guess, and contradicts it."""
    variance, axes = np.linalg.eigh(covariance)
    deviation = axes.T @ (estimate - guess)
    sigma = TRANSLATION.prior_sigma
    return guess + axes @ np.where(
        (variance < sigma**2) & (np.abs(deviation) > MAX_GUESS_SIGMAS * sigma), deviation, 0.0
    )


def nearest_about_axis(axis: np.ndarray, guess: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """The `rotation` Exp(t axis), over all t, that is nearest to the `guess` (3, 3). axis (3,): unit vector, about
    which the data do not show the rotation."""
    turn = guess.T @ rotation
    sine = axis @ np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    cosine = np.trace(turn) - axis @ turn @ axis
    return rotation @ so3.exp(-np.arctan2(sine, cosine) * axis)


def known_value(parameter: Parameter) -> np.ndarray | None:
    """The value of a parameter that is fixed or has a prior, else None. A mere guess may be far off, so other guesses
    must not depend on it."""
    return None if parameter.mode == "free" else parameter.value


def stated_values(inputs: Inputs, sensor: Sensor, names: Sequence[str] | None = None) -> dict[Key, np.ndarray]:
    """Values that the rig file gives for the parameters `names`, by default extrinsics and time offset, whatever their
    mode. Time offsets refer to first stamps; a clock that restarts has one for each recording."""
    out: dict[Key, np.ndarray] = {}
    for name in mounted_names(sensor) if names is None else names:
        value = getattr(sensor, name).value
        if value is not None:
            shift = origin_difference(inputs.measurements, inputs.stream(sensor.name)) if name == "time_offset" else 0.0
            out[sensor.name, name] = np.array(value, dtype=np.float64) + shift
    if (offset := out.get((sensor.name, "time_offset"))) is not None:
        out[sensor.name, "time_offset"] = np.repeat(offset, inputs.clocks_of(sensor))
    return out


def mounted_names(sensor: Sensor) -> list[str]:
    """Names of the extrinsics and time offset that this kind of sensor has."""
    return [spec.name for spec in sensor.specs() if spec.name in MOUNTED_NAMES]


def known_names(sensor: Sensor) -> list[str]:
    """Names of the extrinsics and time offset that are fixed or have a prior."""
    return [name for name in mounted_names(sensor) if known_value(getattr(sensor, name)) is not None]


def known_extrinsics(inputs: Inputs, sensor: Sensor, guesses: bool = False) -> KnownExtrinsics:
    """Extrinsics and time offset that the rig file fixes or gives a prior for; with `guesses`, those that it only
    guesses as well."""
    known = stated_values(inputs, sensor, mounted_names(sensor) if guesses else known_names(sensor))
    offset = known.get((sensor.name, "time_offset"))
    return KnownExtrinsics(
        known.get((sensor.name, "rotation")),
        known.get((sensor.name, "translation")),
        None if offset is None else float(offset[0]),
    )


# One recording of several. Each has a world frame of its own, and initial guesses use one recording at a time.


@dataclass(frozen=True)
class KnownExtrinsics:
    """Known values of a sensor, None if unknown: R_imu_sensor (3, 3), p_imu_sensor (3,) m, offset: t_imu - t_sensor
    [s], both since their clocks' first stamps."""

    rotation: np.ndarray | None = None
    position: np.ndarray | None = None
    offset: float | None = None


NOTHING_KNOWN = KnownExtrinsics()


def single_recording(inputs: Inputs, k: int) -> Inputs:
    """Inputs of recording `k` alone, on its own clock. The rig needs an IMU."""
    if len(inputs.parts) == 1:
        return inputs
    part = inputs.parts[k]
    alone = replace(part, shift_ns=0, begin=0.0)
    return replace(inputs, measurements=part.measurements, imu=imu_data(inputs.rig, part.measurements), parts=(alone,))


def fullest_recording(inputs: Inputs, key: str) -> int:
    """Index of the recording in which the stream `key` has most measurements."""
    return int(np.argmax([part.measurements.streams[key].rows for part in inputs.parts]))


def naming_recording(inputs: Inputs, k: int) -> AbstractContextManager[None]:
    """A context in which errors are prefixed with the name of recording `k`, if there are several."""
    return naming(inputs.parts[k].name if len(inputs.parts) > 1 else "")


def state_of_recording(inputs: Inputs, k: int, state: State) -> State:
    """The part of `state` that belongs to recording `k`, on its own clock."""
    if len(inputs.parts) == 1:
        return state
    keyframes = state.recordings[k]
    seconds = state.seconds[keyframes] - inputs.parts[k].begin
    return State(
        seconds,
        state.rotation[keyframes],
        state.position[keyframes],
        state.velocity[keyframes],
        state.bias[keyframes],
        state.values,
    )


def joined_states(inputs: Inputs, states: Sequence[State], values: dict[Key, np.ndarray]) -> State:
    """The states of all recordings as one, with the calibration parameters `values`."""
    if len(states) == 1:
        return replace(states[0], values=values)
    seconds = np.concatenate([s.seconds + part.begin for s, part in zip(states, inputs.parts, strict=True)])
    rotation, position, velocity, bias = (
        np.concatenate([getattr(s, name) for s in states]) for name in ("rotation", "position", "velocity", "bias")
    )
    starts = np.cumsum([0, *(len(s.seconds) for s in states[:-1])])
    return State(seconds, rotation, position, velocity, bias, values, tuple(int(k) for k in starts))


def converted_offset(offset: float, sensor: str, before: Inputs, now: Inputs) -> float:
    """Converts a time offset [s] between the first stamps in `before` to one between the first stamps in `now`."""
    shifts = (origin_difference(i.measurements, i.stream(sensor)) for i in (now, before))
    return offset + next(shifts) - next(shifts)


def states_from_best(
    inputs: Inputs, sensor: Sensor, best: int, state_of: Callable[[Inputs, KnownExtrinsics | None], State]
) -> State:
    """The states of all recordings as one. Recording `best` starts without known values. The other recordings start
    with the extrinsics that `best` has shown, and with its time offset unless the clock restarts. state_of: estimates
    the state of one recording."""
    recordings = [single_recording(inputs, k) for k in range(len(inputs.parts))]
    restarts = sensor.clock_restarts
    with naming_recording(inputs, best):
        states = {best: state_of(recordings[best], None)}
    values, name = dict(states[best].values), sensor.name
    for k, recording in enumerate(recordings):
        if k != best:
            offset = None if restarts else _offset_between(states[best], name, recordings[best], recording)
            with naming_recording(inputs, k):
                states[k] = state_of(
                    recording, KnownExtrinsics(values.get((name, "rotation")), values[name, "translation"], offset)
                )
    clocks = range(len(recordings)) if restarts else (best,)
    offsets = [_offset_between(states[k], name, recordings[k], inputs) for k in clocks]
    values[name, "time_offset"] = np.array(offsets)
    return joined_states(inputs, [states[k] for k in range(len(recordings))], values)


def _offset_between(state: State, sensor: str, before: Inputs, now: Inputs) -> float:
    """The time offset in `state`, whose recording is `before`, converted to the first stamps of `now`."""
    return converted_offset(float(state.values[sensor, "time_offset"][0]), sensor, before, now)


def offset_of_each_clock(
    inputs: Inputs, sensor: str, find: Callable[[int], float], known: Mapping[int, float] | None = None
) -> np.ndarray:
    """(R,) time offsets [s] of a clock that restarts, one for each recording. find(k): the offset of recording k alone;
    it is not called for recordings in `known`."""
    offsets = dict(known or {})
    for k in range(len(inputs.parts)):
        if k not in offsets:
            with naming_recording(inputs, k):
                offsets[k] = find(k)
    return np.array(
        [converted_offset(offsets[k], sensor, single_recording(inputs, k), inputs) for k in range(len(inputs.parts))]
    )
