"""Warnings on fixed values and priors of the rig file that the data contradict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.estimate.problem.inputs import Inputs
from icalib.observability.contradictions import Contradiction
from icalib.result import ParameterGroup
from icalib.sensors import call_kind
from icalib.validation.looks_like import looks_like


def absurd_values(inputs: Inputs, against: Sequence[Contradiction], groups: Sequence[ParameterGroup]) -> Iterator[str]:
    """Sentences on sensors with impossible values, unless they contradict a stated value in `against`."""
    groups_by_key = {(g.sensor, g.name): g for g in groups}
    named = {c.key[0] for c in against}
    for sensor in inputs.rig.sensors.values():
        if sensor.name not in named:
            yield from call_kind(sensor.sensor_type, "assess", "absurd", sensor, groups_by_key) or ()


def stated_words(inputs: Inputs, c: Contradiction) -> str:
    """A sentence on the contradiction `c`: both values, their standard deviations and distance, and a likely
    mistake."""
    spec = inputs.specs[c.key]
    labels, (unit, scale) = spec.labels, spec.display_unit
    stated, unit = c.parameter.sigma, f" {unit}" if unit else ""
    sigma = scale * float(c.sigma[c.worst])
    allowed = "" if stated is None else f" +- {scale * np.broadcast_to(stated, c.off.shape)[c.worst]:.3g}{unit}"
    if c.key[1] == "rotation":
        angle, axis = scale * float(np.linalg.norm(c.off)), labels[c.worst]
        given = f"rotation of {c.key[0]}{allowed and f' ({allowed.strip()})'}"
        estimate_text = f"{angle:.3g}{unit} from it (+- {sigma:.2g}{unit} about {axis})"
    else:
        label = "" if len(labels) == 1 else f" {labels[c.worst]}"
        value = scale * np.broadcast_to(np.asarray(c.parameter.value), c.off.shape)[c.worst]
        given = f"{c.key[1].replace('_', ' ')}{label} of {c.key[0]}, {value:.6g}{allowed or unit},"
        estimate_text = f"{_rounded(scale * float(c.value[c.worst]), sigma)} +- {sigma:.2g}{unit}"
    kind, advice = ("fixed value", "leave it free") if stated is None else ("prior", "give it a larger sigma")
    assert c.parameter.value is not None
    hint = looks_like(inputs.rig, c.key, c.parameter.value, c.value)
    return (
        f"the {kind} of {given} contradicts the data, which alone show {estimate_text}: {c.away[c.worst]:.0f} standard "
        f"deviations away; correct it, or {advice}.{hint}"
    )


def scaled(values: np.ndarray, scale: float) -> str:
    """Text of the numbers `values` times `scale`, to four digits, in brackets if there are several."""
    texts = [f"{scale * v:.4g}" for v in values]
    return texts[0] if len(texts) == 1 else f"[{', '.join(texts)}]"


def _rounded(value: float, sigma: float) -> str:
    """Text of a value, with digits down to a tenth of its standard deviation."""
    digits = 1 - int(np.floor(np.log10(sigma))) if sigma > 0.0 else 6
    return f"{value:.{min(max(digits, 0), 12)}f}"
