"""Values of the rig file, fixed or with a prior, that the data contradict.

Each is tested alone first (`relaxed`), which costs one linearisation. Those that stand out are then free together: what
is right among them no longer stands out, and directions in which the data show only noise stay fixed. A value that is
far off moves everything with it; then the calibration is made again without it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.problem.inputs import Inputs, origin_difference
from icalib.estimate.residual_statistics.fit_statistics import fits
from icalib.geometry import so3
from icalib.observability.determination import Determined, determine, judge, scatter
from icalib.observability.relaxed import Relaxed, freed_inputs, stated_keys
from icalib.optim.calib_block import restricted_root
from icalib.optim.state import Block, Key, State
from icalib.rig import Parameter, ParameterSpec

SIGMAS = 4.0
FAR = 0.5  # times the prior uncertainty: 3 deg, 5 cm, 10 ms; a linear step that long does not end where it says


@dataclass(frozen=True)
class Contradiction:
    """A group `key` that the rig file states as `parameter` (mode fixed or prior), between raw stamps.

    off (n,): from the stated value to that of the data alone, rotations about the sensor's axes [rad]; sigma (n,): the
    standard deviation of the latter; found: the latter. spec: the definition of the group.
    """

    key: Key
    spec: ParameterSpec
    parameter: Parameter
    found: np.ndarray
    off: np.ndarray
    sigma: np.ndarray

    @property
    def away(self) -> np.ndarray:
        """(n,) how far off in standard deviations of both together."""
        stated = 0.0 if self.parameter.sigma is None else self.parameter.sigma
        return np.abs(self.off) / np.maximum(np.sqrt(self.sigma**2 + stated**2), 1e-300)

    @property
    def in_prior_sigmas(self) -> float:
        """How far off it is at most, in standard deviations of an initial guess for which the rig file gives none."""
        return float(np.abs(self.off).max()) / self.spec.prior_sigma

    @property
    def worst(self) -> int:
        """The entry that is farthest off."""
        return int(np.argmax(self.away))


def contradictions(inputs: Inputs, stated: Relaxed | None, factor: float) -> tuple[Contradiction, ...]:
    """What is more than SIGMAS off. `stated`: see `relaxed`; factor: times which formal standard deviations count."""
    if stated is None:
        return ()
    alone = [_shown(inputs, stated.state, stated.layout.block(*k), *stated.step([k]), factor) for k in stated.stated]
    standing_out = _standing_out(alone)
    if not standing_out:
        return ()
    if any(_is_far(c) for c in standing_out):
        return _standing_out(_estimated(inputs, stated.state, standing_out))
    return _standing_out(_linear(inputs, stated, standing_out, factor))


def _standing_out(shown: Sequence[Contradiction]) -> tuple[Contradiction, ...]:
    return tuple(c for c in shown if c.away.max() > SIGMAS)


def _is_far(shown: Contradiction) -> bool:
    return shown.in_prior_sigmas > FAR


def _linear(
    inputs: Inputs, stated: Relaxed, standing_out: Sequence[Contradiction], factor: float
) -> Sequence[Contradiction]:
    """One Newton step with all that stand out free, without directions that are unobservable from the data."""
    keys, n = [c.key for c in standing_out], stated.layout.size
    columns = np.setdiff1d(np.arange(n), stated.fixed_columns(keys))
    outcome, gradient = stated.without(keys)
    seen = judge(stated.inputs, outcome, columns=columns)
    t = stated.problem.tolerance[columns]
    information = t[:, None] * outcome.information[np.ix_(columns, columns)] * t
    root = restricted_root(information, seen.undetermined)
    step, sigma = np.zeros(n), np.zeros(n)
    step[columns] = -t * (root @ (root.T @ (t * gradient[columns])))
    sigma[columns] = t * np.sqrt(np.diag(scatter(information - seen.noise, seen.noise, seen.undetermined)))
    return [_shown(inputs, stated.state, stated.layout.block(*c.key), step, sigma, factor) for c in standing_out]


def _estimated(inputs: Inputs, state: State, standing_out: Sequence[Contradiction]) -> Sequence[Contradiction]:
    """From the calibration without what stands out; as they are where that fails."""
    freed = freed_inputs(inputs, [c.key for c in standing_out])
    try:
        again = determine(freed, state, guess=state.values)
    except EstimationError:
        return standing_out
    return _by(inputs, again, [c.key for c in standing_out]) if again.estimate.outcome.converged else standing_out


def contradicted_by(inputs: Inputs, without: Determined) -> tuple[Contradiction, ...]:
    """What `inputs`, of the rig as it was given, state and an estimate `without` any of it contradicts, the farthest
    off first."""
    layout = without.estimate.problem.layout
    found = _standing_out(_by(inputs, without, stated_keys(inputs, layout)))
    return tuple(sorted(found, key=lambda c: -c.in_prior_sigmas))


def _by(inputs: Inputs, without: Determined, keys: Sequence[Key]) -> list[Contradiction]:
    """The groups `keys` beside an estimate in which they are free."""
    outcome, layout = without.estimate.outcome, without.estimate.problem.layout
    ratios = [f.chi2 / f.dof for f in fits(outcome.problem, outcome) if f.dof > np.sqrt(f.count)]
    factor = float(np.sqrt(max([1.0, *ratios])))
    sigma, nothing = np.sqrt(np.diag(without.covariance)), np.zeros(layout.size)
    return [_shown(inputs, outcome.state, layout.block(*key), nothing, sigma, factor) for key in keys]


def _shown(
    inputs: Inputs, state: State, block: Block, step: np.ndarray, sigma: np.ndarray, factor: float
) -> Contradiction:
    """A stated group against where `step` (B,) leads from `state`."""
    sensor = (inputs.asked or inputs.rig).sensors[block.sensor]
    parameter: Parameter = getattr(sensor, block.name)
    assert parameter.value is not None
    value, own = state.values[block.key], step[block.columns]
    if block.kind == "rotation":
        there = value @ so3.exp(own)
        off = so3.log(np.ascontiguousarray(parameter.value.T @ there))
    else:
        shift = origin_difference(inputs.measurements, inputs.stream(block.sensor))
        there = value + own - (shift if block.name == "time_offset" else 0.0)
        off = there - parameter.value
    return Contradiction(block.key, sensor.spec(block.name), parameter, there, off, factor * sigma[block.columns])
