"""Prior uncertainty of the initial guess, and Gaussian priors about the guess.

The priors keep unobservable directions near the guess while the solver runs.
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

COEFFICIENT_STEP = 1e-4  # step of a distortion coefficient, for a difference quotient


def guess_sigma(inputs: Inputs, state: State) -> np.ndarray:
    """(B,) prior standard deviations of the guess: as the rig file states them, else default ones. state: supplies the
    lens parameters."""
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
    """Priors about `guess` on all estimated parameters of sensors for which the rig file states no prior. Their
    standard deviation is `times` that of `guess_sigma`."""
    sigma = times * guess_sigma(inputs, guess)
    given = {p.block.key for p in stated_priors(inputs)}
    blocks = (b for b in inputs.layout.free if inputs.is_sensor(b.sensor) and b.key not in given)
    return tuple(Prior(b, guess.values[b.key], sigma[b.columns]) for b in blocks)


def _focal_sigma(camera: Camera, state: State, sigma: np.ndarray) -> float:
    """Standard deviation of fx [px] due to errors of the distortion coefficients, with standard deviations `sigma`.

    A guess gives the scale at the image centre. In some models this scale depends on a coefficient, too: it is fx / (1
    + xi) in the unified model. An error of xi then changes fx.
    """
    model, fx = camera_model(camera.model), state.values[camera.name, "intrinsics"][0]
    lens = np.concatenate([state.values[camera.name, name] for name in ("intrinsics", "distortion")])
    steps = lens + COEFFICIENT_STEP * np.eye(len(lens))[4:]
    slope = (np.array([model.central_scale(p) for p in steps]) / model.central_scale(lens) - 1.0) / COEFFICIENT_STEP
    return float(fx * np.sqrt(((slope * sigma) ** 2).sum()))
