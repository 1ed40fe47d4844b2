"""Degrees of freedom after the fit, and covariances from the scatter of segments."""

from __future__ import annotations

import numpy as np

from icalib.estimate.problem.outcome import Outcome, posterior
from icalib.estimate.problem.problem import Problem
from icalib.estimate.residual_statistics.segments import Segments
from icalib.model.statistics import Fit
from icalib.motion.factor import FitKey, RawSize, ResidualRows, Residuals, Squares, StateDifference
from icalib.optim.arrowhead import Draw
from icalib.optim.calib_block import restricted_inverse

DRAW_STEP = 1e-3  # of a posterior draw: step of difference quotients, small enough to be linear


def fits(problem: Problem, outcome: Outcome) -> list[Fit]:
    """chi^2 and degrees of freedom after the fit, of each kind of residual of every sensor.

    A draw x from the posterior has the covariance H^-1. So |J_s x|^2 has the mean tr(J_s H^-1 J_s^T), the degrees of
    freedom that the fit takes from sensor s. J x is a difference quotient of the residuals.
    """
    spent: dict[FitKey, list[float]] = {}
    for draw in (outcome.draws or posterior(problem, outcome.state)).free:
        for key, value in _spent(problem, outcome, draw).items():
            spent.setdefault(key, []).append(value)
    squares = chi2_by_kind(problem, outcome.residuals)
    return [Fit(*key, n, n - float(np.mean(spent[key])), chi2) for key, (n, chi2) in squares.items()]


def chi2_by_kind(problem: Problem, at: Residuals) -> dict[FitKey, Squares]:
    """Number and chi^2 of each kind of residual of each sensor, with the current robust weights."""
    return {kind: squares for key, f in problem.factors.items() for kind, squares in f.squares(at[key]).items()}


def raw_sizes(problem: Problem, at: Residuals) -> dict[FitKey, RawSize]:
    """RMS of each kind of residual before whitening, its unit, and the number of outliers."""
    return {kind: size for key, f in problem.factors.items() for kind, size in f.sizes(at[key]).items()}


def rows_of(outcome: Outcome, sensor: str, kind: str) -> ResidualRows | None:
    """Residuals of one kind by one sensor; None if no factor has any."""
    for key, factor in outcome.problem.factors.items():
        for rows in factor.rows(outcome.residuals[key], outcome.state):
            if (rows.sensor, rows.kind) == (sensor, kind):
                return rows
    return None


def _spent(problem: Problem, outcome: Outcome, draw: Draw) -> dict[FitKey, float]:
    """|J_s x|^2 of each kind of residual of each sensor, for one draw x."""
    start, end = (outcome.state.retract(problem.layout, s * draw.chain, s * draw.calib) for s in (0.0, DRAW_STEP))
    along, at = StateDifference(start, end, DRAW_STEP), outcome.residuals
    return {kind: dof for key, f in problem.factors.items() for kind, dof in f.dof_used(at[key], along).items()}


def split_covariance(outcome: Outcome, parts: Segments) -> np.ndarray:
    """(B, B) covariance of the calibration parameters from the scatter of segments.

    The gradient b_g of segment g at the joint optimum, the joint trajectory marginalised, would be zero but for noise.
    With the joint information S, the scatter gives S^-1 (G / (G - 1) sum (b_g - b)(b_g - b)^T) S^-1, the block
    jackknife to first order.
    """
    b, n = parts.gradients, parts.count
    return n / (n - 1.0) * spread_covariance(parts.problem, outcome, b - b.mean(axis=0))


def split_expectation(outcome: Outcome, parts: Segments) -> np.ndarray:
    """(B,) expected variances of `split_covariance` for white noise.

    At the joint optimum the gradient of segment g has the covariance S_g - S_g S^-1 S_g, because a segment with much
    information pulls the optimum towards itself (leverage; Bell and McCaffrey 2002). S_g is the information of the
    segment alone, and an equal share of what only the joint trajectory adds. For equal segments these are the formal
    variances.
    """
    t, n = parts.problem.tolerance, parts.count
    inverse = restricted_inverse(outcome.information * t[:, None] * t, parts.problem.fixed_directions)
    segment_information = parts.sums[:, :-1, :-1]
    known = (segment_information + (parts.information - segment_information.sum(axis=0)) / n) * t[:, None] * t
    left = (known - known @ inverse @ known).sum(axis=0)
    return t**2 * n / (n - 1.0) * np.diag(inverse @ left @ inverse)


def spread_covariance(problem: Problem, outcome: Outcome, b: np.ndarray) -> np.ndarray:
    """S^-1 (sum b_g b_g^T) S^-1 for gradients b (G, B) and the information S of `outcome`; zero along fixed
    directions."""
    t = problem.tolerance
    inverse = restricted_inverse(outcome.information * t[:, None] * t, problem.fixed_directions)
    half = t[:, None] * (inverse @ (t[:, None] * b.T))
    return half @ half.T
