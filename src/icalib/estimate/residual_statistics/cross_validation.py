"""Whether half a recording predicts the other half as well as its formal covariance says.

Near the optimum chi^2 of half h, its own keyframes at their best, is a quadratic form of the step d of the calibration
parameters:

    chi^2_h(d) = c_h + 2 b_h . d + d^T S_h d

With noise of the stated sizes cov(b_h) = S_h, the halves independent. The solution of the other half alone is
d_o = -(S_o + Pi)^-1 (b_o + b_Pi), that of both d = -(S_h + S_o + Pi)^-1 (b_h + b_o + b_Pi), Pi the priors'. By how much
chi^2_h(d_o) exceeds chi^2_h(d) is a quadratic form of these gradients, whose mean and variance follow from their
covariance; without priors the mean is tr(S_h ((S_o)^-1 + (S_h + S_o)^-1)), three times the number of parameters where
the halves know as much, for both halves together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.estimate.residual_statistics.segments import Segments
from icalib.motion.factor import Residuals
from icalib.optim.arrowhead import Piece, chain_step_given_calib, in_parallel
from icalib.optim.calib_block import UNOBSERVABLE_BELOW, complement, restricted_inverse

MIN_SINGULAR_VALUE = 1e-6  # of a direction: shorter ones are rounding
MAX_NONLINEAR_SHARE = 0.1  # of the excess: what it may be off by where the step of the other half is short enough


@dataclass(frozen=True)
class Prediction:
    """How well each half of the parts, every other one, is predicted by the other half.

    directions: how many of the calibration parameters both halves know, the rest being found in each half for itself;
    excess: by how much chi^2 is higher where they are the other half's than where they are those of both, by the
    quadratic form above; expected, spread: mean and standard deviation of that form for noise of the stated sizes.
    inside, outside: residuals with the solution of both, and with the other half's; linear: whether these rise as much
    as the form says.

    Measured residuals are no test statistic: a half that knows a plane or a mount to some tolerances only sends the
    other one so far that residuals leave the quadratic form, by any amount, with nothing wrong. The form has the mean
    and the spread that are stated.
    """

    directions: int
    excess: float
    expected: float
    spread: float
    inside: Residuals
    outside: Residuals
    linear: bool


class Half(NamedTuple):
    """A half's information (r, r) and gradient (r,) of what both halves know; what only it can know is found by
    itself: `rest` (m, r + 1) gives its step from that of the others, and 1."""

    information: np.ndarray
    gradient: np.ndarray
    rest: np.ndarray


class Excess(NamedTuple):
    """Of both halves together, for the gradients as they are, and for noise; steps (3, r): of the solution of the first
    half, of the second, and of both."""

    value: float
    mean: float
    std: float
    steps: np.ndarray


def predict(parts: Segments) -> Prediction | None:
    """Predicts each half of the recording from the other. None if no direction of the calibration parameters is
    determined by both."""
    t, B = parts.problem.tolerance, parts.problem.layout.size
    free = t[:, None] * complement(parts.problem.fixed_directions, B)
    halves, shared, own = halves_of(parts.sums, free)
    if not shared.shape[1]:
        return None
    prior = _within(_priors(parts), free @ shared)
    found = excess(halves[0], halves[1], prior)
    steps = []
    for h, half in enumerate(halves):
        known = found.steps[[2, 1 - h]].T  # of both, of the other
        rest = half.rest @ np.vstack([known, np.ones(2)])
        steps.append(free @ (shared @ known + own @ rest))
    costs, inside, outside = _evaluate(parts, steps)
    bent = abs(2.0 * float(costs[1] - costs[0]) - found.value)
    linear = bent < max(found.std, MAX_NONLINEAR_SHARE * abs(found.value))
    return Prediction(shared.shape[1], found.value, found.mean, found.std, inside, outside, linear)


def halves_of(sums: np.ndarray, free: np.ndarray) -> tuple[list[Half], np.ndarray, np.ndarray]:
    """The two halves of parts with sums (G, B + 1, B + 1), every other one; and orthonormal columns (n, r) of what both
    know, (n, n - r) of the rest, among the directions `free` (B, n), in tolerances."""
    both = [_within(sums[h::2].sum(axis=0), free) for h in range(2)]
    own = _unknown([information for information, _ in both])
    shared = complement(own, free.shape[1])
    return [_half(*one, shared, own) for one in both], shared, own


def _within(sums: np.ndarray, basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information and gradient along the columns of `basis` (B, n), from sums (B + 1, B + 1)."""
    return basis.T @ sums[:-1, :-1] @ basis, basis.T @ sums[:-1, -1]


def _priors(parts: Segments) -> np.ndarray:
    piece = Piece.zeros(0, 0, parts.problem.layout.size)
    for prior in parts.problem.priors:
        prior.accumulate(parts.state, piece)
    return piece.calib


def _unknown(information: list[np.ndarray]) -> np.ndarray:
    """(n, m) orthonormal: directions that one half or the other does not know, in units of tolerances."""
    found = []
    for own in information:
        values, vectors = np.linalg.eigh(own)
        found.append(vectors[:, values < UNOBSERVABLE_BELOW])
    vectors, sizes, _ = np.linalg.svd(np.concatenate(found, axis=1), full_matrices=False)
    return vectors[:, sizes > MIN_SINGULAR_VALUE]


def _half(information: np.ndarray, gradient: np.ndarray, shared: np.ndarray, own: np.ndarray) -> Half:
    """What the directions `own` leave of the `shared` ones. They stay within some ten tolerances: of what a half does
    not see it says nothing."""
    S = information + UNOBSERVABLE_BELOW * own @ own.T
    both = np.concatenate([own.T @ S @ shared, (own.T @ gradient)[:, None]], axis=1)
    rest = -np.linalg.solve(own.T @ S @ own, both)
    left = shared.T @ S @ own @ rest
    return Half(shared.T @ S @ shared + left[:, :-1], shared.T @ gradient + left[:, -1], rest)


def excess(first: Half, second: Half, prior: tuple[np.ndarray, np.ndarray]) -> Excess:
    """chi^2 of each half at the solution of the other, less that at the solution of both; of both halves together."""
    r, Pi = len(first.gradient), prior[0]
    pick = np.eye(3 * r).reshape(3, r, 3 * r)  # of the gradients of the first, the second, the priors
    pairs = (
        (first.information, pick[0]),
        (second.information, pick[1]),
        (first.information + second.information, pick[0] + pick[1]),
    )
    steps = [-np.linalg.solve(S + Pi, one + pick[2]) for S, one in pairs]
    form = np.zeros((3 * r, 3 * r))
    for h in range(2):
        S, one = pairs[h]
        for sign, step in ((1.0, steps[1 - h]), (-1.0, steps[2])):
            form += sign * (one.T @ step + step.T @ one + step.T @ S @ step)
    covariance = np.zeros_like(form)
    for k, S in enumerate((first.information, second.information, Pi)):
        covariance[k * r : k * r + r, k * r : k * r + r] = S
    gradients = np.concatenate([first.gradient, second.gradient, prior[1]])
    spread = form @ covariance
    value, variance = float(gradients @ form @ gradients), 2.0 * float(np.sum(spread * spread.T))
    return Excess(value, float(np.trace(spread)), float(np.sqrt(variance)), np.array([s @ gradients for s in steps]))


def _evaluate(parts: Segments, steps: list[np.ndarray]) -> tuple[np.ndarray, Residuals, Residuals]:
    """Half the chi^2 (2,) and the residuals at two steps of the calibration parameters of either half, steps (B, 2) of
    both and of the other: the keyframes of each part follow, and nothing is linear but their step."""
    problem, state = parts.problem, parts.state
    found, scratch = (problem.residuals(), problem.residuals()), problem.residuals()

    def costs(g: int) -> list[float]:
        step = steps[g % 2]
        own = chain_step_given_calib(parts.piece(g, scratch), step)
        out = []
        for k in range(2):
            chain = np.zeros((problem.n_keyframes, own.shape[1]))
            chain[parts.ends[g] : parts.ends[g] + len(own)] = own[:, :, k]
            out.append(parts.cost(g, state.retract(problem.layout, chain, step[:, k]), found[k]))
        return out

    return np.sum(in_parallel(costs, range(parts.count)), axis=0), *found


@dataclass(frozen=True)
class Shifts:
    """Of the calibration parameters, without each of G parts: by how much the solution moves (G, B), and the standard
    deviation (G, B) of that where noise is as stated: the variance without the part less that with it."""

    moved: np.ndarray
    expected: np.ndarray


def shifts(parts: Segments) -> Shifts:
    """The solution without each part, against that of all parts."""
    t, fixed_directions = parts.problem.tolerance, parts.problem.fixed_directions
    scale = np.append(t, 1.0)
    sums = parts.sums * scale[:, None] * scale
    total = sums.sum(axis=0) + _priors(parts) * scale[:, None] * scale

    def solved(S: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        P = restricted_inverse(S[:-1, :-1], fixed_directions)
        return -t * (P @ S[:-1, -1]), t**2 * np.diag(P)

    step, variance = solved(total)
    without = [solved(total - one) for one in sums]
    moved, wider = (np.array(x) for x in zip(*without, strict=True))
    return Shifts(moved - step, np.sqrt(np.maximum(wider - variance, 0.0)))
