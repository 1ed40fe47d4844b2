"""The null space of the data, and estimates in which it is fixed at the initial guess.

Broad priors do not make an unobservable direction harmless. The solver wanders along it, and parameters that couple
with it at second order come out wrong with a small standard deviation. So the null space is that of the information of
the data alone, without the part that noise in the Jacobian makes. Its directions are reset to the guess and fixed there
while all else is estimated again, until their number stays. The sensitivity of the other parameters to the guess along
these directions is computed, and is part of the covariance (consider covariance).

Noise in the Jacobian can pull along an unobservable direction as hard as data would, and data can be hidden in it.
The solver does not wander there, and a reset to the guess would cost chi^2. Such a direction is fixed where the
measurements put it, unless that is farther from the guess than the prior uncertainty of the guess allows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, eigh

from icalib.errors import EstimationError
from icalib.estimate.estimate import EARLY_DECREASE, EARLY_DECREASE_SHARE, Estimate, OnVisit, estimate
from icalib.estimate.problem.assembly import given_priors
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.outcome import Outcome, Step
from icalib.estimate.problem.problem import Problem
from icalib.estimate.problem.solver import minimise
from icalib.estimate.residual_statistics.inflation import MIN_INFLATION, inflation, nuisance_priors, with_priors_weighed
from icalib.estimate.residual_statistics.jacobian_noise import Spurious, spurious_information
from icalib.observability.guess_worth import astray, in_proportion, moved_to_guess, moved_to_worth, owed_to_guess
from icalib.optim.calib_block import UNOBSERVABLE_BELOW, essential_information, restricted_root
from icalib.optim.prior_factor import variance_of_priors, without_priors
from icalib.optim.state import Key, State

# A direction with a larger share of noise in its information counts as unobservable: all of it may be noise.
SPURIOUS_SHARE = 0.5
MOST_ROUNDS, LATE = 6, 4
RANK_DEFICIENT_BELOW = 0.25  # information in tolerance units
UNCHANGED = 0.1  # of the information: less than what a few draws of noise scatter by
ALIKE = 0.7  # cosine of the largest angle between the fixed subspace and the one to be fixed


@dataclass(frozen=True)
class Determined:
    """An estimate and what is known of its calibration parameters.

    data, noise (B, B): information of the data alone in tolerance units, without priors but those on nuisance
    parameters and without what noise makes of it, and that; fixed_directions (B, m): orthonormal directions in
    tolerance units, those that are undetermined; shifts (m, B): how all moves with each independent error of the guess
    along them. inflation: root of how many times priors on nuisance parameters count, see
    `estimate.evidence.inflation`.
    """

    estimate: Estimate
    data: np.ndarray
    noise: np.ndarray
    fixed_directions: np.ndarray
    shifts: np.ndarray
    inflation: float = 1.0

    @property
    def covariance(self) -> np.ndarray:
        """(B, B), priors included: of the observable directions, and their sensitivity to the fixed ones."""
        t = self.estimate.problem.tolerance
        known = t[:, None] * self.estimate.outcome.information * t - self.noise
        return t[:, None] * scatter(known, self.noise, self.fixed_directions) * t + self.shifts.T @ self.shifts

    @property
    def prior_variance(self) -> np.ndarray:
        """(B,) what errors of nuisance parameters contribute to the diagonal of the covariance. Noise in the Jacobian
        is no knowledge: errors lead back by the inverse of what is known, as in `scatter`."""
        problem, outcome = self.estimate.problem, self.estimate.outcome
        t = problem.tolerance
        root = t[:, None] * restricted_root(t[:, None] * outcome.information * t - self.noise, self.fixed_directions)
        return variance_of_priors(root @ root.T, nuisance_priors(problem), outcome.state)

    @property
    def spread(self) -> np.ndarray:
        """(B,) standard deviations in tolerances that the data alone give."""
        t = self.estimate.problem.tolerance
        alone = scatter(self.data, self.noise, self.fixed_directions)
        return np.sqrt(np.diag(alone) + ((self.shifts / t) ** 2).sum(axis=0))


def scatter(known: np.ndarray, noise: np.ndarray, fixed_directions: np.ndarray) -> np.ndarray:
    """(B, B) covariance where J^T J is `known` + `noise`: J^T r scatters by all of it, but only what is known of it
    leads back (errors in variables; Fuller, Measurement Error Models, 1987, chapter 1). Noise only adds: where its few
    draws say otherwise, or curvature left less than nothing known, the variance is no less than without it."""
    whitened = restricted_root(known, fixed_directions)
    values, vectors = eigh(whitened.T @ noise @ whitened)
    root = whitened @ vectors * np.sqrt(1.0 + np.maximum(values, 0.0))
    return root @ root.T


def determine(
    inputs: Inputs,
    start: State,
    on_step: Callable[[str, Step], None] = lambda *_: None,
    on_visit: OnVisit = lambda *_: None,
    guess: dict[Key, np.ndarray] | None = None,
) -> Determined:
    """Estimates from `start`, again and again until what is undetermined stays so: at `guess`, or if there is none at
    `start`, but where noise pulls hard and not far from there.

    Raises EstimationError where the data do not carry an estimate.
    """
    wanted = replace(start, values=start.values | (guess or {}))
    search = _Search.begin(inputs, start, wanted, on_step, on_visit)
    search.settle()
    search.weigh()
    search.balance()
    found, seen = search.found, search.seen
    fixed_directions, shifts = np.zeros((inputs.layout.size, 0)), np.zeros((0, inputs.layout.size))
    if found.problem.fixed_directions.size:
        fixed_directions = found.problem.fixed_directions
        # After a failed solve the sensitivity is of no use, and each of its solves might fail as well.
        worth = _is_worth_keeping(found.outcome)
        shifts = (owed_to_guess if worth else in_proportion)(inputs, found.outcome, seen.data)
    found = replace(found, outcome=replace(found.outcome, room=None))  # nothing is solved in it any more
    return Determined(found, seen.data, seen.noise, fixed_directions, shifts, search.inflation)


@dataclass
class _Search:
    """For what is undetermined: the last estimate, `found`, and what is `seen` of it. The first began at `start`."""

    inputs: Inputs
    start: State
    guess: State
    on_step: Callable[[str, Step], None]
    on_visit: OnVisit
    found: Estimate
    seen: Judgement
    inflation: float = 1.0

    @classmethod
    def begin(
        cls, inputs: Inputs, start: State, guess: State, on_step: Callable[[str, Step], None], on_visit: OnVisit
    ) -> _Search:
        """The first estimate, no direction fixed."""
        found = estimate(
            inputs, start, on_step, on_visit=on_visit, maybe_rank_deficient=_maybe_rank_deficient, guess=guess
        )
        return cls(inputs, start, guess, on_step, on_visit, found, judge(inputs, found.outcome))

    def settle(self) -> None:
        """Fixes the null space until it stays. Until then the guess has a prior, but not in the last estimate."""
        for k in range(MOST_ROUNDS):
            found, seen = self.found, self.seen
            settled = _is_settled(seen.undetermined, found.problem.fixed_directions, k >= LATE)
            if settled and not found.outcome.stopped_early:
                return
            fixed_directions = (
                found.problem.fixed_directions if settled and found.problem.fixed_directions.size else seen.undetermined
            )
            # A failed estimate is no start for the next one.
            state = found.outcome.state if _is_worth_keeping(found.outcome) else self.start
            moving = astray(self.inputs, found.problem, state, self.guess, fixed_directions, seen.asked)
            if moving.size:
                state = _followed(found, moved_to_guess(found.problem, state, self.guess, moving), fixed_directions)
            del found
            self._estimate(state, fixed_directions, led=not settled and k + 1 < MOST_ROUNDS)

    def weigh(self) -> None:
        """Moves the fixed directions to the guess, weighted by its prior uncertainty, and all other parameters with
        them."""
        for _ in range(MOST_ROUNDS):
            problem, state = self.found.problem, self.found.outcome.state
            moving = astray(self.inputs, problem, state, self.guess, problem.fixed_directions, self.seen.asked)
            begin = moved_to_worth(self.inputs, problem, state, self.guess, moving)
            if begin is None:
                return
            begin, fixed_directions = _followed(self.found, begin, problem.fixed_directions), problem.fixed_directions
            del problem
            self._estimate(begin, fixed_directions, led=False)

    def balance(self) -> None:
        """Weighs priors on nuisance parameters by how large errors of the measurements are."""
        outcome = self.found.outcome
        if not outcome.converged or (factor := inflation(self.inputs, outcome)) < MIN_INFLATION:
            return
        problem = with_priors_weighed(outcome.problem, factor)
        again = minimise(problem, outcome.state, partial(self.on_step, "last"), room=outcome.room)
        if again.converged:
            self.found, self.inflation = replace(self.found, outcome=again), factor
            self.seen = judge(self.inputs, again, self.seen)

    def _estimate(self, begin: State, fixed_directions: np.ndarray, led: bool) -> None:
        """The next estimate, `led` by the guess or not; noise and outliers as the last one judged them, but where it
        failed."""
        judged = self.found.judged if _is_worth_keeping(self.found.outcome) else None
        del self.found  # before the next one takes as much memory
        guess = self.guess if led else None
        self.found = estimate(self.inputs, begin, self.on_step, fixed_directions, self.on_visit, judged, guess=guess)
        self.seen = judge(self.inputs, self.found.outcome, self.seen)


def _followed(found: Estimate, moved: State, fixed_directions: np.ndarray) -> State:
    """All else where the measurements want it to follow what `moved` along `fixed_directions` (B, m), while what
    `found` froze stands: tracks, and weights of points on planes. Made anew beside where the trajectory belongs, these
    would be of a state that fits nothing, and the next estimate might end anywhere."""
    if not _is_worth_keeping(found.outcome):
        return moved
    problem, room = replace(found.problem, fixed_directions=fixed_directions), found.outcome.room
    try:
        return minimise(problem, moved, tolerance=EARLY_DECREASE, share=EARLY_DECREASE_SHARE, room=room).state
    except EstimationError:
        return moved


def _is_worth_keeping(outcome: Outcome) -> bool:
    return outcome.converged or outcome.stopped_early


def _maybe_rank_deficient(problem: Problem, information: np.ndarray) -> bool:
    """Whether the information, noise in the Jacobian included, may be rank deficient."""
    return essential_information(information, problem.tolerance, problem.layout) < RANK_DEFICIENT_BELOW


def _is_settled(undetermined: np.ndarray, fixed_directions: np.ndarray, late: bool) -> bool:
    """Whether the fixed subspace `fixed_directions` (B, m) equals the null space `undetermined` (B, n), both
    orthonormal. In `late` rounds a superset is accepted, to avoid cycling."""
    n, m = (d.shape[1] if d.size else 0 for d in (undetermined, fixed_directions))
    if n == 0 or n > m:
        return n == m or (n == 0 and late)
    inside = np.linalg.svd(undetermined.T @ fixed_directions, compute_uv=False).min() > ALIKE
    return bool(inside and (n == m or late))


class Judgement(NamedTuple):
    """Of an estimate, in tolerance units: information of the `data` alone, with priors on nuisance parameters, and what
    `noise` adds to it (B, B), and the directions (B, m) that are `undetermined`; asked (B, B): data, noise and the
    model's own priors together. spurious: how the noise was found."""

    spurious: Spurious
    data: np.ndarray
    noise: np.ndarray
    asked: np.ndarray
    undetermined: np.ndarray


def judge(
    inputs: Inputs, outcome: Outcome, before: Judgement | None = None, columns: np.ndarray | None = None
) -> Judgement:
    """Of `columns` (B,) of the calibration parameters, the others fixed; of all by default.

    Parameters whose priors belong to the model (a target's shape, bloom) are unobservable only together with others.
    Nuisance parameters never are: whether the motion determines all else is asked with these known, and how far all
    else depends on them is in the covariance. What noise adds is not looked for again where there is about as much
    information as in the judgement `before`."""
    problem, information, state = outcome.problem, outcome.information, outcome.state
    columns = np.arange(len(information)) if columns is None else columns
    among, t = np.ix_(columns, columns), problem.tolerance[columns]
    counted = {p.block.key for p in problem.priors}
    given = [p for p in given_priors(inputs) if p.block.key in counted]
    asked = t[:, None] * without_priors(information, given, state)[among] * t
    is_essential = np.isin(columns, problem.layout.essential)
    shown = partial(_shown, asked, t, is_essential)
    own = np.ix_(is_essential, is_essential)
    if before is not None and _are_alike(before.asked[own], asked[own]):
        spurious = before.spurious
    else:
        spurious = spurious_information(problem, outcome, lambda found: not shown(found).in_doubt.any(), columns)
    seen, noise = shown(spurious), spurious.mean
    bounded = [p for p in problem.priors if not p.block.is_nuisance]
    data = without_priors(information, bounded, state)[among] - noise
    undetermined = seen.vectors[:, seen.nothing | seen.in_doubt]
    return Judgement(spurious, t[:, None] * data * t, t[:, None] * noise * t, asked, undetermined)


def _are_alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two informations (B, B) in tolerance units are about the same in every direction that they know."""
    nothing = UNOBSERVABLE_BELOW * np.eye(len(a))
    try:
        ratios = eigh(b + nothing, a + nothing, eigvals_only=True)
    except LinAlgError:  # not definite: of a state far from its end
        return False
    return bool(np.abs(ratios - 1.0).max(initial=0.0) < UNCHANGED)


class _ShownDirections(NamedTuple):
    """Directions vectors (B, n) in tolerance units, of which the data show `nothing` (n,), or what may be `in_doubt`
    (n,) noise in all of it."""

    vectors: np.ndarray
    nothing: np.ndarray
    in_doubt: np.ndarray


def _shown(asked: np.ndarray, tolerance: np.ndarray, is_essential: np.ndarray, spurious: Spurious) -> _ShownDirections:
    """Of the information asked (B, B), in tolerance units, noise and all, on what `is_essential` (B,)."""
    own = np.flatnonzero(is_essential)
    known = asked - tolerance[:, None] * spurious.mean * tolerance
    vectors = np.zeros((len(asked), len(own)))
    values, vectors[own] = np.linalg.eigh(known[np.ix_(own, own)])
    all_of_it = np.einsum("ik,ij,jk->k", vectors, asked, vectors)
    nothing = values < UNOBSERVABLE_BELOW
    maybe = values < spurious.chance(tolerance[:, None] * vectors)
    return _ShownDirections(vectors, nothing, ~nothing & maybe & (values < SPURIOUS_SHARE * all_of_it))
