"""Tests whether intrinsics that the rig file fixes are those of this camera, by where they would go if free.

Residuals alone do not show it, because the other parameters absorb much of a lens error. With the intrinsics of the
other camera of a stereo pair, 13 px different, corners may fit to 0.4 px.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from icalib.estimate.problem.inputs import Inputs
from icalib.observability.cause import Cause
from icalib.observability.relaxed import Relaxed
from icalib.rig import LENS

OTHER_LENS, CLEARLY = 0.015, 3.0  # least change of an intrinsic parameter: relative to fx, and in standard deviations
NEARER = 0.5  # ratio of the largest differences in fx, fy, cx, cy [px], below which another camera is named


@dataclass(frozen=True)
class _LensStep:
    """step (4,): change of fx, fy, cx, cy [px] from their fixed values to those of the data; std (4,): its formal
    standard deviation [px]."""

    camera: str
    step: np.ndarray
    std: np.ndarray


def wrong_lenses(inputs: Inputs, relaxed_rig: Relaxed | None, factor: float) -> Iterator[Cause]:
    """Cameras whose fixed intrinsics contradict the data, with the gain in chi^2 if they are free.

    factor: the largest empirical factor, which multiplies formal standard deviations. relaxed_rig: see `relaxed`;
    nothing is tested if it is None.
    """
    given = {c.name: c.intrinsics.value for c in inputs.rig.cameras}
    for lens_step in _lens_steps(inputs, relaxed_rig):
        value = given[lens_step.camera]
        assert value is not None
        off = np.abs(lens_step.step)
        clearly = off > np.maximum(OTHER_LENS * value[0], CLEARLY * factor * lens_step.std)
        if clearly.any():
            where = ", ".join(
                f"{name} {old + step:.1f} and not {old:.1f}"
                for name, old, step, far in zip(("fx", "fy", "cx", "cy"), value, lens_step.step, clearly, strict=True)
                if far
            )
            nearer = [
                n
                for n, v in given.items()
                if v is not None and max(abs(value + lens_step.step - v)) < NEARER * max(off)
            ]
            hint = f" Those of {nearer[0]} are nearer." if nearer else ""
            sentence = (
                f"the intrinsics of {lens_step.camera} that the rig file fixes do not fit its images, which want "
                f"{where}: check that they are this camera's, at this resolution, or leave them free.{hint}"
            )
            gain = float(((lens_step.step / lens_step.std) ** 2).max())
            yield Cause(sentence, gain, True, tuple((lens_step.camera, name) for name in LENS))


def _lens_steps(inputs: Inputs, relaxed_rig: Relaxed | None) -> tuple[_LensStep, ...]:
    """Steps of all cameras whose intrinsics are fixed, with the fixed lens parameters of all of them free. Empty if
    `relaxed_rig` is None."""
    fixed = [c for c in inputs.rig.cameras if c.intrinsics.mode == "fixed"]
    if not fixed or relaxed_rig is None:
        return ()
    step, std = relaxed_rig.step([(c.name, name) for c in fixed for name in LENS if getattr(c, name).mode == "fixed"])
    columns = [relaxed_rig.layout.columns(c.name, "intrinsics") for c in fixed]
    return tuple(_LensStep(c.name, step[k], std[k]) for c, k in zip(fixed, columns, strict=True))
