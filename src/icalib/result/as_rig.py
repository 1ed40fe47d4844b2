"""The rig of a result, with its values as fixed values, priors or guesses: the start of the next calibration."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import numpy as np
import yaml

from icalib.errors import RigError
from icalib.result import Calibration, ParameterGroup
from icalib.rig import Rig, Settings
from icalib.rig.file import rig_from_dict, rig_to_dict
from icalib.sensors.parameter import Parameter

Treatment = Literal["fixed", "prior", "guess"]
TREATMENTS: tuple[Treatment, ...] = ("fixed", "prior", "guess")


def rig_of_result(c: Calibration, treatment: Treatment) -> tuple[Rig, tuple[str, ...]]:
    """The rig of `c`, and a sentence for each group whose value could not be taken as asked.

    fixed: everything that was estimated is fixed at its value. prior: it gets a prior of that mean and of the result's
    standard deviation. guess: what the rig file left free starts at its value; its priors stay. What the rig file fixed
    stays fixed. A value that the data did not determine never becomes fixed.
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
    """`rig_of_result` as the text of a rig file, and its sentences, which are comments in it, too."""
    rig, sentences = rig_of_result(c, treatment)
    plain = rig_to_dict(rig)
    defaults = dataclasses.asdict(Settings())
    settings = {name: value for name, value in plain.pop("settings").items() if value != defaults[name]}
    plain |= {"settings": settings} if settings else {}
    words = {"fixed": "are fixed", "prior": "have priors of its standard deviations", "guess": "are guesses"}
    said = [f"Rig file by icalib, from a result: its values {words[treatment]}.", *sentences]
    body = yaml.safe_dump(plain, sort_keys=False, default_flow_style=None, width=1000, allow_unicode=True)
    return "".join(f"# {sentence}\n" for sentence in said) + body, sentences


def _is_derived(sensor: Any, g: ParameterGroup) -> bool:
    """Whether the group is no field of the sensor, such as the height of wheels over the ground."""
    return g.name not in {f.name for f in dataclasses.fields(sensor)}


def _treated(g: ParameterGroup, old: Parameter, treatment: Treatment) -> tuple[Parameter, str]:
    if treatment == "guess":
        return (old if old.mode == "prior" else Parameter("free", g.value)), ""
    open_ = [label for label, v in zip(g.labels, g.verdict, strict=True) if v == "undetermined"]
    if treatment == "fixed" and open_:
        what = (
            f"{g.name.replace('_', ' ')} {', '.join(open_)}".rstrip() if len(g.labels) > 1 else g.name.replace("_", " ")
        )
        kept = old if old.mode == "prior" else Parameter("free", g.value)
        return kept, f"{g.sensor}: {what} was not determined by the data, so {g.name} is not fixed."
    if treatment == "fixed":
        return Parameter("fixed", g.value), ""
    if not (np.isfinite(g.std) & (g.std > 0.0)).all():
        return Parameter("free", g.value), f"{g.sensor}: {g.name} has no finite standard deviation, so it is a guess."
    return Parameter("prior", g.value, g.std), ""
