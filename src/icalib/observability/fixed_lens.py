"""Tests whether intrinsics that the rig file fixes are those of this camera, by where they would go if free.

Residuals alone do not show it, because the other parameters absorb much of a lens error. With the intrinsics of the
other camera of a stereo pair, 13 px different, corners may fit to 0.4 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.estimate.problem.inputs import Inputs
from icalib.observability.relaxed import Relaxed
from icalib.rig import LENS


@dataclass(frozen=True)
class LensStep:
    """step (4,): change of fx, fy, cx, cy [px] from their fixed values to those of the data; std (4,): its formal
    standard deviation [px]."""

    camera: str
    step: np.ndarray
    std: np.ndarray


def lens_steps(inputs: Inputs, stated: Relaxed | None) -> tuple[LensStep, ...]:
    """Steps of all cameras whose intrinsics are fixed, with the fixed lens parameters of all of them free. Empty if
    `stated` is None, see `relaxed`."""
    fixed = [c for c in inputs.rig.cameras if c.intrinsics.mode == "fixed"]
    if not fixed or stated is None:
        return ()
    step, std = stated.step([(c.name, name) for c in fixed for name in LENS if getattr(c, name).mode == "fixed"])
    columns = [stated.layout.columns(c.name, "intrinsics") for c in fixed]
    return tuple(LensStep(c.name, step[k], std[k]) for c, k in zip(fixed, columns, strict=True))
