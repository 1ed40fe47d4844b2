"""The estimate in passes: solve, look at what is left, freeze anew, solve again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from icalib.estimation.assembly import Inputs, assemble, image_times, nodes_for, resample
from icalib.estimation.corner_factor import CornerFactor, CornerOutput
from icalib.estimation.corner_noise import NoiseModel, estimate_noise, first_noise, image_speed
from icalib.estimation.problem import Problem
from icalib.estimation.solver import Outcome, Step, minimise
from icalib.estimation.state import State
from icalib.rig import Settings


@dataclass(frozen=True)
class Estimate:
    """The last pass: its problem, where the solver ended, and each camera's noise."""

    problem: Problem
    outcome: Outcome
    noise: tuple[NoiseModel, ...]
    steps: tuple[tuple[str, Step], ...]  # of all passes, with the pass's name


def estimate(inputs: Inputs, state: State, on_step: Callable[[str, Step], None] = lambda *_: None) -> Estimate:
    """All passes from a first `state`. Raises EstimationError where the data do not carry an estimate."""
    rig, streams = inputs.rig, inputs.measurements.cameras
    models = [first_noise(c) for c in rig.cameras]
    noise = [m.noise(s, rig.settings) for m, s in zip(models, streams, strict=True)]
    keep = [np.ones(len(s.uv), dtype=bool) for s in streams]
    history: list[tuple[str, Step]] = []
    names = pass_names(inputs)
    for name in names:
        problem = assemble(inputs, state, noise, keep)

        def note(step: Step, name: str = name) -> None:
            history.append((name, step))
            on_step(name, step)

        outcome = minimise(problem, state, note)
        if name == names[-1]:
            return Estimate(problem, outcome, tuple(models), tuple(history))
        keep = [k & _inliers(f, out, rig.settings) for k, f, out in _zip(keep, problem, outcome)]
        speeds = [image_speed(f, outcome.state) for f in problem.cameras]
        if _noise_is_estimated(inputs):
            models = [
                estimate_noise(c, rig.settings, f, out, v)
                for c, f, out, v in zip(rig.cameras, problem.cameras, outcome.residuals.corners, speeds, strict=True)
            ]
        noise = [m.noise(s, rig.settings, v) for m, s, v in zip(models, streams, speeds, strict=True)]
        state = resample(outcome.state, nodes_for(inputs, image_times(inputs, outcome.state.values)), inputs)
    raise AssertionError("pass_names is never empty")


def _noise_is_estimated(inputs: Inputs) -> bool:
    settings = inputs.rig.settings
    return settings.blur_noise or settings.common_error or any(c.corner_noise_px is None for c in inputs.rig.cameras)


def pass_names(inputs: Inputs) -> tuple[str, ...]:
    """The passes: nodes and assignment are made anew once; noise that is estimated takes one more."""
    return ("first", "noise", "final") if _noise_is_estimated(inputs) else ("first", "final")


def _zip(keep: list[np.ndarray], problem: Problem, outcome: Outcome):
    return zip(keep, problem.cameras, outcome.residuals.corners, strict=True)


def _inliers(factor: CornerFactor, out: CornerOutput, settings: Settings) -> np.ndarray:
    """(N,) bool: corners that stand with the rest of their image.

    The rule: a corner is set aside when its residual is above mean + `outlier_std` standard deviations of its image, and
    above `outlier_min_px`; corners that the model cannot see go too.
    """
    if settings.outlier_std <= 0.0:
        return np.ones(len(out.root), dtype=bool)
    stream = factor.stream
    size = np.linalg.norm(out.residual, axis=1)
    used = factor.keep & (out.root > 0.0)
    n = len(stream.stamps_ns)
    image = stream.image
    count = np.maximum(np.bincount(image[used], minlength=n), 1)
    mean = np.bincount(image[used], size[used], minlength=n) / count
    square = np.bincount(image[used], size[used] ** 2, minlength=n) / count
    limit = mean + settings.outlier_std * np.sqrt(np.maximum(square - mean**2, 0.0))
    return used & ((size <= limit[image]) | (size <= settings.outlier_min_px))
