"""Score test of an effect that the model of one factor leaves out (Lagrange multiplier test; Rao 1948).

The parameters of the effect are zero in the model. At the solution, one Newton step of them and of all estimated
parameters follows from the normal equations and from the derivative of the factor's gradient by the effect. The score
of each segment of the recording gives its covariance, as for `split_covariance`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from icalib.estimate.residual_statistics import PieceGradient, Segments
from icalib.estimate.solver import Outcome
from icalib.motion.factor import Factor, Whitened
from icalib.optim.arrowhead import restricted_inverse

STEP = 1e-4  # of the difference quotients; effects are linear far beyond it
MAX_SIGMA = 0.1  # formal standard deviation of an effect [rad]; a direction with a larger one is not tested


class LeftOut(NamedTuple):
    """An effect that differs from zero. value (m,): Newton step of its parameters; sigmas: the largest in standard
    deviations; change (B,): the step of the calibration parameters, in their units."""

    value: np.ndarray
    sigmas: float
    change: np.ndarray


class _Response(NamedTuple):
    """Derivatives by m parameters of an effect. gradients: of the gradient; scores (G, m): of half the chi^2 of each
    segment; information (m, m): J^T J."""

    gradients: list[PieceGradient]
    scores: np.ndarray
    information: np.ndarray


def score_test(
    segments: Segments, outcome: Outcome, effect: Callable[[np.ndarray], Factor], m: int, least: float
) -> LeftOut | None:
    """The effect with `m` parameters, along its principal directions that differ from zero by `least` standard
    deviations. effect: the factor with given values of these. None if no direction differs."""
    response, B, G, t = (
        _response(segments, effect, m),
        len(outcome.information),
        segments.count,
        outcome.problem.tolerance,
    )
    scratch = segments.problem.reusable_output(outcome.residuals)
    by_segment = [PieceGradient.of(segments.piece(g, scratch)) for g in range(G)]
    joint = segments.together([*by_segment, *response.gradients], scratch)
    inverse = restricted_inverse(outcome.information * t[:, None] * t, outcome.problem.fixed_directions)
    inverse = t[:, None] * inverse * t
    b, d = slice(B, B + G), slice(B + G, B + G + m)
    cross = joint[:B, d]
    information = response.information + joint[d, d] - cross.T @ inverse @ cross
    scores = response.scores + joint[b, d] - joint[:B, b].T @ inverse @ cross
    values, vectors = np.linalg.eigh(information)
    tested = values > MAX_SIGMA**-2
    values, vectors = values[tested], vectors[:, tested]
    white = scores @ vectors / np.sqrt(values)
    ratio = np.sqrt(max(1.0, G * white.var(axis=0, ddof=1).mean())) if len(values) else 1.0
    size = -(response.scores.sum(axis=0) @ vectors) / np.sqrt(values)
    differs = np.abs(size) > least * ratio
    if not differs.any():
        return None
    value = vectors[:, differs] @ (size / np.sqrt(values))[differs]
    return LeftOut(value, float(np.abs(size).max() / ratio), -inverse @ cross @ value)


def _response(segments: Segments, effect: Callable[[np.ndarray], Factor], m: int) -> _Response:
    """Difference quotients of rows and gradients by the parameters of `effect`."""
    problem, B = segments.problem, segments.problem.layout.size
    chain, calib = np.zeros((m, problem.n_keyframes, problem.layout.keyframe_dim)), np.zeros((m, B))
    scores, information = np.zeros((segments.count, m)), np.zeros((m, m))
    changed = [[effect(sign * STEP * axis) for sign in (1.0, -1.0)] for axis in np.eye(m)]
    unchanged = effect(np.zeros(m))
    for g, (first, last) in enumerate(zip(segments.ends[:-1], segments.ends[1:], strict=True)):
        out, _ = _at(segments, unchanged, first, last)
        J = []
        for j, pair in enumerate(changed):
            (plus, a), (minus, b) = (_at(segments, factor, first, last) for factor in pair)
            J.append((out.root * (plus.residual - minus.residual)).ravel() / (2.0 * STEP))
            chain[j, first : last + 1] += (a.chain - b.chain) / (2.0 * STEP)
            calib[j] += (a.calib - b.calib) / (2.0 * STEP)
        scores[g] = np.array(J) @ (out.root * out.residual).ravel()
        information += np.array(J) @ np.array(J).T
    return _Response([PieceGradient(0, *x) for x in zip(chain, calib, strict=True)], scores, information)


def _at(segments: Segments, factor: Factor, first: int, last: int) -> tuple[Whitened, PieceGradient]:
    """Rows of `factor` between two keyframes, all others zero, and their gradient."""
    out, piece = factor.output(), segments.problem.zeros(int(first), int(last))
    factor.accumulate(segments.state, piece, out)
    return out, PieceGradient.of(piece)
