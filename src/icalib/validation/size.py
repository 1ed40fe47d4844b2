"""The size of the target as the rig file states it, compared with the size by the accelerometer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.residual_statistics.target_size import TargetSize, target_size
from icalib.model.bodies import SIZE
from icalib.observability.cause import Cause
from icalib.result import ParameterGroup
from icalib.sensors import call_kind
from icalib.sensors.sensor import TRANSLATION

WRONG = 0.02  # relative error of the size: larger than that of a ruler or a good accelerometer
BEYOND = 0.05  # relative error of the size that no accelerometer explains: these are off by 3 % at most
CLEARLY = 5.0  # standard deviations
SCALE = "scale"  # name of the parameter that scales all lengths of a sensor, with the prior `scale_sigma`


def felt_size(estimate: Estimate, factor: float) -> TargetSize | None:
    """Ratio of the target's true size, by the accelerometer, to the stated one. `factor` multiplies its formal standard
    deviation. None if the size is unobservable, or if the solver did not converge."""
    if not estimate.outcome.converged:
        return None
    try:
        size = target_size(estimate.problem, estimate.outcome.state)
    except EstimationError:  # the problem cannot be solved at another size
        return None
    return None if size is None else TargetSize(size.ratio, factor * size.std)


def is_certain(size: TargetSize | None) -> bool:
    """Whether the size differs from the stated one by more than any error of an accelerometer."""
    return size is not None and abs(size.ratio - 1.0) > max(BEYOND, CLEARLY * size.std)


def size_words(inputs: Inputs, size: TargetSize | None) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Warnings, and notes, on the size of the target."""
    if size is None:
        return (), ()
    rig, digits = inputs.rig, max(2, 1 - int(np.floor(np.log10(size.std))))
    ratio = f"{size.ratio:.{digits}f} +- {size.std:.{digits}f}"
    others = any(not s.sees_target or getattr(s, TRANSLATION.name).mode != "free" for s in rig.mounted)
    by = "the accelerometer" + (" and what else shows it" if others else "")
    words = f"by {by} the target is {ratio} times the size that the rig file says"
    if abs(size.ratio - 1.0) <= max(WRONG, CLEARLY * size.std):
        return (), (f"{words}; accelerometers may be off by 1 to 3 % themselves.",)
    warning = (
        f"{words}, and so are the distances that cameras show; measure the printed target and correct its size in "
        "the rig file, or if that is right calibrate the accelerometer, whose scale is off."
    )
    return (warning,), ()


def scale_notes(inputs: Inputs, size: TargetSize | None) -> Iterator[str]:
    """A note if the scale of all lengths comes from a single source."""
    sources = scale_sources(inputs, size)
    if len(sources) == 1:
        yield f"every length comes from {sources[0]} alone: 1 % error there is 1 % in every length here."


def scale_sources(inputs: Inputs, size: TargetSize | None) -> list[str]:
    """Texts that name the sources of the metric scale. size: of the target by the accelerometer, None if
    unobservable."""
    rig = inputs.user_rig or inputs.rig
    target = rig.has_target and any(s.sees_target for s in rig.mounted)
    has_imu = rig.imu is not None and not rig.imu.assumed
    sources = ["the size of the target"] if target else []
    sensor_sources = (call_kind(sensor.sensor_type, "assess", "length", sensor, rig) for sensor in rig.mounted)
    sources += [source for source in sensor_sources if source]
    if has_imu and (size is not None or not target):
        sources.append("the accelerometer")
    return sources


def scale_causes(inputs: Inputs, groups: Sequence[ParameterGroup], size: TargetSize | None) -> Iterator[Cause]:
    """A cause if the size of the target and the scales of sensors contradict each other. Each is a factor with a prior
    about 1. The least-squares compromise moves all of them, so the contradiction is larger than any single deviation.
    It explains contradictions of all stated sizes, such as wheel radii."""
    sigmas = {SIZE: inputs.rig.target.size_sigma} if size is None else {}
    sensors = inputs.rig.sensors.values()
    sigmas |= {(s.name, SCALE): sigma for s in sensors if (sigma := getattr(s, "scale_sigma", 0.0)) > 0.0}
    off = {k: float(g.value[0]) - 1.0 for g in groups if (k := (g.sensor, g.name)) in sigmas and g.columns is not None}
    away = {key: abs(d) / sigmas[key] for key, d in off.items()}
    if max(away.values(), default=0.0) <= CLEARLY:
        return
    apart = 100.0 * float(np.ptp([0.0, *off.values()]))
    first, *others = scale_sources(inputs, size)
    more = " and ".join(others) or "what else shows a length"
    yield Cause(
        f"{first} and {more} contradict each other: lengths differ by {apart:.1f} % or more, "
        f"{max(away.values()):.0f} standard deviations of what the rig file allows; find out which is wrong, and "
        "correct it in the rig file.",
        float(sum(a**2 for a in away.values())),
        True,
        tuple((s.name, name) for s in sensors for name in call_kind(s.sensor_type, "assess", "sizes", s) or ()),
    )
