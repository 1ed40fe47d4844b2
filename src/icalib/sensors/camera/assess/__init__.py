"""Assessment of cameras: what a result keeps and says of them, and causes of a wrong result that lie in them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.motion.time_offsets import instants
from icalib.observability.cause import Cause
from icalib.observability.relaxed import Relaxed
from icalib.optim.state import State
from icalib.result import ParameterGroup
from icalib.rig import Camera, Rig
from icalib.sensors.camera.assess.exposure_lag import clock_causes
from icalib.sensors.camera.assess.fit_warnings import many_rejected, misfit, overstated_noise, unreliable, warnings
from icalib.sensors.camera.assess.fixed_lens import wrong_lenses
from icalib.sensors.camera.assess.lens_guess import is_far_guess
from icalib.sensors.camera.assess.lens_models import wrong_models
from icalib.sensors.camera.assess.observation_notes import notes
from icalib.sensors.camera.assess.residual_records import residuals
from icalib.sensors.camera.assess.swapped import swapped_cameras
from icalib.sensors.camera.assess.twin_lenses import ambiguities
from icalib.sensors.camera.assess.wrong_resolution import wrong_resolutions
from icalib.sensors.camera.spec import BLOOM

__all__ = [
    "ambiguities",
    "causes",
    "clock_causes",
    "is_far_guess",
    "keyframe_instants",
    "length",
    "many_rejected",
    "misfit",
    "notes",
    "overstated_noise",
    "residuals",
    "unreliable",
    "value_warnings",
    "warnings",
]

LARGE_BLOOM_PX = 0.8  # px; a warning above it: ink and overexposure shift edges by about a third of it


def causes(
    inputs: Inputs, estimate: Estimate, groups: Sequence[ParameterGroup], factor: float, relaxed_rig: Relaxed | None
) -> Iterator[Cause]:
    """Cameras that are swapped, wrong resolutions, fixed intrinsics of another camera, and camera models that do not
    follow the lens.

    factor: the largest empirical factor, which multiplies formal standard deviations. relaxed_rig: None omits the test
    of fixed intrinsics.
    """
    yield from swapped_cameras(inputs.rig.cameras, groups)
    yield from wrong_resolutions(inputs, estimate, groups)
    yield from wrong_lenses(inputs, relaxed_rig, factor)
    yield from wrong_models(inputs, estimate)


def keyframe_instants(inputs: Inputs, state: State) -> Iterator[tuple[str, np.ndarray]]:
    """Stream key and instants (M,) of the images of each camera, s on the body's clock since its first stamp."""
    yield from ((c.key, instants(c, state.values)) for c in inputs.measurements.cameras)


def value_warnings(groups: Sequence[ParameterGroup]) -> Iterator[str]:
    """A sentence for each camera whose edge bloom is too large for overexposure or ink."""
    for g in groups:
        if g.name == BLOOM.name and abs(g.value[0]) > LARGE_BLOOM_PX:
            where = "in" if g.value[0] > 0.0 else "out"
            yield (
                f"the corners of {g.sensor} lie {abs(g.value[0]):.1f} px too far {where} on their tags, more than "
                "light and ink do; check tag_size and tag_spacing (the gap over tag_size) of the target."
            )


def length(camera: Camera, rig: Rig) -> str | None:
    """Text that names the camera's translation as the source of scale, if it is fixed or has a prior, and is not zero.

    Else None, as for the reference camera."""
    p = camera.translation
    stated = camera.name != rig.reference and p.mode != "free" and p.value is not None and bool(np.any(p.value))
    return f"the stated translation of {camera.name}" if stated else None
