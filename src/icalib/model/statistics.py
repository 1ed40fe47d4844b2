"""Residual statistics of a pass, from which the noise of each sensor is estimated."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

from icalib.motion.factor import Factor, FactorKey, FitKey, Residuals, Squares
from icalib.optim.state import State
from icalib.rig import Rig

LEAST_DOF_SHARE = 0.2  # degrees of freedom over residuals: below it, the motion absorbs too much noise for an estimate
# Subtracted from the degrees of freedom of sensors at rest, which may be few. This gives the posterior mean of the
# variance under Jeffreys' prior; standard deviations are then those of Student's t distribution.
FEW_DOF = 2.0


@dataclass(frozen=True)
class Fit:
    """chi^2 of one kind of residual, number of residuals, and degrees of freedom left after the fit.

    kind: "gyroscope", "accelerometer", "bias walk", "corners", "features", "points on planes", or "common error" and
    "stamp jitter" for the errors that all corners of an image share.
    """

    sensor: str
    kind: str
    count: int
    dof: float
    chi2: float


@dataclass(frozen=True)
class ResidualStatistics:
    """Residual statistics of one sensor, by kind of residual. at_rest: True without an IMU, when keyframes are
    independent. all_squares, all_fits: statistics of all sensors, computed on demand, because degrees of freedom need
    posterior draws."""

    sensor: str
    at_rest: bool
    all_squares: Callable[[], dict[FitKey, Squares]]
    all_fits: Callable[[], list[Fit]]

    @cached_property
    def squares(self) -> dict[str, Squares]:
        """Number and chi^2 by kind, with the current robust weights."""
        return {kind: squares for (sensor, kind), squares in self.all_squares().items() if sensor == self.sensor}

    @cached_property
    def fits(self) -> dict[str, Fit]:
        """Number, chi^2 and degrees of freedom after the fit, by kind."""
        return {f.kind: f for f in self.all_fits() if f.sensor == self.sensor}

    def variance_factors(self) -> dict[str, float]:
        """chi^2 over degrees of freedom by kind: 1 if the noise is as assumed. Kinds with too few degrees of freedom
        are left out. At rest, FEW_DOF degrees of freedom are subtracted (see there)."""
        known = {kind: f for kind, f in self.fits.items() if f.dof > LEAST_DOF_SHARE * f.count}
        return {k: f.chi2 / (max(f.dof - FEW_DOF, 1.0) if self.at_rest else f.dof) for k, f in known.items()}


@dataclass(frozen=True)
class PassEnd:
    """End of a pass: its factors, and their residuals at `state`.

    is_first: whether it was the first pass. at_rest, all_squares, all_fits: see `ResidualStatistics`.
    """

    rig: Rig
    state: State
    factors: Mapping[FactorKey, Factor]
    residuals: Residuals
    is_first: bool
    at_rest: bool
    all_squares: Callable[[], dict[FitKey, Squares]]
    all_fits: Callable[[], list[Fit]]

    def of(self, sensor: str) -> ResidualStatistics:
        """Residual statistics of one sensor."""
        return ResidualStatistics(sensor, self.at_rest, self.all_squares, self.all_fits)
