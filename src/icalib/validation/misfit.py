"""Causes and warnings for residuals that differ from the stated noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.noise_size import are_noise, fitting_noise
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.residual_statistics.fit_statistics import rows_of
from icalib.observability.cause import Cause
from icalib.result import CrossValidation, SensorFit
from icalib.result.excess import FAR_BEYOND, excess, is_small, ratio, times
from icalib.rig import Rig
from icalib.sensors import call_all_kinds, facet
from icalib.validation.causes import INERTIAL, Misfit, noise_words, unknown_words

LARGE_FACTOR = 3.0  # empirical factor; a warning above it
BEYOND_FACTOR = 1.5  # times the largest empirical factor; a warning if the cross-validation factor is above it


def misfit_causes(
    inputs: Inputs, estimate: Estimate, sensor_fits: Sequence[SensorFit], explained: bool
) -> Iterator[Cause]:
    """Causes of the misfit: rejected outliers, the noise of the IMU, stated noise of other sensors, or unknown.
    explained: whether a named cause explains the misfit; then one sentence states the residuals."""
    yield from (Cause(sentence, 0.0) for sentence in call_all_kinds("assess", "many_rejected", sensor_fits))
    misfit = Misfit.of(sensor_fits)
    if explained:
        if misfit.fits:
            yield Cause(f"residuals are larger than the stated noise predicts: {misfit.words}.", 0.0)
        return
    yield from _of_imu(inputs, estimate, sensor_fits, misfit)
    for f in sensor_fits:
        if sentence := misfit_words(inputs.rig, f, _is_noise(estimate, f)):
            yield Cause(sentence, max(f.chi2 - f.dof, 0.0), excess(f) >= FAR_BEYOND)


def misfit_words(rig: Rig, f: SensorFit, is_noise: bool) -> str | None:
    """A sentence on residuals of one sensor that contradict the rig file; None if they do not. is_noise: whether they
    are white and constant over the recording; only then a larger noise is advised."""
    sensor = rig.sensors.get(f.sensor)
    if sensor is None:
        return None
    assess_facet = facet(sensor.sensor_type, "assess")
    if hasattr(assess_facet, "misfit"):
        return assess_facet.misfit(sensor, f, is_noise)
    if excess(f) == 1.0:
        return None
    advice = "state a larger one" if is_noise else "they are no white noise, so check its clock and its mount"
    return f"{f.kind} residuals of {f.sensor} are {times(f)} larger than its stated noise predicts; {advice}."


def _of_imu(inputs: Inputs, estimate: Estimate, sensor_fits: Sequence[SensorFit], misfit: Misfit) -> Iterator[Cause]:
    """Causes for residuals of the IMU that are too large or too small. Another noise is advised only if the residuals,
    weighted by it, are white and constant over the recording."""
    imu_fits = [f for f in sensor_fits if f.kind in INERTIAL]
    large, small = any(excess(f) > 1.0 for f in imu_fits), [f for f in imu_fits if is_small(f)]
    if not (large or small) or inputs.rig.imu is None:
        return
    overstated = tuple(call_all_kinds("assess", "overstated_noise", inputs.rig, sensor_fits))
    if overstated and not large:  # the trajectory then follows the IMU, and its residuals become small
        yield from (Cause(sentence, 0.0) for sentence in overstated)
        return
    noise = fitting_noise(inputs, estimate) if estimate.outcome.converged else None
    if noise is not None and noise.is_as_stated and noise.explains:
        return  # wrong noise of another sensor causes the misfit of the IMU
    if large and noise is not None and noise.explains:
        yield Cause(noise_words(inputs, noise), Misfit.of(imu_fits).chi2, Misfit.of(imu_fits).is_grave)
    elif large:
        yield Cause(unknown_words(misfit, noise), misfit.chi2, misfit.is_grave)
    elif noise is not None and noise.explains:
        yield Cause(noise_words(inputs, noise), 0.0)
    else:
        sizes = " and ".join(f"{f.kind} {ratio(f):.2g}x" for f in small)
        yield Cause(
            f"residuals of {inputs.rig.imu.name} are smaller than the stated noise predicts ({sizes}); standard "
            "deviations are too large, if anything.",
            0.0,
        )


def _is_noise(estimate: Estimate, f: SensorFit) -> bool:
    """Whether the residuals of `f` are white and constant over the recording."""
    rows = rows_of(estimate.outcome, f.sensor, f.kind)
    return rows is not None and are_noise(rows.weighted)


def scatter_warnings(factors: np.ndarray, split: bool, validation: CrossValidation | None) -> Iterator[str]:
    """Warnings on the scatter of estimates from segments. factors (n,): empirical factors of the sensors' parameters;
    split: whether the recording was cut into segments; validation: result of the cross-validation."""
    if len(factors) and factors.max() > LARGE_FACTOR:
        yield (
            f"estimates from segments of the recording scatter {factors.max():.1f}x more than predicted; the printed "
            "standard deviations are inflated accordingly."
        )
    if (
        validation is not None
        and len(factors)
        and validation.optimistic
        and validation.factor > BEYOND_FACTOR * factors.max()
    ):
        yield (
            f"one half of the recording predicts the other {validation.factor:.1f}x worse than predicted, and the "
            f"printed standard deviations are only {factors.max():.1f}x the formal ones: they are too small."
        )
    if not split:
        yield (
            "the recording is too short for segments (or segments are off): standard deviations are formal and too "
            "small, as they include white noise only. Record longer."
        )
