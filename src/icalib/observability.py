"""What the data determine: verdicts on parameters and on combinations of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.calibration import Verdict
from icalib.estimation.arrowhead import HELD_BELOW
from icalib.estimation.problem import Problem
from icalib.estimation.state import State

WEAK_BELOW = 1.0  # information in tolerance units: one tolerance of standard deviation
SHARE = 0.25  # a parameter that makes up this much of an undetermined direction is undetermined itself
NAMED = 0.2  # parts of a direction smaller than this are not named

# The motion that would determine a parameter which the data leave open.
MISSING_MOTION = {
    "translation": "turn the rig about two more axes, briskly: a lever arm is only felt when it turns",
    "rotation": "turn the rig about at least two axes",
    "time_offset": "turn or shake the rig faster, so that a shift in time can be seen",
    "intrinsics": "show the target at different distances, tilted, and in every part of the image",
    "distortion": "show the target in the corners of the image",
    "tilt": "turn the rig through larger angles, so that gravity is felt on every axis",
    "shape": "show the target from more sides and closer",
    "bloom": "show the target from more distances",
}


@dataclass(frozen=True)
class Observability:
    """std (B,) formal standard deviations; verdicts by border column; undetermined combinations as sentences."""

    covariance: np.ndarray
    verdicts: tuple[Verdict, ...]
    undetermined: tuple[str, ...]


def observe(problem: Problem, state: State, information: np.ndarray, names: tuple[str, ...]) -> Observability:
    """Classifies the border by its marginal `information` (B, B), priors left out of the verdict.

    Eigen-directions are taken in tolerance units: undetermined below 1/100, weak below 1. `names` (B,) as in
    "cam0.translation.x".
    """
    t = problem.tolerance
    bare = information.copy()
    for prior in problem.priors:
        _, J = prior.residual(state)
        columns = prior.block.columns
        bare[np.ix_(columns, columns)] -= J.T @ J
    values, vectors = np.linalg.eigh(bare * t[:, None] * t)
    held = vectors[:, values < HELD_BELOW]
    own, own_vectors = np.linalg.eigh(information * t[:, None] * t)
    covariance = t[:, None] * ((own_vectors / np.maximum(own, 0.1 * HELD_BELOW)) @ own_vectors.T) * t
    spread = np.sqrt(np.einsum("ik,k,ik->i", vectors, 1.0 / np.maximum(values, 0.1 * HELD_BELOW), vectors))
    verdicts: list[Verdict] = []
    for i in range(len(t)):
        if (held[i] ** 2).sum() > SHARE:
            verdicts.append("undetermined")
        else:
            verdicts.append("determined" if spread[i] ** 2 <= 1.0 / WEAK_BELOW else "weak")
    sentences = tuple(_sentence(held[:, k], names) for k in range(held.shape[1]))
    return Observability(covariance, tuple(verdicts), sentences)


def _sentence(direction: np.ndarray, names: tuple[str, ...]) -> str:
    order = np.argsort(-np.abs(direction))
    parts = [i for i in order if abs(direction[i]) >= NAMED][:4] or [order[0]]
    words = " with ".join(names[i].replace(".", " ") for i in parts)
    kind = names[parts[0]].split(".")[1]
    return f"{words}: not determined by this motion; {MISSING_MOTION.get(kind, 'move the rig more')}."
