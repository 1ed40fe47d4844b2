"""How sensors of one kind take part in the initial guess.

The facet `initialize` of a kind holds an `Initializer` as `INITIALIZER`. A kind overrides what it can do; the defaults
are those of a sensor that gives no motion and needs no guess.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from typing import Any, Generic, TypeVar

import numpy as np

from icalib.data.measurements import Measurements
from icalib.errors import EstimationError
from icalib.estimate.problem.inputs import Inputs, inputs_for
from icalib.geometry.targets import NoTarget
from icalib.initialize.steps.keyframe_spacing import SmoothMotion
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.optim.state import Key, State
from icalib.rig import Rig, Sensor
from icalib.sensors import SENSOR_KINDS, facet

S = TypeVar("S", bound=Sensor)
Values = dict[Key, np.ndarray]
InputsWithMotion = tuple[Inputs, State]  # inputs, and a state that has the motion

# Preference among the kinds that give the motion, the best first: see `Initializer.motion_rank`.
BY_TARGET, BY_SCANS, BY_TRACKS, BY_POSES, BY_POSITIONS, BY_DEAD_RECKONING = range(6)


class Initializer(Generic[S]):
    """What the initial guess asks of a kind of sensor. `sensors`: those of its kind, in the order of the rig file."""

    asks_for_vertical = False  # placed after the kinds whose frames tell the vertical
    hosts_keyframes = False  # keyframes lie at its measurements even if another kind gives the motion
    refined_alone = True  # its motion is refined even if no other sensor is to be placed on it
    moves_keyframes = False  # keyframes are placed anew once its motion is refined: its clock has moved since

    def motion_rank(self, rig: Rig) -> int | None:
        """Its place among the kinds that give the motion of `rig`, the least first; None: it does not."""
        del rig
        return None

    def sources(self, rig: Rig) -> tuple[str, ...]:
        """Names of the sensors that give the motion: all of the kind."""
        return tuple(s.name for s in rig.mounted if initializer_of(s) is self)

    def trajectory(self, inputs: Inputs, other: Callable[[], InputsWithMotion]) -> State:
        """The motion and the guess of its sensors, from these and the IMU: where the solver starts. inputs: of
        `sources` alone; other: the motion by the kinds that come after it.

        Raises EstimationError where they do not show the motion.
        """
        raise NotImplementedError

    def refined(self, inputs: Inputs, state: State) -> tuple[Inputs, State, Values]:
        """`inputs` and `state` of its own `trajectory` after a solve, so that others can be placed on it; and the guess
        at which parameters stay that the data do not show."""
        raise NotImplementedError

    def adopted(self, whole: Inputs, own: Inputs) -> Inputs:
        """The inputs of all sensors, `whole`, with what `refined` has changed in its `own`."""
        del own
        return whole

    def place(self, inputs: Inputs, state: State, sensors: Sequence[S]) -> Values:
        """Calibration parameters of `sensors`, of its kind, and of their frames, as the rig file gives them or as the
        motion in `state` shows them. Raises EstimationError where neither does."""
        del inputs, state, sensors
        return {}

    def associated(self, inputs: Inputs, state: State) -> tuple[Inputs, State, Values]:
        """`inputs` and `state`, which has the motion and a guess of all sensors, with what is known only once all are
        placed; and what the guess changes by."""
        return inputs, state, {}

    def cleaned(self, recording: Measurements) -> Measurements:
        """The recording without measurements that are to be left out."""
        return recording

    def vertical(self, state: State, sensor: S) -> np.ndarray | None:
        """Upwards (3,) in the world, if the sensor's own frame tells it."""
        del state, sensor
        return None

    # Without an IMU

    def body_poses(self, rig: Rig, recordings: Sequence[Measurements]) -> tuple[list[BodyPoses], Values]:
        """Poses in each recording of the sensor that is the body, if it is of this kind, or else of the first of its
        `sources`; and what is found of its sensors. Raises EstimationError where these do not show them."""
        raise NotImplementedError

    def check_moving(self, recording: Measurements) -> None:
        """Raises EstimationError where its sensors measure too seldom to show a motion."""
        del recording

    def start_at_rest(
        self, rig: Rig, recordings: Sequence[Measurements], body: Sequence[BodyPoses], found: Values
    ) -> tuple[Inputs, State, Values] | None:
        """All of `start.start` if everything was measured at rest, so that no motion is to be assumed; else None. body,
        found: see `body_poses`."""
        del rig, recordings, body, found
        return None

    def longest_spacing(self, rig: Rig, recordings: Sequence[Measurements], motion: SmoothMotion) -> float:
        """The largest spacing of keyframes [s] at which the assumed motion adds little to the noise of its sensors."""
        del rig, recordings, motion
        return np.inf

    def rewritten(self, recordings: Sequence[Measurements]) -> Iterator[tuple[str, list[Measurements]]]:
        """The recordings with measurements of its `sources` in other conventions, and the words for each: tried where
        others contradict the motion."""
        del recordings
        return iter(())

    # Errors

    def explaining(self, inputs: Inputs) -> AbstractContextManager[None]:
        """Errors raised within name what the sensors do not show, if they gave the motion."""
        del inputs
        return nullcontext()

    def explained(
        self, rig: Rig, recordings: Sequence[Measurements], converges: Callable[[Rig], bool]
    ) -> EstimationError | None:
        """Why the estimate broke down whose motion the kind gave, if that is known. converges: whether an estimate of a
        changed rig does."""
        del rig, recordings, converges
        return None


NO_INITIALIZER: Initializer[Sensor] = Initializer()


def initializer(kind: str) -> Initializer[Any]:
    """That of a kind of sensors."""
    module = facet(kind, "initialize")
    return NO_INITIALIZER if module is None else module.INITIALIZER


def initializer_of(sensor: Sensor) -> Initializer[Any]:
    """That of a sensor's kind."""
    return initializer(sensor.sensor_type)


def kinds_of(rig: Rig) -> list[Initializer[Any]]:
    """Of all kinds of which `rig` has a sensor."""
    own = {s.sensor_type for s in rig.mounted}
    return [initializer(kind) for kind in SENSOR_KINDS if kind in own]


def motion_kinds(rig: Rig) -> list[Initializer[Any]]:
    """The kinds that give the motion of `rig`, the preferred one first."""
    ranked = {kind: rank for kind in kinds_of(rig) if (rank := kind.motion_rank(rig)) is not None}
    return sorted(ranked, key=lambda kind: ranked[kind])


def place_sensors(inputs: Inputs, state: State, sensors: Iterable[Sensor]) -> Values:
    """Values of all `sensors` on the motion in `state`, kind by kind; those that ask for the vertical last."""
    out: Values = {}
    sensors = list(sensors)
    kinds = [initializer(kind) for kind in SENSOR_KINDS]
    for kind in sorted(kinds, key=lambda kind: kind.asks_for_vertical):
        if own := [s for s in sensors if initializer_of(s) is kind]:
            out |= kind.place(inputs, replace(state, values=state.values | out), own)
    return out


def inputs_of_sensors(whole: Inputs, recordings: Sequence[Measurements], names: Sequence[str]) -> Inputs:
    """The inputs of the sensors `names` and the IMU, on the clock of `whole`."""
    rig = whole.rig
    if len(names) == len(rig.mounted):
        return whole
    imus = [] if rig.imu is None else [rig.imu.name]
    some = rig.only(*imus, *names)
    if not some.cameras:
        some = some.only(*some.sensors, target=NoTarget())
    return inputs_for(some, [m.only(*some.sensors) for m in recordings], whole)
