"""Prior uncertainty of the initial guess, and priors of that width.

They keep unobservable directions near the guess while the solver runs.
"""

from __future__ import annotations

import numpy as np

from icalib.estimate.problem.assembly import stated_priors
from icalib.estimate.problem.inputs import Inputs
from icalib.estimate.problem.tolerances import UNGUESSED_TRANSLATION_SIGMA_M
from icalib.geometry.cameras import camera_model
from icalib.optim.prior_factor import Prior
from icalib.optim.state import State
from icalib.rig import Camera
from icalib.sensors.sensor import TRANSLATION

COEFFICIENT_STEP = 1e-4  # of a coefficient, for a difference quotient


def guess_sigma(inputs: Inputs, state: State) -> np.ndarray:
    """(B,) standard deviations of the guess: stated ones, or the default ones. `state` has the lenses."""
    sigma = np.zeros(inputs.layout.size)
    for b in inputs.layout.free:
        stated = inputs.stated(b)
        is_guessed = b.name != TRANSLATION.name or stated is None or stated.value is not None
        sigma[b.columns] = inputs.specs[b.key].prior_sigma if is_guessed else UNGUESSED_TRANSLATION_SIGMA_M
    for camera in inputs.rig.cameras:
        columns = inputs.layout.columns(camera.name, "intrinsics", "distortion")
        if (columns >= 0).all():
            sigma[columns[:2]] = np.hypot(sigma[columns[:2]], _focal_sigma(camera, state, sigma[columns[4:]]))
    for prior in stated_priors(inputs):
        sigma[prior.block.columns] = prior.sigma
    return sigma


def guess_priors(inputs: Inputs, guess: State, times: float = 1.0) -> tuple[Prior, ...]:
    """Priors about `guess` on all parameters of sensors for which the rig file gives none. Their standard deviation is
    `times` that of `guess_sigma`."""
    sigma = times * guess_sigma(inputs, guess)
    given = {p.block.key for p in stated_priors(inputs)}
    own = (b for b in inputs.layout.free if inputs.is_sensor(b.sensor) and b.key not in given)
    return tuple(Prior(b, guess.values[b.key], sigma[b.columns]) for b in own)


def _focal_sigma(camera: Camera, state: State, sigma: np.ndarray) -> float:
    """px: how far fx may be off because the coefficients, of standard deviations `sigma`, are.

    A guess knows the scale in the centre of the image. In some models this scale depends on a coefficient, too: it is
    fx / (1 + xi) in the unified model. fx then follows the error of xi.
    """
    model, fx = camera_model(camera.model), state.values[camera.name, "intrinsics"][0]
    lens = np.concatenate([state.values[camera.name, name] for name in ("intrinsics", "distortion")])
    steps = lens + COEFFICIENT_STEP * np.eye(len(lens))[4:]
    slope = (np.array([model.central_scale(p) for p in steps]) / model.central_scale(lens) - 1.0) / COEFFICIENT_STEP
    return float(fx * np.sqrt(((slope * sigma) ** 2).sum()))
