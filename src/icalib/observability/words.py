"""What the data determine, in words: verdicts on parameters and on combinations of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from icalib.observability.determination import Determined
from icalib.result import Verdict
from icalib.result.verdict import by_size

SHARE = 0.25  # a parameter that makes up this much of an undetermined direction is undetermined itself
NAMED = 0.2  # parts of a direction smaller than this are not named
MOST_NAMED = 4  # of the largest

EVERY_AXIS = "every axis"
# The motion that would determine a parameter which is unobservable. {axes}: those about which the rig hardly turned.
MISSING_MOTION = {
    "translation": "turn the rig briskly about {axes}: a lever arm shows only in rotation",
    "rotation": "turn the rig about {axes}",
    "time_offset": "turn or shake the rig faster, so that a time shift shows",
    "intrinsics": "show the target at different distances, tilted, and in every part of the image",
    "distortion": "show the target in the corners of the image",
    "tilt": "turn the rig through larger angles, so that gravity shows on every axis",
    "shape": "show the target from more sides and closer",
    "bloom": "show the target from more distances",
    "radii": "drive further",
    "baseline": "turn more, both ways",
    "radius": "drive further",
    "wheelbase": "turn more, both ways",
    "steering_offset": "drive further",
    "scales": "drive further, and turn more, both ways",
}
# Of all sensors of a rig on wheels, which cannot turn about other axes.
ON_THE_GROUND = {
    "translation": "turn, and drive over ramps: a flat floor does not show heights; or give it as a prior",
    "rotation": "drive over ramps: a flat floor does not show tilts; or give it as a prior",
    "time_offset": "speed up, brake and turn more",
    "tilt": "drive over ramps",
}
SHOWN_BY_IMAGES = ("intrinsics", "distortion", "bloom", "shape")
# Of cameras without a target, which track points of the scene.
WITHOUT_TARGET = {
    "intrinsics": "move so that near and far points of the scene cross the whole image",
    "distortion": "turn so that points of the scene pass through the corners of the image",
}


@dataclass(frozen=True)
class Observability:
    """Covariance (B, B) formal; verdicts by border column; undetermined combinations as sentences.

    spread (B,): standard deviations in tolerances that the data alone give, consider covariance included.
    """

    covariance: np.ndarray
    verdicts: tuple[Verdict, ...]
    undetermined: tuple[str, ...]
    spread: np.ndarray


def observe(
    found: Determined,
    names: tuple[str, ...],
    wheels: Collection[str] = (),
    tracking: Collection[str] = (),
    axes: str = "",
) -> Observability:
    """Verdicts by what the data alone say; undetermined throughout where the solver did not converge.

    `names` (B,) as in "cam0.translation.x"; `wheels`: which sensors are wheels, on which the whole rig drives;
    `tracking`: which are cameras without a target; `axes`: about which the rig hardly turned, in words, or empty.
    """
    directions = sparse_basis(found.held)
    share = (directions**2).sum(axis=1)
    verdicts: list[Verdict] = []
    for part, spread in zip(share, found.spread, strict=True):
        is_open = part > SHARE or not found.estimate.outcome.converged
        verdicts.append("undetermined" if is_open else by_size(spread))
    rig = MISSING_MOTION | (ON_THE_GROUND if wheels else {})
    rig = {kind: motion.format(axes=axes or EVERY_AXIS) for kind, motion in rig.items()}
    advice = {sensor: rig | WITHOUT_TARGET for sensor in tracking}
    sentences = tuple(_sentence(u, names, rig, advice) for u in directions.T)
    return Observability(found.covariance, tuple(verdicts), sentences, found.spread)


def sparse_basis(directions: np.ndarray, rounds: int = 50) -> np.ndarray:
    """The same span as the orthonormal columns (B, m), turned so that each has few large entries (varimax, Kaiser
    1958)."""
    n, m = directions.shape if directions.size else (len(directions), 0)
    turn = np.eye(m)
    for _ in range(rounds if m > 1 else 0):
        L = directions @ turn
        U, _, Vt = np.linalg.svd(directions.T @ (L**3 - L * (L**2).mean(axis=0)))
        turn = U @ Vt
    return directions @ turn if m else np.zeros((n, 0))


def _sentence(
    direction: np.ndarray, names: tuple[str, ...], rig: Mapping[str, str], advice: Mapping[str, Mapping[str, str]]
) -> str:
    """rig: the missing motion by kind of parameter; advice: the same of sensors that differ."""
    order = np.argsort(-np.abs(direction))
    # By the rig, not by size: where all move alike, noise would decide which comes first.
    parts = sorted(i for i in order[:MOST_NAMED] if abs(direction[i]) >= NAMED) or [order[0]]
    words = " with ".join(_words(names[i]) for i in parts)
    sensor, kind, _ = names[order[0]].rsplit(".", 2)
    motion = advice.get(sensor, rig).get(kind, "move the rig more")
    return f"{words}: not determined by {'these images' if kind in SHOWN_BY_IMAGES else 'this motion'}; {motion}."


def _words(name: str) -> str:
    """A parameter's name as people say it; what is one number has no label of its own."""
    sensor, kind, label = name.rsplit(".", 2)
    own = kind if label == kind else f"{kind} {label}"
    return f"{sensor} {own.replace('_', ' ')}"
