"""Prior uncertainty of the initial guess, and Gaussian priors about the guess.

The priors keep unobservable directions near the guess while the solver runs.
"""

from __future__ import annotations

import numpy as np

from icalib.estimate.problem.assembly import stated_priors
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.tolerances import UNGUESSED_TRANSLATION_SIGMA_M
from icalib.model.sensor_model import model_of
from icalib.optim.prior_factor import Prior
from icalib.optim.state import State
from icalib.sensors.sensor import TRANSLATION


def guess_sigma(inputs: Inputs, state: State) -> np.ndarray:
    """(B,) prior standard deviations of the guess: as the rig file states them, else default ones. state: at which
    effects of one parameter on another are linearised."""
    sigma = np.zeros(inputs.layout.size)
    for b in inputs.layout.free:
        stated = inputs.stated(b)
        is_guessed = b.name != TRANSLATION.name or stated is None or stated.value is not None
        sigma[b.columns] = inputs.specs[b.key].prior_sigma if is_guessed else UNGUESSED_TRANSLATION_SIGMA_M
    for sensor in inputs.sensors:
        model_of(sensor).widen_guess_sigma(sensor, inputs.layout, state, sigma)
    for prior in stated_priors(inputs):
        sigma[prior.block.columns] = prior.sigma
    return sigma


def guess_priors(inputs: Inputs, guess: State, times: float = 1.0) -> tuple[Prior, ...]:
    """Priors about `guess` on all estimated parameters of sensors for which the rig file states no prior. Their
    standard deviation is `times` that of `guess_sigma`."""
    sigma = times * guess_sigma(inputs, guess)
    given = {p.block.key for p in stated_priors(inputs)}
    blocks = (b for b in inputs.layout.free if inputs.is_sensor(b.sensor) and b.key not in given)
    return tuple(Prior(b, guess.values[b.key], sigma[b.columns]) for b in blocks)
