"""Weights of priors on nuisance parameters, if errors of measurements exceed the stated noise.

With the right model and noise, least squares weights priors and measurements by their information. Errors of real
measurements are correlated over time, and their covariance is F^2 times the formal one. F^2 comes from the block
jackknife over segments of the recording. With formal weights, errors of measurements would move nuisance parameters too
far. So the priors are multiplied by F^2 in one more solve (variance component of the measurements; Koch, Parameter
Estimation and Hypothesis Testing in Linear Models, 1999, section 3.6). All standard deviations are then F times the
formal ones, even of a parameter that only its prior determines.
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

MIN_INFLATION = 1.5  # below it, other weights of the priors would gain less than a tenth of a standard deviation
ROUNDING = 1e-9  # of a variance: rounding error, if priors contribute all of it
MAX_LEVERAGE = 4.0  # formal over expected variance: beyond it, one segment has nearly all information


def noise_variance(problem: Problem, outcome: Outcome) -> np.ndarray:
    """(B,) part of the formal variances that noise of the measurements contributes. Priors on nuisance parameters
    contribute the rest."""
    t = problem.tolerance
    inverse = t[:, None] * restricted_inverse(t[:, None] * outcome.information * t, problem.fixed_directions) * t
    whole = np.diag(inverse)
    return np.maximum(whole - variance_of_priors(inverse, nuisance_priors(problem), outcome.state), ROUNDING * whole)


def nuisance_priors(problem: Problem) -> list[Prior]:
    """The priors on nuisance parameters."""
    return [p for p in problem.priors if p.block.is_nuisance]


def spread_variance(outcome: Outcome, parts: Segments, white: np.ndarray) -> np.ndarray:
    """(B,) variances from the scatter over `parts`. white (B,): contribution of white noise to the formal variances."""
    spread, expected = np.diag(split_covariance(outcome, parts)), split_expectation(outcome, parts)
    return np.clip(white / np.maximum(expected, 1e-300), 1.0, MAX_LEVERAGE) * spread


def calibration_columns(inputs: Inputs) -> np.ndarray:
    """Calibration columns that matter to a user: of sensors, without nuisance parameters and bloom."""
    blocks = (b for b in inputs.layout.free if inputs.is_sensor(b.sensor) and not b.is_nuisance)
    return np.concatenate([np.arange(0), *(b.columns for b in blocks if b.name != "bloom")])


def inflation(inputs: Inputs, outcome: Outcome) -> float:
    """F, RMS over `calibration_columns` of the ratio of empirical to formal standard deviation. 1 without priors on
    nuisance parameters, or if the recording cannot be divided."""
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
    """The problem with the information of priors on nuisance parameters multiplied by `factor`^2."""
    priors = (replace(p, sigma=p.sigma / factor) if p.block.is_nuisance else p for p in problem.priors)
    return replace(problem, priors=tuple(priors))
