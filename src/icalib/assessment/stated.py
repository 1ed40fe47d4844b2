"""Warnings of values that the rig file fixes or gives a prior, and that the data contradict."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.calibration import ParameterGroup
from icalib.estimation.contradictions import Contradiction
from icalib.estimation.inputs import Inputs
from icalib.rig import Rig, Wheels

SHOWN_UNITS = {"rad": ("deg", 180.0 / np.pi), "m": ("mm", 1e3), "s": ("ms", 1e3)}
NEARLY = 0.1  # of a ratio that is that of two units
# The true value over the stated one, where the rig file or the readings are in another unit.
LENGTHS = {1e-3: "metres, not millimetres", 1e-2: "metres, not centimetres", 0.0254: "metres, not inches"}
RATES = {np.pi / 30.0: "rpm", np.pi / 180.0: "deg/s", 2.0 * np.pi: "turns per second"}
# Radii over baseline: from 1/15 of a floor robot to 1 of a toy; rates in rpm make 1/3 a 1/30.
SMALLEST_SHARE, LARGEST_SHARE = 1.0 / 25.0, 4.0


def stated_warnings(
    inputs: Inputs, against: Sequence[Contradiction], groups: Sequence[ParameterGroup]
) -> Iterator[str]:
    """One sentence for each group that is contradicted, and for wheels whose size cannot be."""
    found = {(g.sensor, g.name): g for g in groups}
    for c in against:
        yield _sentence(c, found[c.key]) + _hint(inputs.rig, c)
    named = {c.key[0] for c in against}
    for wheels in inputs.rig.wheels:
        if wheels.kind == "pair" and wheels.name not in named:
            yield from _absurd(wheels, found)


def _sentence(c: Contradiction, group: ParameterGroup) -> str:
    """Both values, their standard deviations, and how far apart they are."""
    unit, scale = SHOWN_UNITS.get(group.unit, (group.unit, 1.0))
    stated, unit = c.parameter.sigma, f" {unit}" if unit else ""
    sigma = scale * float(c.sigma[c.worst])
    allowed = "" if stated is None else f" +- {scale * np.broadcast_to(stated, c.off.shape)[c.worst]:.3g}{unit}"
    if c.key[1] == "rotation":
        angle, axis = scale * float(np.linalg.norm(c.off)), group.labels[c.worst]
        given = f"rotation of {c.key[0]}{allowed and f' ({allowed.strip()})'}"
        shown = f"{angle:.3g}{unit} from it (+- {sigma:.2g}{unit} about {axis})"
    else:
        label = "" if len(group.labels) == 1 else f" {group.labels[c.worst]}"
        value = scale * np.broadcast_to(np.asarray(c.parameter.value), c.off.shape)[c.worst]
        given = f"{c.key[1].replace('_', ' ')}{label} of {c.key[0]}, {value:.6g}{allowed or unit},"
        shown = f"{_rounded(scale * float(c.found[c.worst]), sigma)} +- {sigma:.2g}{unit}"
    kind, advice = ("fixed value", "leave it free") if stated is None else ("prior", "give it a larger sigma")
    return (
        f"the {kind} of {given} contradicts the data, which alone show {shown}: {c.away[c.worst]:.0f} standard "
        f"deviations away; correct it, or {advice}."
    )


def _rounded(value: float, sigma: float) -> str:
    """To a tenth of its standard deviation."""
    digits = 1 - int(np.floor(np.log10(sigma))) if sigma > 0.0 else 6
    return f"{value:.{min(max(digits, 0), 12)}f}"


def _hint(rig: Rig, c: Contradiction) -> str:
    """What would explain the ratio of lengths of wheels, or nothing."""
    wheels = next((w for w in rig.wheels if w.name == c.key[0]), None)
    if wheels is None or c.key[1] not in ("radii", "radius", "baseline", "wheelbase"):
        return ""
    assert c.parameter.value is not None
    ratio = float(np.median(c.found / c.parameter.value))
    near = {words: size for size, words in LENGTHS.items() if abs(ratio / size - 1.0) < NEARLY}
    if near:
        return f" It must be in {next(iter(near))}."
    if c.key[1] not in ("radii", "radius"):
        return ""
    if abs(ratio / 0.5 - 1.0) < NEARLY:
        return " It must be a radius, not a diameter."
    if wheels.measures == "ticks" and wheels.counts_per_turn is not None:
        return f" With it counts_per_turn would be {wheels.counts_per_turn / ratio:.0f}."
    units = [words for size, words in RATES.items() if abs(ratio / size - 1.0) < NEARLY]
    return f" Its readings look like {units[0]}; they must be in rad/s." if units else ""


def _absurd(wheels: Wheels, found: dict[tuple[str, str], ParameterGroup]) -> Iterator[str]:
    """Wheels that are tiny or huge beside what is between them: readings in another unit."""
    radii, baseline = found.get((wheels.name, "radii")), found.get((wheels.name, "baseline"))
    if radii is None or baseline is None:
        return
    share = float(radii.value.mean() / baseline.value[0])
    if SMALLEST_SHARE < share < LARGEST_SHARE:
        return
    cause = "its counts_per_turn" if wheels.measures == "ticks" else "whether its readings are in radians"
    yield (
        f"the wheels of {wheels.name} come out with a radius of {1e3 * radii.value.mean():.3g} mm and "
        f"{1e3 * baseline.value[0]:.4g} mm between them, which no vehicle has; check {cause}."
    )
