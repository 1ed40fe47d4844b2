"""Noise densities of the IMU that fit its residuals, and a test of whether other densities alone make them consistent.

Variance components (Helmert 1924; Foerstner 1979): both densities, and the noise of `refitted` residuals such as
corners, are multiplied by sqrt(chi^2 / degrees of freedom after the fit). The estimate is solved again until the scales
converge. If only the noise sizes were wrong, the remaining residuals are white, and equally large in all segments. The
fit itself correlates residuals of white noise: with a draw x from the posterior, E[r_i r_j] = -E[(J x)_i (J x)_j] for
rows i and j of different intervals. Correlation beyond this is not that of white noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.outcome import Outcome
from icalib.estimate.problem.solver import minimise
from icalib.estimate.residual_statistics.fit_statistics import DRAW_STEP
from icalib.model.sensor_model import model_of
from icalib.motion.factor import output_at
from icalib.motion.imu_data import joined_imu_data
from icalib.rig import ImuNoise
from icalib.sensors.imu.residual import ImuFactor

MAX_NOISE_ROUNDS = 12  # the scales converge linearly
MAX_LOG_SCALE_CHANGE = 0.05  # log of the change of a scale in one round, below which it has converged
MIN_DOF_RATIO = 3.0  # least degrees of freedom over sqrt(number of residuals), their sampling error
N_LAGS = 3  # intervals between keyframes: lags of the autocorrelation
MAX_CORRELATION = 0.25  # autocorrelation of residuals that still counts as white
CHANCE_SIGMAS = 3.0  # standard deviations that statistics may be off by chance
N_NOISE_SEGMENTS = 8  # segments of the recording whose mean squares are compared
MAX_VARIATION = 3.0  # mean square of a segment over that of the recording, or its inverse
MAX_STATED_RATIO = 1.25  # fitted over stated density, or its inverse: rig files are no more accurate
MAX_SCALE_STEP = 10.0  # largest factor by which a scale changes in one round
MIN_NOISE_SCALE = 0.02  # of the stated noise: below it a sensor has no noise, as in a simulation without noise
IMU_KINDS = ("gyroscope", "accelerometer")


@dataclass(frozen=True)
class NoiseFit:
    """Fitted noise of the IMU. noise: fitted densities. scales: fitted over stated densities. settled: whether the
    scales converged.

    correlation: mean autocorrelation of the residuals beyond that caused by the fit, over the allowed one. variation:
    largest absolute log ratio of a segment's mean square to that of the recording, over the allowed one.
    """

    noise: ImuNoise
    scales: dict[str, float]
    settled: bool
    correlation: float
    variation: float

    @property
    def is_white(self) -> bool:
        return self.correlation < 1.0

    @property
    def is_constant(self) -> bool:
        return self.variation < 1.0

    @property
    def explains(self) -> bool:
        """Whether another noise size alone makes the residuals consistent with white, stationary noise."""
        return self.settled and self.is_white and self.is_constant

    @property
    def is_as_stated(self) -> bool:
        """Whether the fitted densities agree with the stated ones, after the noise of the other sensors is fitted,
        too."""
        return self.settled and all(abs(np.log(s)) < np.log(MAX_STATED_RATIO) for s in self.scales.values())


def fitting_noise(inputs: Inputs, estimate: Estimate) -> NoiseFit | None:
    """Noise of the IMU that fits the residuals of `estimate`. None without an IMU, if an estimate with other noise
    fails, or if a scale is below MIN_NOISE_SCALE."""
    if inputs.rig.imu is None or inputs.rig.assumes_motion or not isinstance(estimate.problem.chain, ImuFactor):
        return None
    scales: dict[str, float] = dict.fromkeys([*IMU_KINDS, *_refitted_sizes(inputs, estimate.outcome)], 1.0)
    outcome, settled = estimate.outcome, False
    for _ in range(MAX_NOISE_ROUNDS):
        draws = _ImuDraws.of(outcome)
        sizes = {kind: draws.size(kind) for kind in IMU_KINDS} | _refitted_sizes(inputs, outcome)
        steps = {key: float(np.clip(size, 1.0 / MAX_SCALE_STEP, MAX_SCALE_STEP)) for key, size in sizes.items()}
        settled = all(abs(np.log(step)) < MAX_LOG_SCALE_CHANGE for step in steps.values())
        if settled:
            break
        scales = {key: scales[key] * steps[key] for key in scales}
        if min(scales.values()) < MIN_NOISE_SCALE:
            return None
        try:
            outcome = _solved(inputs, estimate, scales)
        except EstimationError:
            return None
    draws = _ImuDraws.of(outcome)
    correlation = max(draws.correlation(kind) for kind in IMU_KINDS)
    imu_scales = {kind: scales[kind] for kind in IMU_KINDS}
    return NoiseFit(_scaled(inputs, scales), imu_scales, settled, correlation, max(map(draws.variation, IMU_KINDS)))


def _scaled(inputs: Inputs, scales: dict[str, float]) -> ImuNoise:
    """Stated noise of the IMU, densities and bias random walks multiplied by `scales`."""
    assert inputs.rig.imu is not None
    n, (gyro, accel) = inputs.rig.imu.noise, (scales[kind] for kind in IMU_KINDS)
    return replace(
        n, gyro=gyro * n.gyro, gyro_walk=gyro * n.gyro_walk, accel=accel * n.accel, accel_walk=accel * n.accel_walk
    )


def _solved(inputs: Inputs, estimate: Estimate, scales: dict[str, float]) -> Outcome:
    """Solution from the state of `estimate`, with noise standard deviations multiplied by `scales`."""
    assert inputs.rig.imu is not None
    rig = inputs.rig.with_sensors(replace(inputs.rig.imu, noise=_scaled(inputs, scales)))
    other = replace(inputs, rig=rig, imu=joined_imu_data(rig, inputs.parts, inputs.measurements))
    state, model = estimate.outcome.state, estimate.measurement_model
    scaled = {
        s.name: model_of(s).scaled_noise(model.noise[s.name], scales[s.name]) for s in rig.mounted if s.name in scales
    }
    return minimise(
        replace(model, noise={**model.noise, **scaled}).problem(other, state, estimate.problem.fixed_directions), state
    )


def _refitted_sizes(inputs: Inputs, outcome: Outcome) -> dict[str, float]:
    """By sensor, sqrt(chi^2 / n) of its n `refitted` residuals. The fit takes few of their degrees of freedom, which
    are neglected."""
    sizes, factors = {}, outcome.problem.factors
    for sensor in inputs.sensors:
        key = sensor.name, model_of(sensor).refitted
        if key in factors and (squares := factors[key].squares(outcome.residuals[key]).get(key)) is not None:
            sizes[sensor.name] = float(np.sqrt(squares.chi2 / max(squares.n, 1)))
    return sizes


@dataclass(frozen=True)
class _ImuDraws:
    """Whitened residuals (K - 1, 15) of the IMU, and J x (K - 1, 15) for up to four draws x from the posterior. rows:
    columns by kind of residual."""

    rows: dict[str, slice]
    residual: np.ndarray
    residual_draws: tuple[np.ndarray, ...]

    @classmethod
    def of(cls, outcome: Outcome) -> _ImuDraws:
        problem, state = outcome.problem, outcome.state
        base = outcome.residuals[problem.chain.key].residual
        assert outcome.draws is not None
        residual_draws = []
        for x in outcome.draws.free[:4]:
            draw_state = state.retract(problem.layout, DRAW_STEP * x.chain, DRAW_STEP * x.calib)
            residual_draws.append((output_at(problem.chain, draw_state).residual - base) / DRAW_STEP)
        kinds = {k: r for k, r in problem.chain.kinds.items() if k in IMU_KINDS}
        return cls(kinds, base, tuple(residual_draws))

    def _dof_and_chi2(self, kind: str, rows: slice = slice(None)) -> tuple[int, float, float]:
        """Number, degrees of freedom after the fit, and chi^2 of the residuals of `kind` in the intervals `rows`."""
        r, columns = self.residual[rows, self.rows[kind]], self.rows[kind]
        used_dof = np.mean([(a[rows, columns] ** 2).sum() for a in self.residual_draws])
        return r.size, r.size - float(used_dof), float((r**2).sum())

    def size(self, kind: str) -> float:
        """sqrt(chi^2 / degrees of freedom) of `kind`, 1 if the noise is as assumed.

        If the fit leaves too few degrees of freedom, their number is increased to a floor. The result is then a lower
        bound of the size, and not below 1."""
        count, dof, chi2 = self._dof_and_chi2(kind)
        min_dof = MIN_DOF_RATIO * np.sqrt(count)
        size = float(np.sqrt(chi2 / max(dof, min_dof)))
        return size if dof > min_dof else max(size, 1.0)

    def correlation(self, kind: str) -> float:
        """Absolute autocorrelation of `kind`, averaged over N_LAGS lags and corrected for the fit, divided by the
        allowed one; above 1 it is no white noise."""
        columns, (count, dof, chi2) = self.rows[kind], self._dof_and_chi2(kind)
        total = 0.0
        for lag in range(1, N_LAGS + 1):
            r, draws = self.residual[:, columns], [a[:, columns] for a in self.residual_draws]
            total += float((r[lag:] * r[:-lag]).sum()) * dof / max(chi2, 1e-300)
            total += float(np.mean([(a[lag:] * a[:-lag]).sum() for a in draws]))
        dof = max(dof, 1.0)
        return abs(total) / N_LAGS / dof / max(MAX_CORRELATION, CHANCE_SIGMAS * np.sqrt(count / N_LAGS) / dof)

    def variation(self, kind: str) -> float:
        """How much the variance of `kind` changes over the recording; above 1 it is no constant noise.

        It is the largest |log(chi^2 per degree of freedom of a segment / that of the recording)|, divided by the
        largest value that is allowed."""
        _, dof, chi2 = self._dof_and_chi2(kind)
        worst, mean_variance = 0.0, chi2 / max(dof, 1.0)
        for segment in np.array_split(np.arange(len(self.residual)), N_NOISE_SEGMENTS):
            n, segment_dof, segment_chi2 = self._dof_and_chi2(
                kind, slice(int(segment[0]), int(segment[-1]) + 1) if len(segment) else slice(0)
            )
            if segment_dof > MIN_DOF_RATIO * np.sqrt(max(n, 1)):
                allowed = np.log(MAX_VARIATION) + CHANCE_SIGMAS * np.sqrt(2.0 / segment_dof)
                worst = max(worst, abs(np.log(max(segment_chi2 / segment_dof / mean_variance, 1e-12))) / allowed)
        return float(worst)


def are_noise(rows: np.ndarray) -> bool:
    """Whether residuals, rows (n, m), are white and of constant variance. The fit must have taken few of their degrees
    of freedom."""
    n, square = len(rows), float(np.vdot(rows, rows))  # `vdot` needs no copy of many rows
    if n < 2 * N_NOISE_SEGMENTS or square == 0.0:
        return False
    lags = [float(np.vdot(rows[lag:], rows[:-lag])) / square for lag in range(1, N_LAGS + 1)]
    white = abs(np.mean(lags)) < max(MAX_CORRELATION, CHANCE_SIGMAS / np.sqrt(N_LAGS * rows.size))
    sizes = [
        float(np.vdot(segment, segment)) / segment.size / (square / rows.size)
        for segment in np.array_split(rows, N_NOISE_SEGMENTS)
    ]
    allowed = np.log(MAX_VARIATION) + CHANCE_SIGMAS * np.sqrt(2.0 * N_NOISE_SEGMENTS / rows.size)
    return bool(white and max(abs(np.log(max(s, 1e-12))) for s in sizes) < allowed)
