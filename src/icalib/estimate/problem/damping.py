"""Damping of the Levenberg-Marquardt steps, and when they use the true curvature of the robust loss."""

from __future__ import annotations

from dataclasses import dataclass

CURVED_BELOW_SHARE = 1e-2  # of the cost: steps that predict less use the true curvature of the robust loss
# Nielsen 1999, "Damping parameter in Marquardt's method": smallest reduction factor of damping after a failure
MIN_FACTOR_AFTER_FAILURE = 1.0 / 3.0
MIN_GAIN_RATIO = 0.25  # actual over predicted decrease: below it damping is not reduced


@dataclass(frozen=True)
class DampingSchedule:
    """Damping schedule. least_after_failure: least damping after a failed step. growth: factor after a failure; its
    powers after successive failures. min_factor: smallest reduction factor after successive good steps. zero_below:
    damping below it is set to 0, so that it does not swamp the weak information of a planar drive."""

    least_after_failure: float
    growth: float
    min_factor: float
    zero_below: float


CAREFUL_DAMPING = DampingSchedule(1e-6, 2.0, 0.1, 1e-10)
EARLY_DAMPING = DampingSchedule(1e-4, 8.0, 0.01, 2e-6)  # for a pass that need not converge


@dataclass
class Damping:
    """Damping of the next step, and the curvature of the robust loss in the sums.

    value: factor on the diagonal of the normal equations, 0 for Gauss-Newton steps. curved: whether the sums have the
    true curvature, instead of weights alone. curved_below: share of the cost; steps with a smaller predicted decrease
    use the true curvature. failures: since the last accepted step.
    """

    schedule: DampingSchedule
    value: float = 0.0
    curved: bool = False
    curved_below: float = CURVED_BELOW_SHARE
    failures: int = 0

    def after_success(self, curved: bool, gain: float) -> None:
        """Update after an accepted step. curved: whether its sums have the true curvature. gain: actual over predicted
        decrease. After a failure damping is reduced slowly, because with much less the next step would fail, too."""
        self.curved = curved
        if gain > MIN_GAIN_RATIO:
            least = MIN_FACTOR_AFTER_FAILURE if self.failures else self.schedule.min_factor
            self.value *= max(least, 1.0 - (2.0 * min(gain, 1.0) - 1.0) ** 3)
        self.failures = 0
        self.value = 0.0 if self.value < self.schedule.zero_below else self.value

    def after_failure(self) -> None:
        """Update after a failed step: first the true curvature is replaced by weights alone, then damping grows."""
        if self.curved:
            self.curved_below *= 0.1
        else:
            self.failures += 1
            self.value = max(self.value * self.schedule.growth**self.failures, self.schedule.least_after_failure)
        self.curved = False
