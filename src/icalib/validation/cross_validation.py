"""Two-fold cross-validation, in the form of the result."""

from __future__ import annotations

from collections.abc import Collection

from icalib.estimate.problem.problem import Problem
from icalib.estimate.residual_statistics.cross_validation import Prediction, predict, shifts
from icalib.estimate.residual_statistics.fit_statistics import chi2_by_kind, raw_sizes
from icalib.estimate.residual_statistics.segments import Segments
from icalib.result import CrossValidation, PredictedFit


def cross_validation(segments: Segments | None, assumed: Collection[str]) -> CrossValidation | None:
    """None if the recording cannot be split, or if no parameter is observable in both halves. Sensors in `assumed` get
    no fits; no sensor does if the solutions of the halves are too far apart for a linearisation."""
    prediction = None if segments is None else predict(segments)
    if segments is None or prediction is None:
        return None
    fits = tuple(f for f in _fits(segments.problem, prediction) if f.sensor not in assumed) if prediction.linear else ()
    spread = shifts(segments)
    return CrossValidation(
        segments.count,
        prediction.directions,
        prediction.excess,
        prediction.expected,
        prediction.spread,
        fits,
        spread.moved,
        spread.expected,
    )


def _fits(problem: Problem, prediction: Prediction) -> list[PredictedFit]:
    """Size of the residuals of each sensor and kind, within a half and predicted by the other half."""
    inside, outside = (chi2_by_kind(problem, out) for out in (prediction.inside, prediction.outside))
    size, size_outside = (raw_sizes(problem, out) for out in (prediction.inside, prediction.outside))
    return [
        PredictedFit(*key, count, chi2, outside[key].chi2, size[key].rms, size_outside[key].rms, size[key].unit)
        for key, (count, chi2) in inside.items()
    ]
