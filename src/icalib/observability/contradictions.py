"""Values of the rig file, fixed or with a prior, that the data contradict.

Each value is first tested alone by one Newton step (`relaxed`). Values that fail are then freed together, in one
more Newton step in which unobservable directions stay fixed; a value that agrees there is dropped. If a value is far
off, and does not agree there, the whole calibration is repeated with all of them free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.inputs import Inputs, origin_difference
from icalib.estimate.residual_statistics import fits
from icalib.geometry import so3
from icalib.observability.determination import Determined, classify_directions, determine, error_covariance
from icalib.observability.prior_sensitivity import (
    Relaxed,
    freed_inputs,
    stated_keys,
)
from icalib.optim.arrowhead import (
    restricted_root,
)
from icalib.optim.state import Block, Key, State
from icalib.rig import Parameter, ParameterSpec

SIGMAS = 4.0  # standard deviations of the difference that make a contradiction
FAR = 0.5  # times the prior uncertainty (3 deg, 5 cm, 10 ms); a longer step is not linear, so the estimate is repeated


@dataclass(frozen=True)
class Contradiction:
    """A parameter group `key` whose stated value (`parameter`, fixed or with a prior) differs from the data.

    value: the value from the data alone, of the shape of the stated value; time offsets are between raw stamps. off
    (n,): `value` minus stated; for rotations the rotation vector from stated to `value`, about the sensor's axes [rad].
    sigma (n,): standard deviation of `value`. spec: definition of the group.
    """

    key: Key
    spec: ParameterSpec
    parameter: Parameter
    value: np.ndarray
    off: np.ndarray
    sigma: np.ndarray

    @property
    def away(self) -> np.ndarray:
        """(n,) absolute difference over its standard deviation, which combines those of `value` and of the prior."""
        stated = 0.0 if self.parameter.sigma is None else self.parameter.sigma
        return np.abs(self.off) / np.maximum(np.sqrt(self.sigma**2 + stated**2), 1e-300)

    @property
    def in_prior_sigmas(self) -> float:
        """Largest difference, in default standard deviations of an initial guess of this parameter."""
        return float(np.abs(self.off).max()) / self.spec.prior_sigma

    @property
    def worst(self) -> int:
        """Index of the entry that differs most, in standard deviations."""
        return int(np.argmax(self.away))


def contradictions(inputs: Inputs, relaxed_rig: Relaxed | None, factor: float) -> tuple[Contradiction, ...]:
    """Stated values that differ from the data by more than SIGMAS. relaxed_rig: see `relaxed`; factor: multiplies the
    formal standard deviations."""
    if relaxed_rig is None:
        return ()
    one_freed = [
        _difference(inputs, relaxed_rig.state, relaxed_rig.layout.block(*k), *relaxed_rig.step([k]), factor)
        for k in relaxed_rig.stated
    ]
    significant = _significant(one_freed)
    if not significant:
        return ()
    linear = _significant(_linear(inputs, relaxed_rig, significant, factor))
    if linear and any(c.in_prior_sigmas > FAR for c in significant):
        return _significant(_estimated(inputs, relaxed_rig.state, significant))
    return linear


def _significant(differences: Sequence[Contradiction]) -> tuple[Contradiction, ...]:
    return tuple(c for c in differences if c.away.max() > SIGMAS)


def _linear(
    inputs: Inputs, relaxed_rig: Relaxed, significant: Sequence[Contradiction], factor: float
) -> Sequence[Contradiction]:
    """Contradictions after one Newton step in which all groups of `significant` are free, and unobservable directions
    stay fixed."""
    keys, n = [c.key for c in significant], relaxed_rig.layout.size
    columns = np.setdiff1d(np.arange(n), relaxed_rig.fixed_columns(keys))
    outcome, gradient = relaxed_rig.without(keys)
    directions = classify_directions(relaxed_rig.inputs, outcome, columns=columns)
    noise, null_space = directions.noise, directions.unobservable
    t = relaxed_rig.problem.tolerance[columns]
    information = t[:, None] * outcome.information[np.ix_(columns, columns)] * t
    root = restricted_root(information, null_space)
    step, sigma = np.zeros(n), np.zeros(n)
    step[columns] = -t * (root @ (root.T @ (t * gradient[columns])))
    sigma[columns] = t * np.sqrt(np.diag(error_covariance(information - noise, noise, null_space)))
    return [
        _difference(inputs, relaxed_rig.state, relaxed_rig.layout.block(*c.key), step, sigma, factor)
        for c in significant
    ]


def _estimated(inputs: Inputs, state: State, significant: Sequence[Contradiction]) -> Sequence[Contradiction]:
    """Contradictions after a new estimate in which all groups of `significant` are free; `significant` itself if that
    fails."""
    freed = freed_inputs(inputs, [c.key for c in significant])
    try:
        solution = determine(freed, state, guess=state.values)
    except EstimationError:
        return significant
    converged = solution.estimate.outcome.converged
    return _differences(inputs, solution, [c.key for c in significant]) if converged else significant


def contradicted_by(inputs: Inputs, solution: Determined) -> tuple[Contradiction, ...]:
    """Values stated in the rig file of `inputs` that contradict the estimate `solution`, in which they are free. The
    largest difference comes first."""
    layout = solution.estimate.problem.layout
    significant = _significant(_differences(inputs, solution, stated_keys(inputs, layout)))
    return tuple(sorted(significant, key=lambda c: -c.in_prior_sigmas))


def _differences(inputs: Inputs, solution: Determined, keys: Sequence[Key]) -> list[Contradiction]:
    """Differences between the stated values of the groups `keys` and the estimate `solution`, in which these are free.

    Standard deviations are multiplied by the root of the largest chi^2 per degree of freedom of any residuals, so that
    a misfit alone makes no contradiction.
    """
    outcome, layout = solution.estimate.outcome, solution.estimate.problem.layout
    ratios = [f.chi2 / f.dof for f in fits(outcome.problem, outcome) if f.dof > np.sqrt(f.count)]
    factor = float(np.sqrt(max([1.0, *ratios])))
    sigma, nothing = np.sqrt(np.diag(solution.covariance)), np.zeros(layout.size)
    return [_difference(inputs, outcome.state, layout.block(*key), nothing, sigma, factor) for key in keys]


def _difference(
    inputs: Inputs, state: State, block: Block, step: np.ndarray, sigma: np.ndarray, factor: float
) -> Contradiction:
    """The difference between the stated value of `block` and the value at `state` plus `step` (B,). sigma (B,): formal
    standard deviations, which `factor` multiplies."""
    sensor = (inputs.user_rig or inputs.rig).sensors[block.sensor]
    parameter: Parameter = getattr(sensor, block.name)
    assert parameter.value is not None
    value, step = state.values[block.key], step[block.columns]
    if block.kind == "rotation":
        value = value @ so3.exp(step)
        difference = so3.log(np.ascontiguousarray(parameter.value.T @ value))
    else:
        shift = origin_difference(inputs.measurements, inputs.stream(block.sensor))
        value = value + step - (shift if block.name == "time_offset" else 0.0)
        value = np.maximum(value, sensor.spec(block.name).least)
        difference = value - parameter.value
    return Contradiction(
        block.key, sensor.spec(block.name), parameter, value, difference, factor * sigma[block.columns]
    )
