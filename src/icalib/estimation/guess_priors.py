"""What guesses are worth, and priors of that width: so that what the motion leaves open does not wander from them."""

from __future__ import annotations

import numpy as np

from icalib.estimation.assembly import given_priors
from icalib.estimation.imu_model import N_INTRINSICS
from icalib.estimation.inputs import Inputs
from icalib.estimation.prior_factor import Prior
from icalib.estimation.state import State
from icalib.estimation.tolerances import FROM_NOTHING_M, GUESS_SIGMA, OTHER_SIGMA, distortion_scales


def guess_sigma(inputs: Inputs) -> np.ndarray:
    """(B,) standard deviations of the guess: given ones, or what one without is worth."""
    sigma, sensors = np.zeros(inputs.layout.size), {s.name: s for s in inputs.sensors}
    for b in inputs.layout.free:
        sigma[b.columns] = OTHER_SIGMA if b.size == N_INTRINSICS else GUESS_SIGMA[b.name]
        if b.name == "translation" and b.sensor in sensors and sensors[b.sensor].translation.value is None:
            sigma[b.columns] = FROM_NOTHING_M
    sigma *= distortion_scales(inputs.rig, inputs.layout)
    for prior in given_priors(inputs):
        sigma[prior.block.columns] = prior.sigma
    return sigma


def guess_priors(inputs: Inputs, guess: State, times: float = 1.0) -> tuple[Prior, ...]:
    """Priors about `guess` on everything of the sensors that the rig file gives none for, this many `times` as wide as
    a guess is off."""
    sigma, given = times * guess_sigma(inputs), {p.block.key for p in given_priors(inputs)}
    own = (b for b in inputs.layout.free if inputs.is_sensor(b.sensor) and b.key not in given)
    return tuple(Prior(b, guess.values[b.key], sigma[b.columns]) for b in own)
