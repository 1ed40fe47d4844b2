"""The null space of the data, estimates in which it is fixed at the initial guess, contradictions, and sentences."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from scipy.linalg import LinAlgError, eigh, qr

from icalib.base.remark import Remark
from icalib.errors import EstimationError
from icalib.estimate.estimate import EARLY_PASS, NO_CALLBACKS, Callbacks, Estimate, EstimateOptions, estimate
from icalib.estimate.inputs import Inputs
from icalib.estimate.jacobian_noise import Spurious, spurious_information
from icalib.estimate.problem import Problem, given_priors
from icalib.estimate.residual_statistics import MIN_INFLATION, inflation, nuisance_priors, with_priors_weighed
from icalib.estimate.solver import Outcome, SolverOptions, minimise
from icalib.observability.prior_sensitivity import (
    directions_to_reset,
    prior_sensitivity,
    project_to_guess,
    project_to_prior,
)
from icalib.optim.arrowhead import (
    UNOBSERVABLE_BELOW,
    Prior,
    essential_information,
    restricted_root,
    variance_of_priors,
    without_priors,
)
from icalib.optim.state import Key, State
from icalib.result import Verdict
from icalib.result.verdict import component_verdict, in_null_space
from icalib.rig import ParameterSpec

# The null space of the data, and estimates in which it is fixed at the initial guess.
#
# Broad priors do not make an unobservable direction harmless. The solver drifts along it, and parameters that couple
# with it at second order become wrong, with a small standard deviation. The null space is therefore that of the
# information of the data alone, without the information that noise in the Jacobian adds. Its directions are reset to
# the guess and fixed there, and everything else is estimated again until the null space no longer changes. The
# sensitivity of the other parameters to the guess along these directions is part of the covariance (consider
# covariance).
#
# Noise in the Jacobian can constrain an unobservable direction as strongly as data would, and can hide weak data. The
# solver does not drift along such a direction, and a reset to the guess would increase chi^2. The direction is fixed
# at its estimate, unless this is farther from the guess than the prior uncertainty of the guess allows.

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
    parameters, in their units, for independent errors of one standard deviation: of the guess along the fixed
    directions, and of effects that are considered. inflation: factor by which standard deviations of priors on nuisance
    parameters were divided, see `estimate.residual_statistics.inflation`.
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
        return (
            t[:, None] * error_covariance(self._known, self.noise, self.fixed_directions) * t
            + self.shifts.T @ self.shifts
        )

    @cached_property
    def prior_variances(self) -> dict[Key, np.ndarray]:
        """(B,) contribution of the prior on each group of nuisance parameters to the diagonal of the covariance.
        Information that noise in the Jacobian adds is subtracted first, as in `error_covariance`."""
        problem, state = self.estimate.problem, self.estimate.outcome.state
        root = problem.tolerance[:, None] * restricted_root(self._known, self.fixed_directions)
        covariance = root @ root.T
        return {p.block.key: variance_of_priors(covariance, [p], state) for p in nuisance_priors(problem)}

    @property
    def _known(self) -> np.ndarray:
        """(B, B) information with priors, in tolerance units, without what noise in the Jacobian adds."""
        t = self.estimate.problem.tolerance
        return t[:, None] * self.estimate.outcome.information * t - self.noise

    @property
    def variances(self) -> tuple[np.ndarray, np.ndarray]:
        """(B,) variances in squared tolerances: those from the data and priors on nuisance parameters, and those of
        the `shifts` (consider covariance)."""
        by_data = np.diag(error_covariance(self.data, self.noise, self.fixed_directions))
        return by_data, ((self.shifts / self.estimate.problem.tolerance) ** 2).sum(axis=0)


def error_covariance(known: np.ndarray, noise: np.ndarray, fixed_directions: np.ndarray) -> np.ndarray:
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
    guess: dict[Key, np.ndarray] | None = None,
    callbacks: Callbacks = NO_CALLBACKS,
) -> Determined:
    """Estimates the parameters, and fixes the null space of the data at `guess` (default: the values of `start`).

    The estimate is repeated from `start` until the null space no longer changes. Fixed directions are then reset to the
    mean of the priors of the rig file, and priors on nuisance parameters are weighted by the empirical errors. A
    direction that noise in the Jacobian constrains stays at its estimate if that is near the guess. Raises
    EstimationError if the data allow no estimate.
    """
    guess_state = replace(start, values=start.values | (guess or {}))
    search = _NullSpaceSearch.begin(inputs, start, guess_state, callbacks)
    search.find_null_space()
    search.apply_priors()
    search.weight_nuisance_priors()
    result, directions = search.estimate, search.directions
    fixed_directions, shifts = np.zeros((inputs.layout.size, 0)), np.zeros((0, inputs.layout.size))
    if result.problem.fixed_directions.size:
        fixed_directions = result.problem.fixed_directions
        shifts = prior_sensitivity(inputs, result.outcome, directions.data, directions.noise)
    # free the workspace: nothing is solved in it any more
    result = replace(result, outcome=replace(result.outcome, workspace=None))
    return Determined(result, directions.data, directions.noise, fixed_directions, shifts, search.inflation)


@dataclass
class _NullSpaceSearch:
    """Search for the null space. start: state at which the first estimate began. guess: state to which unobservable
    directions are reset. estimate, directions: the last estimate, and the observability of its directions. inflation:
    see `Determined`."""

    inputs: Inputs
    start: State
    guess: State
    callbacks: Callbacks
    estimate: Estimate
    directions: DirectionClasses
    inflation: float = 1.0

    @classmethod
    def begin(cls, inputs: Inputs, start: State, guess: State, callbacks: Callbacks) -> _NullSpaceSearch:
        """The first estimate, no direction fixed."""
        options = EstimateOptions(guess=guess, maybe_rank_deficient=_maybe_rank_deficient)
        first = estimate(inputs, start, options, callbacks)
        return cls(inputs, start, guess, callbacks, first, classify_directions(inputs, first.outcome))

    def find_null_space(self) -> None:
        """Estimates again, with the null space fixed, until it no longer changes. The guess acts as a prior until then,
        but not in the last estimate. From round LATE on nothing is freed again, and more fixed directions are accepted,
        see `_is_same_null_space`. Otherwise the search might cycle, and end with an unobservable direction free."""
        for k in range(MOST_ROUNDS):
            last, null_space = self.estimate, self.directions.unobservable
            unchanged = _is_same_null_space(null_space, last.problem.fixed_directions, k >= LATE)
            if unchanged and not last.outcome.stopped_early:
                return
            keeps_fixed = unchanged and last.problem.fixed_directions.size
            fixed_directions = last.problem.fixed_directions if keeps_fixed else null_space
            if k >= LATE and not keeps_fixed:
                fixed_directions = _joined(last.problem.fixed_directions, null_space)
            # A failed estimate is no start for the next one.
            state = last.outcome.state if _is_usable(last.outcome) else self.start
            reset = self._directions_to_reset(last.problem, state, fixed_directions)
            if reset.size:
                state = project_to_guess(last.problem, state, self.guess, reset)
                state = _adapted(last, state, fixed_directions)
            del last
            self._estimate(state, fixed_directions, with_guess_priors=not unchanged and k + 1 < MOST_ROUNDS)

    def apply_priors(self) -> None:
        """Resets the state along the fixed directions to the mean of the priors that the rig file states, and
        re-solves all other parameters. Repeated until the state stays there; does nothing without such priors."""
        for _ in range(MOST_ROUNDS):
            problem, state = self.estimate.problem, self.estimate.outcome.state
            fixed_directions = problem.fixed_directions
            reset = self._directions_to_reset(problem, state, fixed_directions)
            state = project_to_prior(self.inputs, problem, state, self.guess, reset)
            if state is None:
                return
            state = _adapted(self.estimate, state, fixed_directions)
            del problem
            self._estimate(state, fixed_directions, with_guess_priors=False)

    def weight_nuisance_priors(self) -> None:
        """Re-solves with priors on nuisance parameters weighted by the empirical errors of the measurements
        (`inflation`)."""
        outcome = self.estimate.outcome
        if not outcome.converged or (factor := inflation(self.inputs, outcome)) < MIN_INFLATION:
            return
        problem = with_priors_weighed(outcome.problem, factor)
        options = SolverOptions(on_step=partial(self.callbacks.on_step, "last"))
        outcome = minimise(problem, outcome.state, options, outcome.workspace)
        if outcome.converged:
            self.estimate, self.inflation = replace(self.estimate, outcome=outcome), factor
            self.directions = classify_directions(self.inputs, outcome, self.directions)

    def _directions_to_reset(self, problem: Problem, state: State, fixed_directions: np.ndarray) -> np.ndarray:
        """(B, k) directions in the span of `fixed_directions` (B, m) that are reset to the guess."""
        return directions_to_reset(
            self.inputs, problem, state, self.guess, fixed_directions, self.directions.information
        )

    def _estimate(self, start: State, fixed_directions: np.ndarray, with_guess_priors: bool) -> None:
        """Estimates again from `start`. Noise and outliers are those of the last estimate, unless it failed."""
        model = self.estimate.measurement_model if _is_usable(self.estimate.outcome) else None
        del self.estimate  # before the next one takes as much memory
        options = EstimateOptions(fixed_directions, model, self.guess if with_guess_priors else None)
        self.estimate = estimate(self.inputs, start, options, self.callbacks)
        self.directions = classify_directions(self.inputs, self.estimate.outcome, self.directions)


def _adapted(last: Estimate, state: State, fixed_directions: np.ndarray) -> State:
    """`state`, re-solved with `fixed_directions` (B, m) fixed, in the problem of the estimate `last`.

    Frozen quantities of `last`, such as tracks and weights of points on planes, are kept. Computed at `state`, before
    the trajectory has adapted, they would fit no state, and the next estimate might diverge. Returns `state` if the
    solve fails.
    """
    if not _is_usable(last.outcome):
        return state
    problem = replace(last.problem, fixed_directions=fixed_directions)
    try:
        return minimise(problem, state, EARLY_PASS, last.outcome.workspace).state
    except EstimationError:
        return state


def _is_usable(outcome: Outcome) -> bool:
    """Whether the solver converged or stopped early, so that its state can be used."""
    return outcome.converged or outcome.stopped_early


def _maybe_rank_deficient(problem: Problem, information: np.ndarray) -> bool:
    """Whether the information, noise in the Jacobian included, may be rank deficient."""
    return essential_information(information, problem.tolerance, problem.layout) < RANK_DEFICIENT_BELOW


def _joined(fixed_directions: np.ndarray, null_space: np.ndarray) -> np.ndarray:
    """(B, k) orthonormal: the directions `fixed_directions` (B, m), and those of `null_space` (B, n) that do not count
    as inside them. Both are orthonormal."""
    if not fixed_directions.size:
        return null_space
    outside, sines, _ = np.linalg.svd(null_space - fixed_directions @ (fixed_directions.T @ null_space), False)
    return np.hstack([fixed_directions, outside[:, sines**2 >= 1.0 - ALIKE**2]])


def _is_same_null_space(null_space: np.ndarray, fixed_directions: np.ndarray, late: bool) -> bool:
    """Whether the fixed subspace `fixed_directions` (B, m) equals the null space `null_space` (B, n), both
    orthonormal. In `late` rounds a superset is accepted, to avoid cycling."""
    n, m = (d.shape[1] if d.size else 0 for d in (null_space, fixed_directions))
    if n == 0 or n > m:
        return n == m or (n == 0 and late)
    inside = np.linalg.svd(null_space.T @ fixed_directions, compute_uv=False).min() > ALIKE
    return bool(inside and (n == m or late))


class DirectionClasses(NamedTuple):
    """Observability of the directions of the calibration parameters, in tolerance units.

    spurious: the draws behind `noise`. data (B, B): information of the data and of priors on nuisance parameters,
    without `noise`. noise (B, B): the information that noise in the Jacobian adds. information (B, B): without the
    priors of the rig file, noise included. unobservable (B, m): orthonormal basis of the unobservable directions.
    """

    spurious: Spurious
    data: np.ndarray
    noise: np.ndarray
    information: np.ndarray
    unobservable: np.ndarray


def classify_directions(
    inputs: Inputs, outcome: Outcome, last: DirectionClasses | None = None, columns: np.ndarray | None = None
) -> DirectionClasses:
    """Observability of the calibration parameters `columns` (default: all of them), the other ones fixed.

    Parameters with a prior from the model (target shape, edge bloom) are unobservable only in combination with other
    ones. Nuisance parameters never are: they count as known in this test, and the covariance holds the dependence on
    them. Noise in the Jacobian is not drawn again if the information is about the same as in `last`.
    """
    problem, state = outcome.problem, outcome.state
    columns = np.arange(len(outcome.information)) if columns is None else columns
    t = problem.tolerance[columns]

    def without(priors: Sequence[Prior]) -> np.ndarray:
        """Information of `columns` without `priors`, in parameter units."""
        return without_priors(outcome.information, priors, state)[np.ix_(columns, columns)]

    # Without the priors of the rig file, because they would hide unobservable directions.
    used = {p.block.key for p in problem.priors}
    information = t[:, None] * without([p for p in given_priors(inputs) if p.block.key in used]) * t
    is_essential = np.isin(columns, problem.layout.essential)
    principal = partial(_principal_directions, information, t, is_essential)
    essential = np.ix_(is_essential, is_essential)
    # Drawing stops when no direction is possibly rank deficient.
    if last is not None and _are_alike(last.information[essential], information[essential]):
        spurious = last.spurious
    else:
        spurious = spurious_information(problem, outcome, lambda draws: not principal(draws).maybe_noise.any(), columns)
    directions, noise = principal(spurious), spurious.mean
    # Also without the priors of the model, except those on nuisance parameters.
    data = without([p for p in problem.priors if not p.block.is_nuisance]) - noise
    unobservable = directions.vectors[:, directions.unobservable | directions.maybe_noise]
    return DirectionClasses(spurious, t[:, None] * data * t, t[:, None] * noise * t, information, unobservable)


def _are_alike(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two information matrices (B, B), in tolerance units, agree to a relative UNCHANGED in every observable
    direction."""
    floor = UNOBSERVABLE_BELOW * np.eye(len(a))
    try:
        ratios = eigh(b + floor, a + floor, eigvals_only=True)
    except LinAlgError:  # not positive definite: the state is far from the minimum
        return False
    return bool(np.abs(ratios - 1.0).max(initial=0.0) < UNCHANGED)


class _PrincipalDirections(NamedTuple):
    """Eigenvectors (B, n) of the information without noise, in tolerance units, with two flags each. unobservable (n,):
    there is next to no information. maybe_noise (n,): noise in the Jacobian may account for all of the information."""

    vectors: np.ndarray
    unobservable: np.ndarray
    maybe_noise: np.ndarray


def _principal_directions(
    information: np.ndarray, tolerance: np.ndarray, is_essential: np.ndarray, spurious: Spurious
) -> _PrincipalDirections:
    """Directions of the essential parameters `is_essential` (B,), classified by the `information` (B, B) in tolerance
    units, which includes the noise `spurious`. tolerance: (B,)."""
    essential = np.flatnonzero(is_essential)
    without_noise = information - tolerance[:, None] * spurious.mean * tolerance
    vectors = np.zeros((len(information), len(essential)))
    values, vectors[essential] = np.linalg.eigh(without_noise[np.ix_(essential, essential)])
    with_noise = np.einsum("ik,ij,jk->k", vectors, information, vectors)
    unobservable = values < UNOBSERVABLE_BELOW
    by_chance = values < spurious.chance(tolerance[:, None] * vectors)
    maybe_noise = ~unobservable & by_chance & (values < SPURIOUS_SHARE * with_noise)
    return _PrincipalDirections(vectors, unobservable, maybe_noise)


# Verdicts on parameters, and sentences on unobservable combinations of parameters.

NAMED = 0.2  # entry of a unit direction below which its parameter is not named
MOST_NAMED = 4  # parameters of a direction that are named, those with the largest entries

EVERY_AXIS = "every axis"


@dataclass(frozen=True)
class Observability:
    """covariance (B, B): formal. unobservable: one sentence for each unobservable direction.

    spread (B,): standard deviations in tolerances that the data alone give, consider covariance included; infinite if
    the solver did not converge. in_null_space, by_guess (B,): whether the parameter lies largely in the null space;
    whether errors of the guess are most of its variance.
    """

    covariance: np.ndarray
    unobservable: tuple[Remark, ...]
    spread: np.ndarray
    in_null_space: np.ndarray
    by_guess: np.ndarray

    def verdicts(self, columns: np.ndarray, sizes: np.ndarray) -> tuple[Verdict, ...]:
        """(n,) verdicts on the parameters of `columns` (n,) with standard deviations of `sizes` (n,) tolerances."""
        entries = zip(self.in_null_space[columns], self.by_guess[columns], sizes.tolist(), strict=True)
        return tuple(
            "unobservable" if is_null else component_verdict(size, bool(guess)) for is_null, guess, size in entries
        )


@dataclass(frozen=True)
class RecordingTraits:
    """What advice on a recording depends on. on_wheels: the rig drives on one of its sensors. has_target: the rig has a
    target. at_rest: nothing connects the instants, as at stops. axes: text that names the axes about which the rig
    hardly turned, or empty."""

    on_wheels: bool = False
    has_target: bool = True
    at_rest: bool = False
    axes: str = ""


def observe(
    determined: Determined,
    names: tuple[str, ...],
    specs: Sequence[ParameterSpec],
    traits: RecordingTraits = RecordingTraits(),
) -> Observability:
    """Observability from the spread of the data alone. names (B,): such as "cam0.translation.x". specs (B,): definition
    of each column's group."""
    directions = sparse_basis(determined.fixed_directions)
    by_data, by_guess = determined.variances
    spread = np.sqrt(by_data + by_guess) if determined.estimate.outcome.converged else np.full(len(by_data), np.inf)
    sentences = []
    for direction in directions.T:
        words, first = _words_of(direction, names)
        spec = specs[first]
        motion = _missing_motion(spec, traits).format(axes=traits.axes or EVERY_AXIS)
        by = "these images" if spec.by_images else "these places" if traits.at_rest else "this motion"
        sentences.append(Remark("combination_unobservable", f"{words}: not determined by {by}; {motion}."))
    return Observability(determined.covariance, tuple(sentences), spread, in_null_space(directions), by_guess > by_data)


def sparse_basis(directions: np.ndarray, rounds: int = 50) -> np.ndarray:
    """(B, m) basis of the span of the orthonormal `directions` (B, m), rotated so that each column has few large
    entries (varimax, Kaiser 1958). It begins at a basis that depends on the span alone."""
    n, m = directions.shape if directions.size else (len(directions), 0)
    turn = qr(directions.T, pivoting=True)[0] if m else np.eye(0)
    for _ in range(rounds if m > 1 else 0):
        L = directions @ turn
        U, _, Vt = np.linalg.svd(directions.T @ (L**3 - L * (L**2).mean(axis=0)))
        turn = U @ Vt
    return directions @ turn if m else np.zeros((n, 0))


def _words_of(direction: np.ndarray, names: tuple[str, ...]) -> tuple[str, int]:
    """Text that names the parameters with the largest entries in `direction` (B,), and the column of the largest
    one."""
    order = np.argsort(-np.abs(direction))
    # In the order of the columns, not by size: equal entries would be ordered by noise.
    parts = sorted(i for i in order[:MOST_NAMED] if abs(direction[i]) >= NAMED) or [order[0]]
    return " with ".join(_words(names[i]) for i in parts), int(order[0])


def _missing_motion(spec: ParameterSpec, traits: RecordingTraits) -> str:
    """Text on the motion that would make the parameter observable. It depends on three limits: a rig on wheels cannot
    turn about every axis, without a target, points of the scene are tracked, and at rest only the target moves."""
    others = (
        "" if traits.has_target else spec.motion_without_target,
        spec.motion_on_wheels if traits.on_wheels else "",
        spec.motion_at_rest if traits.at_rest else "",
    )
    return next(filter(None, others), spec.motion)


def _words(name: str) -> str:
    """Readable form of a column's name. The label is left out if the parameter is a single number."""
    sensor, kind, label = name.rsplit(".", 2)
    parameter = kind if label == kind else f"{kind} {label}"
    return f"{sensor} {parameter.replace('_', ' ')}"
