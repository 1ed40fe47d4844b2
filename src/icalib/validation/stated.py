"""Warnings of values that the rig file fixes or gives a prior, and that the data contradict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.estimate.problem.inputs import Inputs
from icalib.observability.contradictions import Contradiction
from icalib.result import ParameterGroup
from icalib.rig import Wheels
from icalib.validation.looks_like import looks_like

# Radii over baseline: from 1/15 of a floor robot to 1 of a toy; rates in rpm make 1/3 a 1/30.
SMALLEST_SHARE, LARGEST_SHARE = 1.0 / 25.0, 4.0


def absurd_wheels(inputs: Inputs, against: Sequence[Contradiction], groups: Sequence[ParameterGroup]) -> Iterator[str]:
    """One sentence for each set of wheels whose size cannot be, where it contradicts no stated value."""
    found = {(g.sensor, g.name): g for g in groups}
    named = {c.key[0] for c in against}
    for wheels in inputs.rig.wheels:
        if wheels.kind == "pair" and wheels.name not in named:
            yield from _absurd(wheels, found)


def stated_words(inputs: Inputs, c: Contradiction) -> str:
    """Both values, their standard deviations, how far apart they are, and what would explain it."""
    spec = inputs.specs[c.key]
    labels, (unit, scale) = spec.labels, spec.shown_unit
    stated, unit = c.parameter.sigma, f" {unit}" if unit else ""
    sigma = scale * float(c.sigma[c.worst])
    allowed = "" if stated is None else f" +- {scale * np.broadcast_to(stated, c.off.shape)[c.worst]:.3g}{unit}"
    if c.key[1] == "rotation":
        angle, axis = scale * float(np.linalg.norm(c.off)), labels[c.worst]
        given = f"rotation of {c.key[0]}{allowed and f' ({allowed.strip()})'}"
        shown = f"{angle:.3g}{unit} from it (+- {sigma:.2g}{unit} about {axis})"
    else:
        label = "" if len(labels) == 1 else f" {labels[c.worst]}"
        value = scale * np.broadcast_to(np.asarray(c.parameter.value), c.off.shape)[c.worst]
        given = f"{c.key[1].replace('_', ' ')}{label} of {c.key[0]}, {value:.6g}{allowed or unit},"
        shown = f"{_rounded(scale * float(c.found[c.worst]), sigma)} +- {sigma:.2g}{unit}"
    kind, advice = ("fixed value", "leave it free") if stated is None else ("prior", "give it a larger sigma")
    assert c.parameter.value is not None
    hint = looks_like(inputs.rig, c.key, c.parameter.value, c.found)
    return (
        f"the {kind} of {given} contradicts the data, which alone show {shown}: {c.away[c.worst]:.0f} standard "
        f"deviations away; correct it, or {advice}.{hint}"
    )


def scaled(values: np.ndarray, scale: float) -> str:
    """Numbers in brackets, or one alone, to four digits."""
    shown = [f"{scale * v:.4g}" for v in values]
    return shown[0] if len(shown) == 1 else f"[{', '.join(shown)}]"


def _rounded(value: float, sigma: float) -> str:
    """To a tenth of its standard deviation."""
    digits = 1 - int(np.floor(np.log10(sigma))) if sigma > 0.0 else 6
    return f"{value:.{min(max(digits, 0), 12)}f}"


def _absurd(wheels: Wheels, found: dict[tuple[str, str], ParameterGroup]) -> Iterator[str]:
    """Wheels that are tiny or huge beside what is between them: readings in another unit."""
    radii, baseline = found.get((wheels.name, "radii")), found.get((wheels.name, "baseline"))
    if radii is None or baseline is None:
        return
    share = float(radii.value.mean() / baseline.value[0])
    if SMALLEST_SHARE < share < LARGEST_SHARE:
        return
    cause = {"ticks": "its counts_per_turn", "rates": "its rate_unit"}.get(
        wheels.measures, "whether its angles are in radians"
    )
    yield (
        f"the wheels of {wheels.name} come out with a radius of {1e3 * radii.value.mean():.3g} mm and "
        f"{1e3 * baseline.value[0]:.4g} mm between them, which no vehicle has; check {cause}."
    )
