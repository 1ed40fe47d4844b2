"""What the residuals of a pass show of the noise of one sensor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

from icalib.motion.factor import Factor, FactorKey, FitKey, Residuals, Squares
from icalib.optim.state import State
from icalib.rig import Rig

LEAST_DOF_SHARE = 0.2  # of the residuals: where the motion absorbs more, too little is left to show their noise
# Degrees of freedom off those of sensors at rest, of which there may be few: the mean of a variance that chi^2 shows,
# its logarithm unknown before (Jeffreys' prior); standard deviations are then those of Student's t distribution.
FEW_DOF = 2.0


@dataclass(frozen=True)
class Fit:
    """chi^2 of one kind of residual, their number, and the degrees of freedom that are left after the fit.

    kind: "gyroscope", "accelerometer", "bias walk", "corners", "features", "points on planes", or "common error 0", 1,
    ... for the images' own.
    """

    sensor: str
    kind: str
    count: int
    dof: float
    chi2: float


@dataclass(frozen=True)
class ResidualStatistics:
    """Of one sensor, by kind of residual. at_rest: without an IMU, so that nothing ties one keyframe to the next.
    all_squares, all_fits: of all sensors; made when asked for, as degrees of freedom cost draws from the posterior."""

    sensor: str
    at_rest: bool
    all_squares: Callable[[], dict[FitKey, Squares]]
    all_fits: Callable[[], list[Fit]]

    @cached_property
    def squares(self) -> dict[str, Squares]:
        """Number and chi^2 by kind, robust weights as they are."""
        return {kind: own for (sensor, kind), own in self.all_squares().items() if sensor == self.sensor}

    @cached_property
    def fits(self) -> dict[str, Fit]:
        """By kind, with the degrees of freedom after the fit."""
        return {f.kind: f for f in self.all_fits() if f.sensor == self.sensor}

    def variance_factors(self) -> dict[str, float]:
        """chi^2 over degrees of freedom, by kind; without those kinds that have too few. It is 1 where the noise is as
        large as assumed."""
        known = {kind: f for kind, f in self.fits.items() if f.dof > LEAST_DOF_SHARE * f.count}
        return {k: f.chi2 / (max(f.dof - FEW_DOF, 1.0) if self.at_rest else f.dof) for k, f in known.items()}


@dataclass(frozen=True)
class PassEnd:
    """Where a pass ended: its factors, and their residuals at `state`.

    is_first: whether it was the first pass. at_rest, all_squares, all_fits: as of `ResidualStatistics`.
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
