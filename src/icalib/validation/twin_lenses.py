"""Names a second set of parameters that describes the same lens.

Some models reach the same image from two sets of parameters: double-sphere from different pairs of xi and alpha.
Standard deviations describe the surroundings of one set, and say nothing of the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.cameras.convert import fit_rays
from icalib.motion.factor import of_type
from icalib.result import SensorFit
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.camera.features.residual import FeatureFactor

MOST_POINTS = 400  # that lenses are compared at
OTHER_FOCAL = 0.02  # of the focal length: sets that differ by less are one
MOST_CHI2 = 16.0  # between two lenses, four standard deviations: noise causes less


def twin_lens_notes(inputs: Inputs, found: Estimate, fits: Sequence[SensorFit]) -> Iterator[str]:
    """One sentence for each camera whose observations fit another set of parameters as well."""
    for camera, factor in zip(inputs.rig.cameras, of_type(found.problem.factors, CornerFactor), strict=True):
        fit = next((f for f in fits if f.sensor == camera.name and f.unit == "px" and f.rms), None)
        if camera.intrinsics.mode == "fixed" or camera.distortion.mode == "fixed" or fit is None or not fit.rms:
            continue
        lens, uv = factor.lens(found.outcome.state), _observed(found, factor)
        # Half of the numbers of a fit are rows of u, and chi^2 sums over both coordinates.
        limit = fit.rms * np.sqrt(MOST_CHI2 / max(0.5 * fit.count, 1.0))
        twin = twin_lens(factor.model, lens, uv, float(limit))
        if twin is not None:
            numbers = ", ".join(f"{n} {x:.4g}" for n, x in zip(factor.model.parameter_names, twin, strict=True))
            yield (
                f"{camera.name}: the images fit a second set of parameters of {factor.model.name} as well: {numbers}. "
                "Both are the same lens within the noise; use the parameters of one set together."
            )


def twin_lens(model: CameraModel, lens: np.ndarray, uv: np.ndarray, limit_px: float) -> np.ndarray | None:
    """(P,) the nearest other set of parameters that projects the rays of uv (N, 2) px to within `limit_px` RMS of where
    `lens` (P,) does; None where there is none."""
    uv = uv[:: max(1, len(uv) // MOST_POINTS)]
    rays, valid = model.unproject(lens, uv)
    rays, uv, best = rays[valid], uv[valid], (limit_px, None)
    for distortion in model.start_distortions if len(rays) > len(lens) else ():
        start = np.array([*lens[:4], *distortion])
        start[:2] *= model.central_scale(lens) / model.central_scale(start)
        if 2 * model.project(start, rays)[1].sum() < len(rays):
            continue
        with suppress(np.linalg.LinAlgError):
            other = fit_rays(model, start, rays, uv, 1e-3)
            there, seen = model.project(other, rays)
            apart = float(np.sqrt(((there - uv) ** 2).sum(axis=1).mean())) if seen.all() else np.inf
            if apart < best[0] and abs(other[0] / lens[0] - 1.0) > OTHER_FOCAL:
                best = apart, other
    return best[1]


def _observed(found: Estimate, factor: CornerFactor) -> np.ndarray:
    """(N, 2) px: corners and tracked points of a camera."""
    features = of_type(found.problem.factors, FeatureFactor)
    pairs = [pair for f in features for pair in zip(f.streams, f.keep, strict=True)]
    own = [s.uv[k] for s, k in pairs if s.name == factor.name]
    return np.concatenate([factor.stream.uv, *own])
