"""Priors on nuisance parameters, weighed against measurements whose errors are larger than their noise says.

Where model and noise are right, least squares weighs priors and measurements by their information. Errors of real
measurements are correlated over time, and the covariance of the measurements is F^2 times the formal one, with F^2 from
the block jackknife over parts of the recording. Unweighted, the measurements would move nuisance parameters F times
further than they know them. So the priors count F^2 times (variance component of the measurements; Koch, Parameter
Estimation and Hypothesis Testing in Linear Models, 1999, section 3.6), in one more solve. All is then F times as
uncertain as the formal covariance says, a parameter that its prior alone knows among it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.outcome import Outcome
from icalib.estimate.problem.problem import Problem
from icalib.estimate.residual_statistics.fit_statistics import split_covariance, split_expectation
from icalib.estimate.residual_statistics.segments import Segments
from icalib.optim.calib_block import restricted_inverse
from icalib.optim.prior_factor import Prior, variance_of_priors

MIN_INFLATION = 1.5  # below it, another weight of the priors would gain less than a tenth of a standard deviation
ROUNDING = 1e-9  # of a variance: rounding, where a prior contributes all of it
MAX_LEVERAGE = 4.0  # of the variance: one part knows nearly all beyond, and the spread of the others nothing


def noise_variance(problem: Problem, outcome: Outcome) -> np.ndarray:
    """(B,) the part of the formal variances of S^-1, the inverse of the information, that noise of the measurements
    contributes, and not errors of nuisance parameters."""
    t = problem.tolerance
    inverse = t[:, None] * restricted_inverse(t[:, None] * outcome.information * t, problem.fixed_directions) * t
    whole = np.diag(inverse)
    return np.maximum(whole - variance_of_priors(inverse, nuisance_priors(problem), outcome.state), ROUNDING * whole)


def nuisance_priors(problem: Problem) -> list[Prior]:
    """The priors on nuisance parameters."""
    return [p for p in problem.priors if p.block.is_nuisance]


def spread_variance(outcome: Outcome, parts: Segments, white: np.ndarray) -> np.ndarray:
    """(B,) variances by the spread over `parts`, where white noise contributes `white` (B,) to the formal ones."""
    spread, expected = np.diag(split_covariance(outcome, parts)), split_expectation(outcome, parts)
    return np.clip(white / np.maximum(expected, 1e-300), 1.0, MAX_LEVERAGE) * spread


def calibration_columns(inputs: Inputs) -> np.ndarray:
    """Columns of what users take away: not the board's, nor nuisance parameters."""
    own = (b for b in inputs.layout.free if inputs.is_sensor(b.sensor) and not b.is_nuisance)
    return np.concatenate([np.arange(0), *(b.columns for b in own if b.name != "bloom")])


def inflation(inputs: Inputs, outcome: Outcome) -> float:
    """F, the root mean square over the calibration parameters; 1 where no prior bounds a nuisance parameter, or the
    recording cannot be split."""
    problem, columns = outcome.problem, calibration_columns(inputs)
    if not nuisance_priors(problem) or not len(columns):
        return 1.0
    parts = Segments.of(problem, outcome, inputs.rig.settings.segments)
    if parts is None:
        return 1.0
    white = noise_variance(problem, outcome)
    ratio = spread_variance(outcome, parts, white) / white
    return float(np.sqrt(np.mean(ratio[columns])))


def with_priors_weighed(problem: Problem, factor: float) -> Problem:
    """The problem with priors on nuisance parameters that count `factor`^2 times."""
    priors = (replace(p, sigma=p.sigma / factor) if p.block.is_nuisance else p for p in problem.priors)
    return replace(problem, priors=tuple(priors))
