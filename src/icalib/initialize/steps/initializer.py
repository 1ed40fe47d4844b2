"""How the sensors of one kind take part in the initial guess.

The facet `initialize` of a kind holds an `Initializer` as `INITIALIZER`. A kind overrides what it supports. The
defaults are those of a sensor that does not show the motion and needs no guess.

Largest spacing of keyframes if smooth motion is assumed in place of an IMU.

Between keyframes the motion is propagated with constant angular rate and acceleration. White angular acceleration of
density `turning` [rad/s^2/sqrt(Hz)] adds a rotation of turning sqrt(t^3 / 3) in t seconds. White jerk of density
`jerking` [m/s^3/sqrt(Hz)] adds a displacement of jerking sqrt(t^5 / 20) (integrated Wiener processes). Both must stay
below MAX_PROPAGATION_SHARE of the measurement noise. Poses are at most half a spacing from their keyframe. Increments
span a whole spacing h, and their noise grows with sqrt(h).

The upward direction: by gravity, or by a level frame of a sensor if gravity is not observed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from math import sqrt
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.estimate.problem.inputs import Inputs, inputs_for
from icalib.geometry.targets import NoTarget
from icalib.initialize.steps.smooth_trajectory import BodyPoses, SmoothTrajectory
from icalib.optim.state import Key, State
from icalib.rig import Rig, Sensor
from icalib.sensors import SENSOR_KINDS, facet

S = TypeVar("S", bound=Sensor)
Values = dict[Key, np.ndarray]
InputsWithMotion = tuple[Inputs, State]  # inputs, and a state whose poses are the trajectory
InitialGuess = tuple[Inputs, State, Values]  # inputs, start state, values to which unobservable parameters are reset

# Ranks of the kinds that show the motion, the preferred one first: see `Initializer.motion_rank`.
BY_TARGET, BY_SCANS, BY_TRACKS, BY_POSES, BY_POSITIONS, BY_DEAD_RECKONING = range(6)


class Fixes(NamedTuple):
    """t (n,) s since the first stamp of the sensor, `origin_ns`; z (n,) complex: x + i y of its positions [m]."""

    t: np.ndarray
    z: np.ndarray
    origin_ns: int = 0


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

    def motion_rank(self, rig: Rig) -> int | None:
        """Rank of this kind among those that show the motion of `rig`; the smallest is preferred. None if it does not
        show the motion."""
        del rig
        return None

    def sources(self, rig: Rig) -> tuple[str, ...]:
        """Names of the sensors that show the motion; by default all sensors of this kind."""
        return tuple(s.name for s in rig.mounted if initializer_of(s) is self)

    def trajectory(self, inputs: Inputs, fallback: Callable[[], InputsWithMotion]) -> State:
        """A state with the trajectory and a guess of the sensors, from their measurements and the IMU's. inputs: of
        `sources` and the IMU alone. fallback: returns inputs and trajectory by the next kind in rank.

        Raises EstimationError if the sensors do not show the motion.
        """
        raise NotImplementedError

    def refined(self, inputs: Inputs, state: State) -> tuple[Inputs, State, Values]:
        """Refines the result of `trajectory` by a solve, so that other sensors can be aligned to it. Returns inputs,
        state, and the guess to which unobservable parameters are reset."""
        raise NotImplementedError

    def adopted(self, inputs: Inputs, source_inputs: Inputs) -> Inputs:
        """`inputs`, the inputs of all sensors, with the changes that `refined` made in `source_inputs`, the inputs of
        `sources`."""
        del source_inputs
        return inputs

    def place(self, inputs: Inputs, state: State, sensors: Sequence[S]) -> Values:
        """Calibration parameters of `sensors` and of their frames: values of the rig file, or values that align them to
        the trajectory in `state`. Raises EstimationError if neither determines them."""
        del inputs, state, sensors
        return {}

    def associated(self, inputs: Inputs, state: State) -> tuple[Inputs, State, Values]:
        """Associates measurements that need the extrinsics of all sensors. `state` has the trajectory and a guess of
        all sensors. Returns inputs, state, and the changed values of the guess."""
        return inputs, state, {}

    def unambiguous(self, rig: Rig, recordings: Sequence[Measurements]) -> Sequence[Measurements]:
        """The recordings with measurements of this kind that had several interpretations resolved to one."""
        del rig
        return recordings

    def cleaned(self, recording: Measurements) -> Measurements:
        """The recording without measurements that must not be used."""
        return recording

    def vertical(self, state: State, sensor: S) -> np.ndarray | None:
        """Unit vector (3,) in the world that points upwards, if the frame of the sensor's measurements is level; else
        None."""
        del state, sensor
        return None

    # Without an IMU

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> tuple[list[BodyPoses], Values]:
        """Poses of the body in each recording, and values of its sensors that were estimated with them. The body is the
        reference sensor if it is of this kind, else the first of `sources`. Raises EstimationError if the sensors do
        not show the poses."""
        raise NotImplementedError

    def fixes(self, recording: Measurements) -> list[Fixes]:
        """Horizontal positions of points of the body, one item a sensor, if sensors of this kind measure them."""
        del recording
        return []

    def check_moving(self, recording: Measurements) -> None:
        """Raises EstimationError if sensors of this kind measure too rarely to show a motion."""
        del recording

    def start_at_rest(
        self, rig: Rig, recordings: Sequence[Measurements], body_poses: Sequence[BodyPoses], values: Values
    ) -> InitialGuess | None:
        """The whole initial guess if all measurements were taken at rest, so that no motion is assumed; else None.
        body_poses, values: results of `body_poses`."""
        del rig, recordings, body_poses, values
        return None

    def longest_spacing(self, rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
        """The largest spacing of keyframes [s] at which the error of the assumed motion is small against the noise of
        sensors of this kind."""
        del rig, recordings, motion
        return np.inf

    def rewritten(self, rig: Rig, recordings: Sequence[Measurements]) -> Iterator[tuple[str, list[Measurements]]]:
        """Versions of the recordings in which measurements of `sources` are converted from another convention, each
        with a sentence that names the convention. They are tried if other sensors contradict the motion."""
        del rig, recordings
        return iter(())

    # Errors

    def explaining(self, inputs: Inputs) -> AbstractContextManager[None]:
        """A context in which errors name the parameters that these sensors do not show, if they give the motion."""
        del inputs
        return nullcontext()

    def explained(
        self, rig: Rig, recordings: Sequence[Measurements], converges: Callable[[Rig], bool]
    ) -> EstimationError | None:
        """The error that explains why the estimate broke down, if the cause is known; else None. converges: whether the
        estimate of a changed rig converges."""
        del rig, recordings, converges
        return None


NO_INITIALIZER: Initializer[Sensor] = Initializer()


def initializer(kind: str) -> Initializer[Any]:
    """The initializer of a kind of sensor; `NO_INITIALIZER` if the kind has none."""
    module = facet(kind, "initialize")
    return NO_INITIALIZER if module is None else module.INITIALIZER


def initializer_of(sensor: Sensor) -> Initializer[Any]:
    """The initializer of the sensor's kind."""
    return initializer(sensor.sensor_type)


def kinds_of(rig: Rig) -> list[Initializer[Any]]:
    """Initializers of all kinds of which `rig` has a sensor, in the order of `SENSOR_KINDS`."""
    types = {s.sensor_type for s in rig.mounted}
    return [initializer(kind) for kind in SENSOR_KINDS if kind in types]


def motion_kinds(rig: Rig) -> list[Initializer[Any]]:
    """Initializers of the kinds that show the motion of `rig`, by rank, the preferred one first."""
    ranked = {kind: rank for kind in kinds_of(rig) if (rank := kind.motion_rank(rig)) is not None}
    return sorted(ranked, key=lambda kind: ranked[kind])


def keyframe_hosts(sensors: Iterable[Sensor]) -> list[Sensor]:
    """Those of `sensors` at whose measurements keyframes are, even if another kind shows the motion."""
    return [s for s in sensors if initializer_of(s).hosts_keyframes]


def place_sensors(inputs: Inputs, state: State, sensors: Iterable[Sensor]) -> Values:
    """Values of all `sensors`, aligned to the trajectory in `state`, kind by kind. Kinds with `asks_for_vertical` come
    last."""
    out: Values = {}
    sensors = list(sensors)
    kinds = [initializer(kind) for kind in SENSOR_KINDS]
    for kind in sorted(kinds, key=lambda kind: kind.asks_for_vertical):
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
        up = initializer_of(sensor).vertical(state, sensor)
        if up is not None and abs(along := float(in_world @ up)) > MIN_LEVEL_COSINE:
            return along, sensor.name
    return 0.0, None
