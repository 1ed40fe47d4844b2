"""The null space of the data, and estimates in which it is fixed at the initial guess.

Broad priors do not make an unobservable direction harmless. The solver drifts along it, and parameters that couple with
it at second order become wrong, with a small standard deviation. The null space is therefore that of the information of
the data alone, without the information that noise in the Jacobian adds. Its directions are reset to the guess and fixed
there, and everything else is estimated again until the null space no longer changes. The sensitivity of the other
parameters to the guess along these directions is part of the covariance (consider covariance).

Noise in the Jacobian can constrain an unobservable direction as strongly as data would, and can hide weak data. The
solver does not drift along such a direction, and a reset to the guess would increase chi^2. The direction is fixed at
its estimate, unless this is farther from the guess than the prior uncertainty of the guess allows.
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

# A direction may be unobservable only if less than this share of its information is left without noise in the Jacobian.
SPURIOUS_SHARE = 0.5
MOST_ROUNDS, LATE = 6, 4  # estimates of a search; the round from which a superset of the null space is accepted
RANK_DEFICIENT_BELOW = 0.25  # information in tolerance units
# relative change of the information below which its noise is not drawn again: few draws scatter by more
UNCHANGED = 0.1
ALIKE = 0.7  # least cosine of the principal angles between two subspaces that count as equal


@dataclass(frozen=True)
class Determined:
    """An estimate and the observability of its calibration parameters.

    data, noise (B, B): information of the data in tolerance units, and the part that noise in the Jacobian adds, which
    `data` excludes. Priors on nuisance parameters are in `data`, other priors are not. fixed_directions (B, m):
    orthonormal basis of the unobservable directions, in tolerance units. shifts (n, B): changes of all calibration
    parameters, in their units, for independent errors of the guess of one standard deviation along the fixed
    directions. inflation: factor by which standard deviations of priors on nuisance parameters were divided, see
    `estimate.residual_statistics.inflation`.
    """

    estimate: Estimate
    data: np.ndarray
    noise: np.ndarray
    fixed_directions: np.ndarray
    shifts: np.ndarray
    inflation: float = 1.0

    @property
    def covariance(self) -> np.ndarray:
        """(B, B) with priors: covariance of the observable directions plus the consider covariance of the fixed
        ones."""
        t = self.estimate.problem.tolerance
        return t[:, None] * scatter(self._known, self.noise, self.fixed_directions) * t + self.shifts.T @ self.shifts

    @property
    def prior_variance(self) -> np.ndarray:
        """(B,) contribution of the priors on nuisance parameters to the diagonal of the covariance. Information that
        noise in the Jacobian adds is subtracted first, as in `scatter`."""
        problem = self.estimate.problem
        root = problem.tolerance[:, None] * restricted_root(self._known, self.fixed_directions)
        return variance_of_priors(root @ root.T, nuisance_priors(problem), self.estimate.outcome.state)

    @property
    def _known(self) -> np.ndarray:
        """(B, B) information with priors, in tolerance units, without what noise in the Jacobian adds."""
        t = self.estimate.problem.tolerance
        return t[:, None] * self.estimate.outcome.information * t - self.noise

    @property
    def spread(self) -> np.ndarray:
        """(B,) standard deviations in tolerances from the data and priors on nuisance parameters, consider covariance
        included."""
        t = self.estimate.problem.tolerance
        alone = scatter(self.data, self.noise, self.fixed_directions)
        return np.sqrt(np.diag(alone) + ((self.shifts / t) ** 2).sum(axis=0))


def scatter(known: np.ndarray, noise: np.ndarray, fixed_directions: np.ndarray) -> np.ndarray:
    """(B, B) covariance in tolerance units if the information J^T J is `known` + `noise`, with zero variance along
    `fixed_directions` (B, m).

    J^T r scatters by all of J^T J, but the estimate responds by the inverse of `known` alone. Such are errors in
    variables (Fuller, Measurement Error Models, 1987, chapter 1). Negative eigenvalues of the noise, from few draws,
    are clipped: noise never reduces the variance.
    """
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
    """Estimates the parameters, and fixes the null space of the data at `guess` (default: the values of `start`).

    The estimate is repeated from `start` until the null space no longer changes. Fixed directions are then weighted
    with the priors of the rig file (`weigh`), and priors on nuisance parameters by the empirical errors (`balance`). A
    direction that noise in the Jacobian constrains stays at its estimate if that is near the guess. Raises
    EstimationError if the data allow no estimate.
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
        # After a failed solve, re-solving for the sensitivity might fail, too.
        worth = _is_worth_keeping(found.outcome)
        shifts = (owed_to_guess if worth else in_proportion)(inputs, found.outcome, seen.data)
    # free the workspace: nothing is solved in it any more
    found = replace(found, outcome=replace(found.outcome, room=None))
    return Determined(found, seen.data, seen.noise, fixed_directions, shifts, search.inflation)


@dataclass
class _Search:
    """Search for the null space. `found` is the last estimate and `seen` its observability; the first estimate began at
    `start`."""

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
        """Estimates again, with the null space fixed, until it no longer changes. The guess acts as a prior until then,
        but not in the last estimate. LATE rounds and later accept more fixed directions, see `_is_settled`."""
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
        """Resets the state along the fixed directions to the mean of the priors that the rig file states, and
        re-solves all other parameters. Repeated until the state stays there; does nothing without such priors."""
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
        """Re-solves with priors on nuisance parameters weighted by the empirical errors of the measurements
        (`inflation`)."""
        outcome = self.found.outcome
        if not outcome.converged or (factor := inflation(self.inputs, outcome)) < MIN_INFLATION:
            return
        problem = with_priors_weighed(outcome.problem, factor)
        again = minimise(problem, outcome.state, partial(self.on_step, "last"), room=outcome.room)
        if again.converged:
            self.found, self.inflation = replace(self.found, outcome=again), factor
            self.seen = judge(self.inputs, again, self.seen)

    def _estimate(self, begin: State, fixed_directions: np.ndarray, led: bool) -> None:
        """Estimates again, with the guess as a prior if `led`. Noise and outliers are those of the last estimate,
        unless it failed."""
        judged = self.found.judged if _is_worth_keeping(self.found.outcome) else None
        del self.found  # before the next one takes as much memory
        guess = self.guess if led else None
        self.found = estimate(self.inputs, begin, self.on_step, fixed_directions, self.on_visit, judged, guess=guess)
        self.seen = judge(self.inputs, self.found.outcome, self.seen)


def _followed(found: Estimate, moved: State, fixed_directions: np.ndarray) -> State:
    """`moved`, re-solved with `fixed_directions` (B, m) fixed, in the problem of `found`.

    Frozen quantities of `found`, such as tracks and weights of points on planes, are kept. Computed at `moved`, before
    the trajectory has adapted, they would fit no state, and the next estimate might diverge. Returns `moved` if the
    solve fails.
    """
    if not _is_worth_keeping(found.outcome):
        return moved
    problem, room = replace(found.problem, fixed_directions=fixed_directions), found.outcome.room
    try:
        return minimise(problem, moved, tolerance=EARLY_DECREASE, share=EARLY_DECREASE_SHARE, room=room).state
    except EstimationError:
        return moved


def _is_worth_keeping(outcome: Outcome) -> bool:
    """Whether the solver converged or stopped early, so that its state can be used."""
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
    """Observability of an estimate, in tolerance units.

    data (B, B): information of the data and of priors on nuisance parameters, without `noise`. noise (B, B): the
    information that noise in the Jacobian adds. asked (B, B): the information without the priors of the rig file, noise
    included. undetermined (B, m): orthonormal basis of the unobservable directions. spurious: the draws behind `noise`.
    """

    spurious: Spurious
    data: np.ndarray
    noise: np.ndarray
    asked: np.ndarray
    undetermined: np.ndarray


def judge(
    inputs: Inputs, outcome: Outcome, before: Judgement | None = None, columns: np.ndarray | None = None
) -> Judgement:
    """Observability of the calibration parameters `columns` (default: all of them), the other ones fixed.

    Parameters with a prior from the model (target shape, edge bloom) are unobservable only in combination with other
    ones. Nuisance parameters never are: they count as known in this test, and the covariance holds the dependence on
    them. Noise in the Jacobian is not drawn again if the information is about the same as in the judgement `before`.
    """
    problem, information, state = outcome.problem, outcome.information, outcome.state
    columns = np.arange(len(information)) if columns is None else columns
    among, t = np.ix_(columns, columns), problem.tolerance[columns]
    # Without the priors of the rig file, as these must not hide what the data leave unobservable.
    counted = {p.block.key for p in problem.priors}
    given = [p for p in given_priors(inputs) if p.block.key in counted]
    asked = t[:, None] * without_priors(information, given, state)[among] * t
    is_essential = np.isin(columns, problem.layout.essential)
    # Classifies the directions once the noise in the Jacobian is known. Drawing stops when no direction is possibly
    # rank deficient.
    shown = partial(_shown, asked, t, is_essential)
    own = np.ix_(is_essential, is_essential)
    if before is not None and _are_alike(before.asked[own], asked[own]):
        spurious = before.spurious
    else:
        spurious = spurious_information(problem, outcome, lambda found: not shown(found).in_doubt.any(), columns)
    seen, noise = shown(spurious), spurious.mean
    # Also without the priors of the model, except those on nuisance parameters.
    bounded = [p for p in problem.priors if not p.block.is_nuisance]
    data = without_priors(information, bounded, state)[among] - noise
    undetermined = seen.vectors[:, seen.nothing | seen.in_doubt]
    return Judgement(spurious, t[:, None] * data * t, t[:, None] * noise * t, asked, undetermined)


def _are_alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two information matrices (B, B), in tolerance units, agree to a relative UNCHANGED in every observable
    direction."""
    nothing = UNOBSERVABLE_BELOW * np.eye(len(a))
    try:
        ratios = eigh(b + nothing, a + nothing, eigvals_only=True)
    except LinAlgError:  # not positive definite: the state is far from the minimum
        return False
    return bool(np.abs(ratios - 1.0).max(initial=0.0) < UNCHANGED)


class _ShownDirections(NamedTuple):
    """Eigenvectors (B, n) of the information without noise, in tolerance units, with two flags each. nothing (n,):
    unobservable. in_doubt (n,): noise in the Jacobian may account for all of the information."""

    vectors: np.ndarray
    nothing: np.ndarray
    in_doubt: np.ndarray


def _shown(asked: np.ndarray, tolerance: np.ndarray, is_essential: np.ndarray, spurious: Spurious) -> _ShownDirections:
    """Directions of the essential parameters `is_essential` (B,), classified by the information `asked` (B, B) in
    tolerance units, which includes the noise `spurious`. tolerance: (B,)."""
    own = np.flatnonzero(is_essential)
    known = asked - tolerance[:, None] * spurious.mean * tolerance
    vectors = np.zeros((len(asked), len(own)))
    values, vectors[own] = np.linalg.eigh(known[np.ix_(own, own)])
    all_of_it = np.einsum("ik,ij,jk->k", vectors, asked, vectors)
    nothing = values < UNOBSERVABLE_BELOW
    maybe = values < spurious.chance(tolerance[:, None] * vectors)
    return _ShownDirections(vectors, nothing, ~nothing & maybe & (values < SPURIOUS_SHARE * all_of_it))
