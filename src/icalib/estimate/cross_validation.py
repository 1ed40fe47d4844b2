"""Two-fold cross-validation: whether each half of a recording predicts the other as well as the formal covariance says.

With its keyframes optimised, chi^2 of half h is quadratic in the step d of the calibration parameters near the optimum.
S_h is its information and b_h its gradient:

    chi^2_h(d) = c_h + 2 b_h . d + d^T S_h d

For noise of the stated sizes cov(b_h) = S_h, and the halves are independent. Priors have the information Pi and the
gradient b_Pi. The solutions of the other half and of both are

    d_o = -(S_o + Pi)^-1 (b_o + b_Pi)        d = -(S_h + S_o + Pi)^-1 (b_h + b_o + b_Pi)

The excess chi^2_h(d_o) - chi^2_h(d), summed over both halves, is a quadratic form of these gradients. Its mean and
variance follow from their covariance. Without priors the mean is the sum over h of tr(S_h (S_o^-1 + (S_h + S_o)^-1)).
This is three times the number of parameters if both halves have equal information.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from icalib.estimate.residual_statistics import Segments
from icalib.motion.factor import Residuals
from icalib.optim.arrowhead import (
    UNOBSERVABLE_BELOW,
    chain_step_given_calib,
    complement,
    in_parallel,
    restricted_inverse,
)

MIN_SINGULAR_VALUE = 1e-6  # of the span of directions: smaller ones are rounding errors
MAX_NONLINEAR_SHARE = 0.1  # of the excess: error of the quadratic form that still counts as linear


@dataclass(frozen=True)
class Prediction:
    """Result of the cross-validation. The even segments are one half, the odd ones the other.

    directions: number of directions of the calibration parameters that both halves determine; the rest is estimated in
    each half. excess: of chi^2 by the quadratic form above. expected, spread: mean and standard deviation of that form
    for noise of the stated sizes. inside, outside: residuals with the solution of both halves, and with the other
    half's. linear: whether chi^2 of these residuals rises as the form predicts.

    The excess is not computed from residuals. If a half determines a plane or extrinsics only to some tolerances, the
    residuals of the other half leave the quadratic range, without any fault.
    """

    directions: int
    excess: float
    expected: float
    spread: float
    inside: Residuals
    outside: Residuals
    linear: bool


class Half(NamedTuple):
    """Information (r, r) and gradient (r,) of one half along the shared directions, its remaining directions
    eliminated. `rest` (m, r + 1) times (shared step, 1) is the step along the remaining directions."""

    information: np.ndarray
    gradient: np.ndarray
    rest: np.ndarray


class Excess(NamedTuple):
    """Excess of both halves together; its mean and standard deviation for noise of the stated sizes. steps (3, r):
    solutions of the first half, the second, and both."""

    value: float
    mean: float
    std: float
    steps: np.ndarray


def predict(parts: Segments) -> Prediction | None:
    """Cross-validates the halves of the recording. None if both halves determine no common direction of the calibration
    parameters."""
    t, B = parts.problem.tolerance, parts.problem.layout.size
    free = t[:, None] * complement(parts.problem.fixed_directions, B)
    halves, shared, remaining = halves_of(parts.sums, free)
    if not shared.shape[1]:
        return None
    prior = _within(_priors(parts), free @ shared)
    halves_excess = excess(halves[0], halves[1], prior)
    steps = []
    for h, half in enumerate(halves):
        known = halves_excess.steps[[2, 1 - h]].T  # solutions of both halves, of the other half
        rest = half.rest @ np.vstack([known, np.ones(2)])
        steps.append(free @ (shared @ known + remaining @ rest))
    costs, inside, outside = _evaluate(parts, steps)
    bent = abs(2.0 * float(costs[1] - costs[0]) - halves_excess.value)
    linear = bent < max(halves_excess.std, MAX_NONLINEAR_SHARE * abs(halves_excess.value))
    return Prediction(
        shared.shape[1], halves_excess.value, halves_excess.mean, halves_excess.std, inside, outside, linear
    )


def halves_of(sums: np.ndarray, free: np.ndarray) -> tuple[list[Half], np.ndarray, np.ndarray]:
    """The halves (even and odd segments) of `sums` (G, B + 1, B + 1). Also orthonormal columns (n, r) of the directions
    that both determine, and (n, n - r) of the rest. Both are in the basis `free` (B, n), which is in tolerance
    units."""
    both = [_within(sums[h::2].sum(axis=0), free) for h in range(2)]
    remaining = _unknown([information for information, _ in both])
    shared = complement(remaining, free.shape[1])
    return [_half(*one, shared, remaining) for one in both], shared, remaining


def _within(sums: np.ndarray, basis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Information and gradient along the columns of `basis` (B, n), from sums (B + 1, B + 1)."""
    return basis.T @ sums[:-1, :-1] @ basis, basis.T @ sums[:-1, -1]


def _priors(parts: Segments) -> np.ndarray:
    """Information and gradient (B + 1, B + 1) of the priors on the calibration parameters."""
    piece = parts.problem.zeros(0, 0)
    for prior in parts.problem.priors:
        prior.accumulate(parts.state, piece)
    return piece.calib


def _unknown(information: list[np.ndarray]) -> np.ndarray:
    """Orthonormal directions (n, m) that one half or the other does not determine. information: of each half, in
    tolerance units."""
    directions = []
    for matrix in information:
        values, vectors = np.linalg.eigh(matrix)
        directions.append(vectors[:, values < UNOBSERVABLE_BELOW])
    vectors, sizes, _ = np.linalg.svd(np.concatenate(directions, axis=1), full_matrices=False)
    return vectors[:, sizes > MIN_SINGULAR_VALUE]


def _half(information: np.ndarray, gradient: np.ndarray, shared: np.ndarray, remaining: np.ndarray) -> Half:
    """Eliminates the directions `remaining` from one half. An information of UNOBSERVABLE_BELOW limits their step to
    about ten tolerances, because the half may not observe them at all."""
    S = information + UNOBSERVABLE_BELOW * remaining @ remaining.T
    both = np.concatenate([remaining.T @ S @ shared, (remaining.T @ gradient)[:, None]], axis=1)
    rest = -np.linalg.solve(remaining.T @ S @ remaining, both)
    left = shared.T @ S @ remaining @ rest
    return Half(shared.T @ S @ shared + left[:, :-1], shared.T @ gradient + left[:, -1], rest)


def excess(first: Half, second: Half, prior: tuple[np.ndarray, np.ndarray]) -> Excess:
    """chi^2 of each half at the solution of the other, less that at the solution of both, summed over the halves.
    prior: information (r, r) and gradient (r,)."""
    r, Pi = len(first.gradient), prior[0]
    pick = np.eye(3 * r).reshape(3, r, 3 * r)  # selects the gradient of the first half, the second, the priors
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
    """Half the chi^2 (2,) and the residuals, with the joint solution and with the other half's. steps: per half, (B, 2)
    steps of the calibration parameters to these solutions. Keyframes take their optimal linear step; residuals are not
    linearised."""
    problem, state = parts.problem, parts.state
    residuals, scratch = (problem.residuals(), problem.residuals()), problem.residuals()

    def costs(g: int) -> list[float]:
        step = steps[g % 2]
        chain_steps = chain_step_given_calib(parts.piece(g, scratch), step)
        out = []
        for k in range(2):
            chain = np.zeros((problem.n_keyframes, chain_steps.shape[1]))
            chain[parts.ends[g] : parts.ends[g] + len(chain_steps)] = chain_steps[:, :, k]
            out.append(parts.cost(g, state.retract(problem.layout, chain, step[:, k]), residuals[k]))
        return out

    return np.sum(in_parallel(costs, range(parts.count)), axis=0), *residuals


@dataclass(frozen=True)
class Shifts:
    """Change of the solution when one of G segments is left out. moved (G, B): change of each calibration parameter.
    expected (G, B): its standard deviation for noise of the stated sizes, sqrt(variance without the segment - variance
    with it)."""

    moved: np.ndarray
    expected: np.ndarray


def shifts(parts: Segments) -> Shifts:
    """Change of the solution without each segment, against that of all segments."""
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
