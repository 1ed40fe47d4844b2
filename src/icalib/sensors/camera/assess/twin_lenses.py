"""Finds a second set of parameters that describes the same lens.

Some models project alike with two sets of parameters: double-sphere has different pairs of xi and alpha. Standard
deviations hold only near one set.
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

MOST_POINTS = 400  # image points at which two lenses are compared
OTHER_FOCAL = 0.02  # relative difference of fx: sets that differ by less count as one
MOST_CHI2 = 16.0  # sum over all observations of the squared difference over the noise: four standard deviations


def ambiguities(inputs: Inputs, estimate: Estimate, fits: Sequence[SensorFit]) -> Iterator[str]:
    """One sentence for each camera whose observations fit another set of parameters as well."""
    for camera, factor in zip(inputs.rig.cameras, of_type(estimate.problem.factors, CornerFactor), strict=True):
        fit = next((f for f in fits if f.sensor == camera.name and f.unit == "px" and f.rms), None)
        if camera.intrinsics.mode == "fixed" or camera.distortion.mode == "fixed" or fit is None or not fit.rms:
            continue
        lens, uv = factor.lens(estimate.outcome.state), observed(estimate, factor)
        # `count` counts both coordinates of each point; `rms` is that of one coordinate.
        limit = fit.rms * np.sqrt(MOST_CHI2 / max(0.5 * fit.count, 1.0))
        twin = twin_lens(factor.model, lens, uv, float(limit))
        if twin is not None:
            numbers = ", ".join(f"{n} {x:.4g}" for n, x in zip(factor.model.parameter_names, twin, strict=True))
            yield (
                f"{camera.name}: the images fit a second set of parameters of {factor.model.name} as well: {numbers}. "
                "Both are the same lens within the noise; use the parameters of one set together."
            )


def twin_lens(model: CameraModel, lens: np.ndarray, uv: np.ndarray, limit_px: float) -> np.ndarray | None:
    """(P,) the other set of parameters that projects most like `lens` (P,). None if all differ by more than `limit_px`
    RMS [px] at uv (N, 2) px."""
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
            other_uv, is_projected = model.project(other, rays)
            apart = float(np.sqrt(((other_uv - uv) ** 2).sum(axis=1).mean())) if is_projected.all() else np.inf
            if apart < best[0] and abs(other[0] / lens[0] - 1.0) > OTHER_FOCAL:
                best = apart, other
    return best[1]


def observed(estimate: Estimate, factor: CornerFactor) -> np.ndarray:
    """(N, 2) px: detected corners and used tracked points of a camera."""
    features = of_type(estimate.problem.factors, FeatureFactor)
    pairs = [pair for f in features for pair in zip(f.streams, f.keep, strict=True)]
    tracked_uv = [s.uv[k] for s, k in pairs if s.name == factor.name]
    return np.concatenate([factor.stream.uv, *tracked_uv])
