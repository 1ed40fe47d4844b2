"""What a kind of sensor says of its part in a result."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from icalib.base.remark import Remark
from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs
from icalib.estimate.problem import Problem
from icalib.estimate.residual_statistics import Segments
from icalib.kinds import assessors
from icalib.observability.prior_sensitivity import Effect, Relaxed
from icalib.optim.state import Key, State
from icalib.result import ParameterGroup, SensorFit
from icalib.result.calibration import Plane, Timeline
from icalib.rig import Rig, Sensor
from icalib.sensors.stream import Residuals

S = TypeVar("S", bound=Sensor)
Groups = Mapping[Key, ParameterGroup]
Remarks = Iterable[Remark]


class Remedy(NamedTuple):
    """How an estimate includes an effect of the whole recording. amended: gives the rig that has it; note: what to say
    of a result of that rig, None if the result says it."""

    amended: Callable[[Rig], Rig]
    note: Remark | None = None


@dataclass(frozen=True)
class Cause:
    """A possible cause. sentence: the fault, and what to do about it; gain: the decrease of chi^2 if it is modelled;
    grave: whether the result must not be used; explains: parameter groups whose stated values contradict the data for
    this cause, so that the contradiction needs no other sentence; remedy: None if no model has it."""

    sentence: Remark
    gain: float
    grave: bool = False
    explains: tuple[Key, ...] = ()
    remedy: Remedy | None = None


@dataclass(frozen=True)
class AssessedEstimate:
    """An estimate with its statistics. factor: the largest empirical factor, which multiplies formal standard
    deviations; segments: of the recording, None if it is not split. effects: that the estimate leaves out.
    beside: problem with these and with fixed values free, and the solution. relaxed_rig: the estimate without fixed
    values; None if it is not known."""

    inputs: Inputs
    estimate: Estimate
    groups: tuple[ParameterGroup, ...]
    fits: Sequence[SensorFit]
    factor: float
    segments: Segments | None
    timeline: Timeline
    effects: tuple[Effect, ...]
    beside: tuple[Problem, State]
    relaxed_rig: Relaxed | None = None

    @property
    def misfit_factor(self) -> float:
        """Largest ratio of a sensor's residuals to its stated noise; at least 1."""
        return float(np.sqrt(max([1.0, *(f.chi2_per_dof or 1.0 for f in self.fits)])))


@dataclass(frozen=True)
class Assessment:
    """What one kind of sensor says of its part in a result; sentences are text for users. What is said is worked out
    when it is asked for.

    residuals: records of residuals; None: the rows of all its factors. planes: of the scene.

    notes: on data and noise. ambiguities: notes on other values that fit as well. warnings: on data. value_warnings: on
    estimates that cannot be right.

    causes: wrong values in the rig file, and effects that the model leaves out. clock_causes: clocks that it leaves
    out. unreliable: kinds of residuals that mean nothing. many_rejected: on outliers. overstated_noise: on noise stated
    too large.
    """

    residuals: Iterable[Residuals] | None = None
    planes: Iterable[Plane] = ()
    notes: Remarks = ()
    ambiguities: Remarks = ()
    warnings: Remarks = ()
    value_warnings: Remarks = ()
    causes: Iterable[Cause] = ()
    clock_causes: Iterable[Cause] = ()
    unreliable: Iterable[str] = ()
    many_rejected: Remarks = ()
    overstated_noise: Remarks = ()


@dataclass(frozen=True)
class Assessor(Generic[S]):
    """What one kind of sensor has a part in when a result is assessed; sentences are text for users.

    assess: what it says of the estimate. misfit: on residuals larger than stated, or None; the last argument tells
    whether they are white and constant over the recording. keyframe_instants: stream key and instants of measurements
    that keyframes may lie at.

    length: what shows the metric scale, or None. sizes: names of parameters that do so if they are stated. absurd: on
    impossible estimates. is_far_guess: whether the guess of a group is contradicted; None if there is no test.
    looks_like: a likely mistake behind a wrong value, with a space before it; empty if there is none.
    """

    assess: Callable[[AssessedEstimate], Assessment]
    misfit: Callable[[S, SensorFit, bool], Remark | None]
    keyframe_instants: Callable[[Inputs, State], Iterable[tuple[str, np.ndarray]]] = lambda *_: ()
    length: Callable[[S, Rig], str | None] = lambda *_: None
    sizes: Callable[[S], Sequence[str]] = lambda _: ()
    absurd: Callable[[S, Groups], Remarks] = lambda *_: ()
    is_far_guess: Callable[[S, str, Groups], bool | None] = lambda *_: None
    looks_like: Callable[[S, str, np.ndarray, np.ndarray], str] = lambda *_: ""


def assessments(assessed: AssessedEstimate) -> list[Assessment]:
    """What each kind of sensor says, in the order of `SENSOR_KINDS`."""
    return [assessor.assess(assessed) for assessor in assessors().values()]
