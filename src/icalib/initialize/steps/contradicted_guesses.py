"""What the rig file says against what the data show: a guess has no weight, and one that is far off is replaced.

What is fixed has weight. Where it is far off the solver does not come to an end, so that it is told beforehand.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np

from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.optim.state import Key
from icalib.rig import Parameter, ParameterSpec, Sensor
from icalib.sensors.sensor import TRANSLATION

MAX_GUESS_SIGMAS = 4.0  # times what a guess is worth
FACTOR_PRIOR_SIGMA = 0.1  # of a length or factor, by which its guess is off


def is_contradicted(spec: ParameterSpec, guess: np.ndarray, found: np.ndarray) -> bool:
    """Whether a guess of a group is farther from what the data show than guesses are worth."""
    return largest_deviation(spec, guess, found) > MAX_GUESS_SIGMAS


def largest_deviation(spec: ParameterSpec, guess: np.ndarray, found: np.ndarray) -> float:
    """How far a guess is off, in what one is worth; infinite for a length of no size."""
    if spec.manifold == "rotation":
        return float(np.linalg.norm(so3.log(np.ascontiguousarray(guess.T @ found)))) / spec.prior_sigma
    if spec.is_positive:
        if (guess <= 0.0).any() or (found <= 0.0).any():
            return np.inf
        return float(np.abs(np.log(found / guess)).max()) / FACTOR_PRIOR_SIGMA
    return float(np.abs(found - guess).max()) / spec.prior_sigma


def merged_value(spec: ParameterSpec, parameter: Parameter, given: np.ndarray | None, found: np.ndarray) -> np.ndarray:
    """Where the solver starts: at the `given` value of the parameter, as a state has it, but at what was `found` where
    there is none, or a mere guess that this contradicts."""
    if given is None or (parameter.mode == "free" and is_contradicted(spec, given, found)):
        return found
    return given


_REFUSES_FAR_OFF = ContextVar("_REFUSING", default=False)


class MotionContradictedError(EstimationError):
    """A sensor contradicts the motion that another one showed."""


class FarOffError(EstimationError):
    """A length or a lever arm that the rig file fixes is far from what the first guess finds."""


@contextmanager
def refusing_far_off() -> Iterator[None]:
    """Within, `refuse_far_off` refuses."""
    token = _REFUSES_FAR_OFF.set(True)
    try:
        yield
    finally:
        _REFUSES_FAR_OFF.reset(token)


def refuse_far_off(sensor: Sensor, found: dict[Key, np.ndarray]) -> None:
    """Raises FarOffError where a length or a lever arm that is fixed is farther from what was `found` than first
    guesses are off."""
    for (_, name), value in found.items() if _REFUSES_FAR_OFF.get() else ():
        stated, spec = getattr(sensor, name), sensor.spec(name)
        checked = spec.is_positive or spec == TRANSLATION
        if checked and stated.mode == "fixed" and is_contradicted(spec, stated.value, value):
            raise FarOffError(f"{sensor.name}: {name} in the rig file contradicts the data.")


def merged_values(sensor: Sensor, known: dict[Key, np.ndarray], found: dict[Key, np.ndarray]) -> dict[Key, np.ndarray]:
    """Start values of a sensor: the rig file's, `known`, else those `found`. A found value replaces a guess (or a prior
    on a length or factor) that it contradicts, as the solver may not recover from that."""
    leaves = {
        key
        for key, value in known.items()
        if key in found and _is_replaceable(sensor, key[1]) and is_contradicted(sensor.spec(key[1]), value, found[key])
    }
    return found | {key: value for key, value in known.items() if key not in leaves}


def _is_replaceable(sensor: Sensor, name: str) -> bool:
    """Whether what the rig file gives of a group may be left for what the data show."""
    mode = getattr(sensor, name).mode
    return mode == "free" or (mode == "prior" and sensor.spec(name).is_positive)


def has_guesses(sensor: Sensor, known: dict[Key, np.ndarray]) -> bool:
    """Whether some of the `known` values are mere guesses."""
    return any(getattr(sensor, name).mode == "free" for _, name in known)


def merged_translation(given: np.ndarray, found: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """A guess of a translation (3,), moved to what was `found` along the directions that this knows, with covariance
    (3, 3), to better than guesses are worth, and that contradict the guess."""
    variance, axes = np.linalg.eigh(covariance)
    way = axes.T @ (found - given)
    worth = TRANSLATION.prior_sigma
    return given + axes @ np.where((variance < worth**2) & (np.abs(way) > MAX_GUESS_SIGMAS * worth), way, 0.0)


def nearest_about_axis(axis: np.ndarray, guess: np.ndarray, found: np.ndarray) -> np.ndarray:
    """(3, 3) of the rotations found Exp(t axis), of which the data do not show t, the one nearest to the guess."""
    turn = guess.T @ found
    sine = axis @ np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    cosine = np.trace(turn) - axis @ turn @ axis
    return found @ so3.exp(-np.arctan2(sine, cosine) * axis)
