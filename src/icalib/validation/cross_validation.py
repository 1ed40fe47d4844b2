"""Two-fold cross-validation, as in the result."""

from __future__ import annotations

from collections.abc import Collection

from icalib.estimate.problem.problem import Problem
from icalib.estimate.residual_statistics.cross_validation import Prediction, predict, shifts
from icalib.estimate.residual_statistics.fit_statistics import chi2_by_kind, raw_sizes
from icalib.estimate.residual_statistics.segments import Segments
from icalib.result import CrossValidation, PredictedFit


def cross_validation(parts: Segments | None, assumed: Collection[str]) -> CrossValidation | None:
    """None if the recording cannot be split, or if no parameter is known to both halves. `assumed` sensors have no
    fits; no sensor has if the solutions of the halves are too far apart to be linearised."""
    found = None if parts is None else predict(parts)
    if parts is None or found is None:
        return None
    fits = tuple(f for f in _fits(parts.problem, found) if f.sensor not in assumed) if found.linear else ()
    spread = shifts(parts)
    return CrossValidation(
        parts.count, found.directions, found.excess, found.expected, found.spread, fits, spread.moved, spread.expected
    )


def _fits(problem: Problem, found: Prediction) -> list[PredictedFit]:
    inside, outside = (chi2_by_kind(problem, out) for out in (found.inside, found.outside))
    size, size_outside = (raw_sizes(problem, out) for out in (found.inside, found.outside))
    return [
        PredictedFit(*key, count, chi2, outside[key].chi2, size[key].rms, size_outside[key].rms, size[key].unit)
        for key, (count, chi2) in inside.items()
    ]
