"""Options of the solver: when it ends, when it stops early, and what it reports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from icalib.estimate.problem.outcome import Step, Visit
from icalib.optim.prior_factor import Prior

# A decrease of half the chi^2 by 5e-4 is a step of at most 0.03 standard deviations, in any direction.
CONVERGED_DECREASE = 5e-4
ROUNDING_SHARE = 1e-11  # of the cost: rounding error of a sum of 1e6 squares


@dataclass(frozen=True)
class SolverOptions:
    """Options of `minimise`.

    tolerance, tolerance_share: the solver ends when the predicted decrease of half the chi^2 is below `tolerance`, or
    below `tolerance_share` of half the chi^2. A tolerance above STALLED_DECREASE means that another pass follows: the
    outcome has no information and no draws.

    second_order: whether steps that raise the cost are corrected, see `Descent._second_order_correction`.

    stops_early: whether to stop before convergence, given the relative cost decrease so far and the information (B, B)
    of the calibration parameters. It is called when the predicted decrease is low or convergence is slow.
    priors_to_drop: priors to drop from the problem, given the same; called first.

    on_step, on_visit: called with each step, and with each state at which a step is computed.
    """

    tolerance: float = CONVERGED_DECREASE
    tolerance_share: float = ROUNDING_SHARE
    second_order: bool = True
    stops_early: Callable[[float, np.ndarray], bool] = lambda *_: False
    priors_to_drop: Callable[[float, np.ndarray], Sequence[Prior]] = lambda *_: ()
    on_step: Callable[[Step], None] = lambda _: None
    on_visit: Callable[[Visit], None] = lambda _: None


DEFAULT_OPTIONS = SolverOptions()
