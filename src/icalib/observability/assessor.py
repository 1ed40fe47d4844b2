"""What a kind of sensor says of its part in a result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs
from icalib.estimate.residual_statistics import Segments
from icalib.motion.factor import Factor, FactorKey
from icalib.observability.determination import Cause
from icalib.observability.prior_sensitivity import Relaxed
from icalib.optim.state import Key, State
from icalib.result import ParameterGroup, SensorFit
from icalib.result.calibration import Plane, Timeline
from icalib.rig import Rig, Sensor
from icalib.sensors.stream import Residuals

S = TypeVar("S", bound=Sensor)
Groups = Mapping[Key, ParameterGroup]
Sentences = Iterable[str]
Causes = Iterable[Cause]
Keyed = Iterable[tuple[str, np.ndarray]]  # each with a sentence or the key of a stream


@dataclass(frozen=True)
class Assessor(Generic[S]):
    """What one kind of sensor says of its part in a result; sentences are text for users.

    misfit: on residuals larger than stated, or None; the last argument tells whether they are white and constant over
    the recording. residuals: records of residuals; None: the rows of all its factors. planes: of the scene.
    keyframe_instants: stream key and instants of measurements that keyframes may lie at.

    notes: on data and noise. ambiguities: notes on other values that fit as well. warnings: on data. value_warnings: on
    estimates that cannot be right. inner_contradictions: of measurements of one sensor, each with a change (B,) that
    standard deviations cover.

    causes: wrong values in the rig file, from the largest empirical factor, and a rig without fixed values (None: not
    known). clock_causes: clocks that the model leaves out. unreliable: kinds of residuals that mean nothing.
    many_rejected: on outliers. overstated_noise: on noise stated too large.

    length: what shows the metric scale, or None. sizes: names of parameters that do so if they are stated. absurd: on
    impossible estimates. is_far_guess: whether the guess of a group is contradicted; None if there is no test.
    looks_like: a likely mistake behind a wrong value, with a space before it; empty if there is none.
    """

    misfit: Callable[[S, SensorFit, bool], str | None]
    residuals: Callable[[Inputs, Estimate, Timeline], Iterable[Residuals]] | None = None
    planes: Callable[[Inputs, State], Iterable[Plane]] = lambda *_: ()
    keyframe_instants: Callable[[Inputs, State], Keyed] = lambda *_: ()
    notes: Callable[[Inputs, Estimate, Timeline], Sentences] = lambda *_: ()
    ambiguities: Callable[[Inputs, Estimate, Sequence[SensorFit]], Sentences] = lambda *_: ()
    warnings: Callable[[Inputs, Estimate], Sentences] = lambda *_: ()
    value_warnings: Callable[[Sequence[ParameterGroup]], Sentences] = lambda *_: ()
    inner_contradictions: Callable[[Inputs, Estimate, Segments | None], Keyed] = lambda *_: ()
    causes: Callable[[Inputs, Estimate, Sequence[ParameterGroup], float, Relaxed | None], Causes] = lambda *_: ()
    clock_causes: Callable[[Inputs, Estimate], Causes] = lambda *_: ()
    unreliable: Callable[[Rig, Mapping[FactorKey, Factor]], Sentences] = lambda *_: ()
    many_rejected: Callable[[Sequence[SensorFit]], Sentences] = lambda *_: ()
    overstated_noise: Callable[[Rig, Sequence[SensorFit]], Sentences] = lambda *_: ()
    length: Callable[[S, Rig], str | None] = lambda *_: None
    sizes: Callable[[S], Sequence[str]] = lambda _: ()
    absurd: Callable[[S, Groups], Sentences] = lambda *_: ()
    is_far_guess: Callable[[S, str, Groups], bool | None] = lambda *_: None
    looks_like: Callable[[S, str, np.ndarray, np.ndarray], str] = lambda *_: ""
