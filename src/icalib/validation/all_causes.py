"""All possible causes of a wrong result, ranked: wrong values in the rig file, changes over the recording, other
misfit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.residual_statistics.segments import Segments
from icalib.observability.contradictions import SIGMAS, Contradiction, contradictions
from icalib.observability.fixed_lens import lens_steps
from icalib.observability.relaxed import Relaxed, relaxed
from icalib.optim.state import Key
from icalib.result import ParameterGroup, SensorFit
from icalib.result.timeline import Timeline
from icalib.result.verdict import AUXILIARY
from icalib.rig import LENS
from icalib.sensors import call_kind
from icalib.sensors.camera.assess import plane_warnings
from icalib.sensors.camera.features.surfaces import ON_PLANES
from icalib.validation.cameras import mixed_up, other_lens
from icalib.validation.causes import Cause, Misfit, changing, explaining, ranked
from icalib.validation.lens_models import lens_warnings
from icalib.validation.misfit import LARGE_FACTOR, misfit_causes
from icalib.validation.size import felt_size, is_certain, scale_causes, scale_notes, size_words
from icalib.validation.stated import absurd_values, stated_words

IMAGE_KINDS = ("corners", "features")


@dataclass(frozen=True)
class AssessedEstimate:
    """An estimate with its statistics. factor: the largest empirical factor, which multiplies formal standard
    deviations; parts: segments of the recording."""

    inputs: Inputs
    estimate: Estimate
    groups: tuple[ParameterGroup, ...]
    fits: Sequence[SensorFit]
    factor: float
    parts: Segments | None
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
    few = any(plane_warnings(inputs.rig, estimate.problem.factors))
    # With few points on planes, these lie there by chance, and their residuals mean nothing.
    fits = [f for f in assessed.fits if (not against or f.kind in IMAGE_KINDS) and not (few and f.kind == ON_PLANES)]
    misfit = Misfit.of(fits)
    known = stated
    if not explaining([c for c in stated if c.gain < np.inf], misfit) and not against:
        scattering = assessed.factor > LARGE_FACTOR
        known = [*stated, *changing(inputs, estimate, assessed.parts, misfit, scattering, assessed.timeline)]
    both = ranked([*known, *misfit_causes(inputs, estimate, fits, explaining(known, misfit))])
    return [*(c for c in both if c.grave), *(c for c in both if not c.grave)], notes


def _stated(assessed: AssessedEstimate, against: Sequence[Contradiction]) -> tuple[list[Cause], tuple[str, ...]]:
    """Causes that are wrong values in the rig file: target size, scales, swapped cameras, intrinsics, camera models,
    other values; and notes on the size."""
    inputs, factor = assessed.inputs, assessed.factor
    size = None if inputs.rig.assumes_motion else felt_size(assessed.estimate, factor)
    wrong_size, notes = ((), ()) if against else size_words(inputs, size)
    # Other contradictions may follow from a wrong size, or from the scale of the accelerometer.
    certain, given = is_certain(size), bool(against)
    stated = None if given else relaxed(inputs, assessed.estimate)
    lenses = () if certain else tuple(other_lens(inputs.rig.cameras, lens_steps(inputs, stated), factor))
    scale = max(factor, assessed.misfit_factor)
    against = against or contradictions(inputs, stated, scale)
    if certain:  # a wrong size also changes lever arms
        against = tuple(c for c in against if c.in_prior_sigmas > 1.0)
    causes = [Cause(sentence, np.inf, True) for sentence in mixed_up(inputs.rig.cameras, assessed.groups)]
    if size is not None:
        gain = ((size.ratio - 1.0) / (size.std / factor)) ** 2
        causes += [Cause(sentence, float(gain), certain) for sentence in wrong_size]
    scales = tuple(scale_causes(inputs, assessed.groups, size))
    causes += scales
    causes += [Cause(sentence, gain, True) for _, sentence, gain in lenses]
    causes += [Cause(sentence, gain) for sentence, gain in lens_warnings(inputs, assessed.estimate)]
    said = {(camera, name) for camera, *_ in lenses for name in LENS}
    # `scale_causes` has named the sizes already, such as wheel radii.
    sensors = inputs.rig.sensors.values() if scales else ()
    said |= {(s.name, name) for s in sensors for name in call_kind(s.sensor_type, "assess", "sizes", s) or ()}
    against = tuple(c for c in against if c.key not in said)
    causes += _contradicted(assessed, against, scale, certain or given, None if given else stated)
    return causes, (*notes, *scale_notes(inputs, size))


def _contradicted(
    assessed: AssessedEstimate, against: Sequence[Contradiction], scale: float, grave: bool, stated: Relaxed | None
) -> Iterator[Cause]:
    """A cause for each contradicted value in `against`, then for absurd values. scale: factor on formal standard
    deviations; grave: whether all of them are grave. stated: None if the gain is unknown, which counts as infinite."""
    for c in against:
        gain = np.inf if stated is None else float(((c.off / (c.sigma / scale)) ** 2).max())
        moves = stated is not None and _moves_others(assessed, stated, c.key)
        yield Cause(stated_words(assessed.inputs, c), gain, grave or moves)
    yield from (Cause(s, 0.0, grave) for s in absurd_values(assessed.inputs, against, assessed.groups))


def _moves_others(assessed: AssessedEstimate, stated: Relaxed, key: Key) -> bool:
    """Whether the stated value of the group `key` distorts the result: without it, a parameter of another group moves
    by more than SIGMAS printed standard deviations."""
    step, _ = stated.step([key])
    for g in assessed.groups:
        if g.columns is None or (g.sensor, g.name) == key or g.name in AUXILIARY:
            continue
        if (np.abs(step[stated.layout.columns(g.sensor, g.name)]) > SIGMAS * g.std).any():
            return True
    return False
