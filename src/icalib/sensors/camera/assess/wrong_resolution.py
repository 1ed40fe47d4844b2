"""Cameras whose resolution in the rig file is larger than their images."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.factor import of_type
from icalib.observability.cause import Cause
from icalib.result import ParameterGroup
from icalib.sensors.camera.assess.twin_lenses import observed
from icalib.sensors.camera.corner_factor import CornerFactor

# Principal point over the middle of the stated image. Lenses are centred to a tenth of the image; half the resolution
# (binning, or a scaled stream) gives 0.5.
OFF_CENTRE = 0.75
# Of twice the principal point: observations beyond it show that the image is larger, so that it was cropped.
BEYOND = 1.1
KNOWN = 0.02  # largest standard deviation of the principal point over the size of the image


def wrong_resolutions(inputs: Inputs, estimate: Estimate, groups: Sequence[ParameterGroup]) -> Iterator[Cause]:
    """A grave cause for each camera with a lens that is estimated, whose images seem to be smaller than stated."""
    lenses = {g.sensor: g for g in groups if g.name == "intrinsics" and g.mode != "fixed"}
    for camera, factor in zip(inputs.rig.cameras, of_type(estimate.problem.factors, CornerFactor), strict=True):
        uv, g = observed(estimate, factor), lenses.get(camera.name)
        if g is None or not len(uv):
            continue
        if (size := smaller_image(camera.resolution, g.value[2:4], g.std[2:4], uv)) is not None:
            stated, apparent = (f"{width} x {height}" for width, height in (camera.resolution, size))
            sentence = (
                f"the resolution of {camera.name} is wrong: its principal point and all observations are those of "
                f"images of about {apparent} px, not {stated}. Correct its resolution in the rig file."
            )
            yield Cause(sentence, np.inf, True)


def smaller_image(
    resolution: tuple[int, int], centre: np.ndarray, std: np.ndarray, uv: np.ndarray
) -> tuple[int, int] | None:
    """(width, height) px of the images that the data show, if they are smaller than `resolution`; else None.

    centre, std (2,): principal point and its standard deviations. uv (N, 2): all observations. Units are px."""
    stated, apparent = np.array(resolution), 2.0 * centre + 1.0
    small = (apparent < OFF_CENTRE * stated) & (std < KNOWN * stated) & (uv.max(axis=0) < BEYOND * apparent)
    if not small.any():
        return None
    width, height = np.where(small, apparent, stated).round().astype(int).tolist()
    return width, height
