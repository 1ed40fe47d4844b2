"""Causes and warnings for residuals that differ from the stated noise."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.noise_size import are_noise, fitting_noise
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.residual_statistics.fit_statistics import rows_of
from icalib.result import CrossValidation, SensorFit
from icalib.result.excess import FAR_BEYOND, dof_known, excess, times
from icalib.rig import Rig
from icalib.sensors import facet
from icalib.sensors.camera.assess import rejected_words
from icalib.validation.causes import INERTIAL, Cause, Misfit, noise_words, unknown_words

SMALL_CHI2 = 0.5  # chi^2 per post-fit degree of freedom; a warning below it
LARGE_FACTOR = 3.0  # empirical factor; a warning above it
BEYOND_FACTOR = 1.5  # times the largest empirical factor; a warning if the cross-validation factor is above it


def misfit_causes(
    inputs: Inputs, estimate: Estimate, sensor_fits: Sequence[SensorFit], explained: bool
) -> Iterator[Cause]:
    """Causes of the misfit: rejected outliers, the noise of the IMU, stated noise of other sensors, or unknown.
    explained: whether a named cause explains the misfit; then one sentence states the residuals."""
    for f in sensor_fits:
        if sentence := rejected_words(f):
            yield Cause(sentence, 0.0)
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
    large, small = any(excess(f) > 1.0 for f in imu_fits), [f for f in imu_fits if _is_small(f)]
    if not (large or small) or inputs.rig.imu is None:
        return
    corners = _loose_corners(inputs, sensor_fits)
    if corners and not large:
        yield Cause(_corners_words(corners), 0.0)
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
        sizes = " and ".join(f"{f.kind} {_times(f):.2g}x" for f in small)
        yield Cause(
            f"residuals of {inputs.rig.imu.name} are smaller than the stated noise predicts ({sizes}); standard "
            "deviations are too large, if anything.",
            0.0,
        )


def _loose_corners(inputs: Inputs, sensor_fits: Sequence[SensorFit]) -> list[SensorFit]:
    """Cameras whose stated corner noise is too large. The trajectory then follows the IMU, and its residuals become
    small, too."""
    stated = {c.name for c in inputs.rig.cameras if c.corner_noise_px is not None}
    return [f for f in sensor_fits if f.kind == "corners" and f.sensor in stated and _is_small(f)]


def _corners_words(corners: list[SensorFit]) -> str:
    """A sentence that the stated corner noise is too large."""
    sizes = " and ".join(f"{f.sensor} {_times(f):.2g}x" for f in corners)
    return (
        f"residuals of corners are smaller than corner_noise predicts ({sizes}); standard deviations are too large. "
        "Leave corner_noise out, and it is estimated."
    )


def _times(f: SensorFit) -> float:
    """Ratio of residuals to the stated noise."""
    return float(np.sqrt(max(f.chi2, 0.0) / f.dof))


def _is_noise(estimate: Estimate, f: SensorFit) -> bool:
    """Whether the residuals of `f` are white and constant over the recording."""
    rows = rows_of(estimate.outcome, f.sensor, f.kind)
    return rows is not None and are_noise(rows.weighted)


def _is_small(f: SensorFit) -> bool:
    """Whether the residuals are much smaller than the stated noise predicts."""
    return dof_known(f) and f.chi2 / max(f.dof, 1.0) < SMALL_CHI2


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
