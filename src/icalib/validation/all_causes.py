"""All possible causes of a wrong result, ranked: wrong values in the rig file, changes over the recording, other
misfit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.residual_statistics.segments import Segments
from icalib.observability.cause import Cause
from icalib.observability.contradictions import SIGMAS, Contradiction, contradictions
from icalib.observability.relaxed import Relaxed, relaxed
from icalib.optim.state import Key
from icalib.result import ParameterGroup, SensorFit
from icalib.result.timeline import Timeline
from icalib.result.verdict import AUXILIARY
from icalib.sensors import call_all_kinds
from icalib.validation.causes import Misfit, changing, explaining, ranked
from icalib.validation.misfit import LARGE_FACTOR, misfit_causes
from icalib.validation.size import felt_size, is_certain, scale_causes, scale_notes, size_words
from icalib.validation.stated import absurd_values, stated_words

IMAGE_KINDS = ("corners", "features")


@dataclass(frozen=True)
class AssessedEstimate:
    """An estimate with its statistics. factor: the largest empirical factor, which multiplies formal standard
    deviations; segments: of the recording, None if it is not split."""

    inputs: Inputs
    estimate: Estimate
    groups: tuple[ParameterGroup, ...]
    fits: Sequence[SensorFit]
    factor: float
    segments: Segments | None
    timeline: Timeline

    @property
    def misfit_factor(self) -> float:
        """Largest ratio of a sensor's residuals to its stated noise; at least 1."""
        return float(np.sqrt(max([1.0, *(f.chi2_per_dof or 1.0 for f in self.fits)])))


def all_causes(assessed: AssessedEstimate, against: Sequence[Contradiction]) -> tuple[list[Cause], tuple[str, ...]]:
    """All causes, the grave ones first, then by decreasing gain; and notes on the size of the target.

    against: values of the rig file that contradict an estimate without any of its values. Such an estimate is made only
    if the first one fails or fits poorly. If `against` is empty, contradictions are searched here.

    If it is not empty, its causes are grave, and tests that these values may distort are skipped. These are tests of
    the target size, of changes over the recording, and of residuals of other kinds than IMAGE_KINDS.
    """
    inputs, estimate = assessed.inputs, assessed.estimate
    stated, notes = _stated(assessed, against)
    omitted = set(call_all_kinds("assess", "unreliable", inputs.rig, estimate.problem.factors))
    fits = [f for f in assessed.fits if (not against or f.kind in IMAGE_KINDS) and f.kind not in omitted]
    misfit = Misfit.of(fits)
    known = stated
    if not explaining([c for c in stated if c.gain < np.inf], misfit) and not against:
        scattering = assessed.factor > LARGE_FACTOR
        known = [*stated, *changing(inputs, estimate, assessed.segments, misfit, scattering, assessed.timeline)]
    both = ranked([*known, *misfit_causes(inputs, estimate, fits, explaining(known, misfit))])
    return [*(c for c in both if c.grave), *(c for c in both if not c.grave)], notes


def _stated(assessed: AssessedEstimate, against: Sequence[Contradiction]) -> tuple[list[Cause], tuple[str, ...]]:
    """Causes that are wrong values in the rig file: target size, scales, those that each kind of sensor tests, other
    values; and notes on the size."""
    inputs, factor = assessed.inputs, assessed.factor
    size = None if inputs.rig.assumes_motion else felt_size(assessed.estimate, factor)
    wrong_size, notes = ((), ()) if against else size_words(inputs, size)
    # Other contradictions may follow from a wrong size, or from the scale of the accelerometer.
    certain, given = is_certain(size), bool(against)
    relaxed_rig = None if given else relaxed(inputs, assessed.estimate)
    scale = max(factor, assessed.misfit_factor)
    against = against or contradictions(inputs, relaxed_rig, scale)
    if certain:  # a wrong size also changes lever arms
        against = tuple(c for c in against if c.in_prior_sigmas > 1.0)
    causes: list[Cause] = []
    if size is not None:
        gain = ((size.ratio - 1.0) / (size.std / factor)) ** 2
        causes += [Cause(sentence, float(gain), certain) for sentence in wrong_size]
    causes += scale_causes(inputs, assessed.groups, size)
    causes += call_all_kinds(
        "assess", "causes", inputs, assessed.estimate, assessed.groups, factor, None if certain else relaxed_rig
    )
    explained = {key for cause in causes for key in cause.explains}
    against = tuple(c for c in against if c.key not in explained)
    causes += _contradicted(assessed, against, scale, certain or given, relaxed_rig)
    return causes, (*notes, *scale_notes(inputs, size))


def _contradicted(
    assessed: AssessedEstimate, against: Sequence[Contradiction], scale: float, grave: bool, relaxed_rig: Relaxed | None
) -> Iterator[Cause]:
    """A cause for each contradicted value in `against`, then for absurd values. scale: factor on formal standard
    deviations; grave: whether all of them are grave. relaxed_rig: None if gains are unknown, which
    then count as infinite."""
    for c in against:
        gain = np.inf if relaxed_rig is None else float(((c.off / (c.sigma / scale)) ** 2).max())
        moves = relaxed_rig is not None and _moves_others(assessed, relaxed_rig, c.key)
        yield Cause(stated_words(assessed.inputs, c), gain, grave or moves)
    yield from (Cause(s, 0.0, grave) for s in absurd_values(assessed.inputs, against, assessed.groups))


def _moves_others(assessed: AssessedEstimate, relaxed_rig: Relaxed, key: Key) -> bool:
    """Whether the stated value of the group `key` distorts the result: without it, a parameter of another group moves
    by more than SIGMAS printed standard deviations."""
    step, _ = relaxed_rig.step([key])
    for g in assessed.groups:
        if g.columns is None or (g.sensor, g.name) == key or g.name in AUXILIARY:
            continue
        if (np.abs(step[relaxed_rig.layout.columns(g.sensor, g.name)]) > SIGMAS * g.std).any():
            return True
    return False
