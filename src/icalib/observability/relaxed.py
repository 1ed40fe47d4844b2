"""Normal equations at the solution with all values free that the rig file fixes, and optionally without its priors.

This is a score test (Lagrange multiplier test; Rao 1948). A constraint that the data contradict leaves a gradient at
the solution. One Newton step without the constraint gives the value of the data alone and its standard deviation.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.assembly import given_priors
from icalib.estimate.problem.groups import groups_of, with_groups
from icalib.estimate.problem.inputs import Inputs, with_association
from icalib.estimate.problem.outcome import Linearised, Outcome, outcome_of
from icalib.estimate.problem.problem import Problem
from icalib.motion.factor import Residuals
from icalib.optim.arrowhead import Solution
from icalib.optim.calib_block import NO_DIRECTIONS, restricted_root
from icalib.optim.prior_factor import sums_of_priors
from icalib.optim.state import Key, Layout, State
from icalib.rig import Parameter, Sensor


@dataclass(frozen=True)
class Relaxed:
    """The solution of an estimate, linearised again at `state` with the fixed values in the layout.

    inputs, problem: with all groups `stated` as columns. solution: gradient (B,) and information (B, B) of the
    calibration parameters at `state`. before: the layout of the estimate. stated: groups that the rig file fixes or
    gives a prior.
    """

    inputs: Inputs
    problem: Problem
    state: State
    solution: Solution
    residuals: Residuals
    before: Layout
    stated: tuple[Key, ...]

    @property
    def layout(self) -> Layout:
        return self.problem.layout

    def fixed_columns(self, freed: Collection[Key]) -> np.ndarray:
        """Columns that were fixed in the estimate, except those of the groups `freed`."""
        fixed = [b for b in self.layout.free if not self.before.is_free(*b.key) and b.key not in freed]
        return np.concatenate([np.arange(0), *(b.columns for b in fixed)])

    def step(self, freed: Collection[Key]) -> tuple[np.ndarray, np.ndarray]:
        """(B,) Newton step of the calibration parameters, and (B,) its standard deviations. The groups `freed` are free
        and without their priors; all other values stay as the rig file states them."""
        t, n = self.problem.tolerance, self.layout.size
        pull, known = self._priors_of(freed)
        fixed = np.eye(n)[:, self.fixed_columns(freed)]
        fixed_directions = (
            np.hstack([fixed, self.problem.fixed_directions]) if self.problem.fixed_directions.size else fixed
        )
        root = restricted_root(t[:, None] * (self.solution.information - known) * t, fixed_directions)
        step = -root @ (root.T @ (t * (self.solution.gradient[:-1] - pull)))
        return t * step, t * np.sqrt((root**2).sum(axis=1))

    def without(self, freed: Collection[Key]) -> tuple[Outcome, np.ndarray]:
        """The outcome without the priors on the groups `freed`, and the gradient (B,) of the calibration parameters.
        Noise in the Jacobian can be estimated from this outcome."""
        pull, known = self._priors_of(freed)
        problem = self.problem.without([p for p in self.problem.priors if p.block.key in freed])
        outcome = outcome_of(Linearised(problem, self.state, 0.0, self.residuals), 0.0, [], self.solution)
        return replace(outcome, information=outcome.information - known), self.solution.gradient[:-1] - pull

    def _priors_of(self, freed: Collection[Key]) -> tuple[np.ndarray, np.ndarray]:
        """Gradient (B,) and information (B, B) of the priors on the groups `freed`."""
        priors = [p for p in given_priors(self.inputs) if p.block.key in freed]
        return sums_of_priors(priors, self.state, self.layout.size)[1:]


def relaxed(inputs: Inputs, estimate: Estimate) -> Relaxed | None:
    """Normal equations at the solution of `estimate`, with a column for each value that the rig file fixes.

    The state does not move, and priors still act: `Relaxed.step` frees chosen groups and drops their priors. None if
    the rig file states no fixed value and no prior, if the solver did not converge, or if the equations are singular.
    """
    if not estimate.outcome.converged or not any(_is_stated(p) for _, _, p in groups_of(inputs.rig)):
        return None
    freed = freed_inputs(inputs)
    fixed_directions = _in_layout(freed.layout, inputs.layout, estimate.problem.fixed_directions)
    state = estimate.outcome.state
    try:
        problem = estimate.measurement_model.problem(freed, state, fixed_directions)
        pieces, residuals = problem.pieces(), problem.residuals()
        problem.linearise(state, pieces, residuals, curved=True)
        solution = problem.solve(pieces)
    except EstimationError:
        return None
    return Relaxed(freed, problem, state, solution, residuals, inputs.layout, tuple(stated_keys(inputs, freed.layout)))


def stated_keys(inputs: Inputs, layout: Layout) -> list[Key]:
    """Groups that the original rig file fixes or gives a prior, and that have columns in `layout`.

    Without a real IMU the pose of the reference sensor defines the body frame, so it is no stated value. With assumed
    motion neither is its time offset.
    """
    user_rig, used = inputs.user_rig or inputs.rig, {s.name for s in inputs.rig.mounted}
    body = () if inputs.rig.imu is not None and not inputs.rig.assumes_motion else ("rotation", "translation")
    if inputs.rig.assumes_motion:
        body = (*body, "time_offset")
    return [
        (s.name, name)
        for s, name, parameter in groups_of(user_rig)
        if s.name in used and _is_stated(parameter)
        if not (s.name == user_rig.reference and name in body)
        if any(b.key == (s.name, name) and b.start is not None for b in layout.blocks)
    ]


def freed_inputs(inputs: Inputs, keys: Collection[Key] | None = None) -> Inputs:
    """`inputs` with groups free that start at their stated values: all fixed ones, or with `keys` exactly these,
    whether fixed or with a prior."""

    def freed(sensor: Sensor, name: str, p: Parameter) -> Parameter:
        wanted = p.mode == "fixed" if keys is None else (sensor.name, name) in keys
        return Parameter("free", p.value) if wanted and p.value is not None else p

    return with_association(replace(inputs, rig=with_groups(inputs.rig, freed)), inputs.association)


def _is_stated(parameter: Parameter) -> bool:
    return parameter.mode != "free" and parameter.value is not None


def _in_layout(layout: Layout, before: Layout, fixed_directions: np.ndarray) -> np.ndarray:
    """Directions of the calibration parameters of the layout `before`, as directions of `layout`, which has more
    columns."""
    if not fixed_directions.size:
        return NO_DIRECTIONS
    out = np.zeros((layout.size, fixed_directions.shape[1]))
    for block in before.free:
        out[layout.block(*block.key).columns] = fixed_directions[block.columns]
    return out
