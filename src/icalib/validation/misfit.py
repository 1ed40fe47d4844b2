"""Causes and warnings for residuals that differ from the stated noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.residual_statistics.fit_statistics import rows_of
from icalib.observability.cause import Cause
from icalib.result import CrossValidation, SensorFit
from icalib.result.excess import FAR_BEYOND, dof_known, excess, is_small, ratio, times
from icalib.rig import Rig
from icalib.sensors import call_all_kinds, facet
from icalib.sensors.imu.scatter import quiet_scatter
from icalib.validation.causes import INERTIAL, Misfit, noise_words, unknown_words

LARGE_FACTOR = 3.0  # empirical factor; a warning above it
CLEARLY = 1.5  # ratio of noise densities, from which on one is clearly larger
BLOCKS = (3, 10, 30, 100)  # successive rows whose means are compared with those of white noise
MAX_COLOUR = 2.5  # variance of means over that of white noise, or its inverse, that still counts as white
CHANCE_SIGMAS = 3.0  # standard deviations that statistics may be off by chance
N_NOISE_SEGMENTS = 8  # segments of the recording whose mean squares are compared
MAX_VARIATION = 3.0  # mean square of a segment over that of the recording, or its inverse
BEYOND_FACTOR = 1.5  # times the largest empirical factor; a warning if the cross-validation factor is above it


def misfit_causes(
    inputs: Inputs, estimate: Estimate, sensor_fits: Sequence[SensorFit], explained: bool
) -> Iterator[Cause]:
    """Causes of the misfit: rejected outliers, the noise of the IMU, stated noise of other sensors, or unknown.
    explained: whether a named cause explains the misfit; then one sentence states the residuals."""
    yield from (Cause(sentence, 0.0) for sentence in call_all_kinds("assess", "many_rejected", sensor_fits))
    misfit, scatter = Misfit.of(sensor_fits), _scatter_over_stated(inputs)
    noise = list(_noise_of_imu(inputs, sensor_fits, scatter))
    yield from noise
    if explained:
        if misfit.fits:
            yield Cause(f"residuals are larger than the stated noise predicts: {misfit.words}.", 0.0)
        return
    if not noise or any(scatter[f.kind] < 0.5 * excess(f) for f in misfit.fits if f.kind in INERTIAL):
        yield from _unknown(inputs.rig, estimate, misfit)
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


def _noise_of_imu(inputs: Inputs, sensor_fits: Sequence[SensorFit], scatter: Mapping[str, float]) -> Iterator[Cause]:
    """Causes that are noise of the IMU, stated too small or too large. Another noise is advised only if the readings
    show it by themselves. scatter: see `_scatter_over_stated`."""
    imu_fits = [f for f in sensor_fits if f.kind in INERTIAL]
    if inputs.rig.imu is None or not imu_fits:
        return
    small = [f for f in imu_fits if is_small(f)]
    overstated = tuple(call_all_kinds("assess", "overstated_noise", inputs.rig, sensor_fits))
    if any(scatter[f.kind] > CLEARLY for f in imu_fits if excess(f) > 1.0 or not dof_known(f)):
        scales = {kind: max(s, 1.0) for kind, s in scatter.items()}
        misfit = Misfit.of(sensor_fits)
        yield Cause(noise_words(inputs.rig.imu, scales), misfit.chi2, misfit.is_grave)
    elif overstated:  # the trajectory then follows the IMU, and its residuals become small
        yield from (Cause(sentence, 0.0) for sentence in overstated)
    elif small and all(scatter[f.kind] < 1.0 / CLEARLY for f in small):
        scales = dict.fromkeys(INERTIAL, 1.0) | {f.kind: max(ratio(f), scatter[f.kind]) for f in small}
        yield Cause(noise_words(inputs.rig.imu, scales), 0.0)
    elif small:
        sizes = " and ".join(f"{f.kind} {ratio(f):.2g}x" for f in small)
        yield Cause(
            f"residuals of {inputs.rig.imu.name} are smaller than the stated noise predicts ({sizes}); standard "
            "deviations are too large, if anything.",
            0.0,
        )


def _unknown(rig: Rig, estimate: Estimate, misfit: Misfit) -> Iterator[Cause]:
    """A sentence on residuals of the IMU that are too large without a known cause. None if another sensor's are, too,
    and are white: a wrong noise of that sensor also enlarges those of the IMU."""
    large = any(f.kind in INERTIAL for f in misfit.fits)
    if large and not any(f.kind not in INERTIAL and _is_noise(estimate, f) for f in misfit.fits):
        yield Cause(unknown_words(rig, misfit), misfit.chi2, misfit.is_grave)


def _scatter_over_stated(inputs: Inputs) -> dict[str, float]:
    """By kind of INERTIAL: the noise density that the readings show in quiet moments over the stated one; NaN without
    an IMU."""
    if inputs.imu is None or inputs.rig.imu is None or inputs.rig.assumes_motion:
        return dict.fromkeys(INERTIAL, np.nan)
    imu, stated = inputs.imu, inputs.rig.imu.noise
    of_kinds = zip(INERTIAL, (imu.gyro, imu.accel), (stated.gyro, stated.accel), strict=True)
    return {kind: quiet_scatter(imu.seconds, x) / density for kind, x, density in of_kinds}


def _is_noise(estimate: Estimate, f: SensorFit) -> bool:
    """Whether the residuals of `f` are white and constant over the recording."""
    rows = rows_of(estimate.outcome, f.sensor, f.kind)
    return rows is not None and are_noise(rows.weighted)


def are_noise(rows: np.ndarray) -> bool:
    """Whether residuals, rows (n, m), are white and of constant variance. The fit must have taken few of their degrees
    of freedom. The mean of n white numbers has a variance n times smaller."""
    n, square = len(rows), float(np.vdot(rows, rows))  # `vdot` needs no copy of many rows
    if n < 2 * N_NOISE_SEGMENTS or square == 0.0:
        return False
    white = True
    for length in (b for b in BLOCKS if n >= N_NOISE_SEGMENTS * b):
        means = rows[: n // length * length].reshape(n // length, length, -1).mean(axis=1)
        colour = length * float((means**2).mean()) / (square / rows.size)
        allowed = MAX_COLOUR + CHANCE_SIGMAS * np.sqrt(2.0 / means.size)
        white &= 1.0 / allowed < colour < allowed
    sizes = [
        float(np.vdot(segment, segment)) / segment.size / (square / rows.size)
        for segment in np.array_split(rows, N_NOISE_SEGMENTS)
    ]
    allowed = np.log(MAX_VARIATION) + CHANCE_SIGMAS * np.sqrt(2.0 * N_NOISE_SEGMENTS / rows.size)
    return bool(white and max(abs(np.log(max(s, 1e-12))) for s in sizes) < allowed)


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
