"""Converts a result to a rig for the next calibration: the values become fixed values, priors or initial guesses."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import numpy as np
import yaml

from icalib.errors import RigError
from icalib.result import Calibration, ParameterGroup
from icalib.result.verdict import UNUSABLE
from icalib.rig import Rig, Settings
from icalib.rig.file import rig_from_dict, rig_to_dict
from icalib.sensors.parameter import Parameter

Treatment = Literal["fixed", "prior", "guess"]
TREATMENTS: tuple[Treatment, ...] = ("fixed", "prior", "guess")


def rig_of_result(c: Calibration, treatment: Treatment) -> tuple[Rig, tuple[str, ...]]:
    """The rig of `c` with the values of the result, and a sentence for each group that could not be treated as asked.

    fixed: all estimated groups are fixed at their values. prior: all estimated groups get priors with their values as
    means and the standard deviations of the result. guess: groups that were free in the rig file start at their values;
    priors of the rig file stay. Groups that the rig file fixed stay fixed. A group with an unusable component is
    never fixed. Raises RigError if `treatment` is none of these.
    """
    if treatment not in TREATMENTS:
        raise RigError(f"values of a result become {', '.join(TREATMENTS)}, not {treatment!r}; use one of these.")
    rig, sentences = rig_from_dict(c.rig, "the rig of the result"), []
    for sensor in rig.sensors.values():
        fields: dict[str, Any] = {}
        for g in c.groups:
            old = getattr(sensor, g.name, None)
            if g.sensor != sensor.name or g.columns is None or not isinstance(old, Parameter) or _is_derived(sensor, g):
                continue
            if g.name == "time_offset" and len(g.value) > 1:
                sentences.append(f"{g.sensor}: each recording has a time offset of its own, so time_offset stays free.")
                continue
            fields[g.name], sentence = _treated(g, old, treatment)
            sentences += [sentence] if sentence else []
        rig = rig.with_(sensor.name, **fields)
    return rig, tuple(sentences)


def rig_text(c: Calibration, treatment: Treatment) -> tuple[str, tuple[str, ...]]:
    """The rig of `rig_of_result` as text of a rig file, with the sentences as comments; and the sentences."""
    rig, sentences = rig_of_result(c, treatment)
    plain = rig_to_dict(rig)
    defaults = dataclasses.asdict(Settings())
    settings = {name: value for name, value in plain.pop("settings").items() if value != defaults[name]}
    plain |= {"settings": settings} if settings else {}
    words = {"fixed": "are fixed", "prior": "have priors of its standard deviations", "guess": "are guesses"}
    comments = [f"Rig file by icalib, from a result: its values {words[treatment]}.", *sentences]
    body = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)
    return "".join(f"# {sentence}\n" for sentence in comments) + body, sentences


def _is_derived(sensor: Any, g: ParameterGroup) -> bool:
    """Whether the group is not a field of the sensor in the rig file, such as the height of wheels over the ground."""
    return g.name not in {f.name for f in dataclasses.fields(sensor)}


def _treated(g: ParameterGroup, old: Parameter, treatment: Treatment) -> tuple[Parameter, str]:
    """The parameter for the new rig file, and a sentence if it is not treated as asked, else an empty string. `old`:
    the parameter in the rig file."""
    if treatment == "guess":
        return (old if old.mode == "prior" else Parameter("free", g.value)), ""
    labels = ["it"] if len(g.labels) == 1 else g.labels
    unusable = [f"{label} is {v}" for label, v in zip(labels, g.verdict, strict=True) if v in UNUSABLE]
    if treatment == "fixed" and unusable:
        kept = old if old.mode == "prior" else Parameter("free", g.value)
        return kept, f"{g.sensor}: {g.name} is not fixed, because {', '.join(unusable)}."
    if treatment == "fixed":
        return Parameter("fixed", g.value), ""
    if not (np.isfinite(g.std) & (g.std > 0.0)).all():
        return Parameter("free", g.value), f"{g.sensor}: {g.name} has no finite standard deviation, so it is a guess."
    return Parameter("prior", g.value, g.std), ""
