"""Where intrinsics that the rig file fixes would go if they were free: whether they are those of this camera.

The other parameters make up for much of what is wrong with a lens: with the intrinsics of the other camera of a stereo
pair, 13 px apart, corners may fit to 0.4 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.estimate.problem.inputs import Inputs
from icalib.observability.relaxed import Relaxed
from icalib.rig import LENS


@dataclass(frozen=True)
class LensStep:
    """Of a camera's fx, fy, cx, cy [px] from what the rig file fixes: where they would go, and its formal standard
    deviation."""

    camera: str
    step: np.ndarray
    std: np.ndarray


def lens_steps(inputs: Inputs, stated: Relaxed | None) -> tuple[LensStep, ...]:
    """Of all cameras whose intrinsics are fixed, with all of their lenses free; none where the data do not say where
    these would go. `stated`: see `relaxed`."""
    fixed = [c for c in inputs.rig.cameras if c.intrinsics.mode == "fixed"]
    if not fixed or stated is None:
        return ()
    step, std = stated.step([(c.name, name) for c in fixed for name in LENS if getattr(c, name).mode == "fixed"])
    columns = [stated.layout.columns(c.name, "intrinsics") for c in fixed]
    return tuple(LensStep(c.name, step[k], std[k]) for c, k in zip(fixed, columns, strict=True))
