"""Values of the rig file that the data contradict.

An initial guess has no weight in the estimate, so a contradicted guess is replaced by the value that the data show. A
fixed value is not replaced. If it is far off, the solver does not converge, so `refuse_far_off` reports it before the
solve.

Extrinsics and time offsets that the rig file gives, with offsets relative to the first stamps.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np

from icalib.errors import EstimationError
from icalib.estimate.problem.inputs import Inputs, origin_difference
from icalib.geometry import so3
from icalib.initialize.steps.single_recording import KnownExtrinsics
from icalib.optim.state import Key
from icalib.rig import Parameter, ParameterSpec, Sensor
from icalib.sensors.sensor import MOUNTED_NAMES, TRANSLATION

MAX_GUESS_SIGMAS = 4.0  # prior standard deviations of a guess: a larger deviation contradicts it
FACTOR_PRIOR_SIGMA = 0.1  # prior standard deviation of the logarithm of a guessed length or factor


def is_contradicted(spec: ParameterSpec, guess: np.ndarray, estimate: np.ndarray) -> bool:
    """Whether a `guess` deviates from the `estimate` by more than MAX_GUESS_SIGMAS prior standard deviations."""
    return largest_deviation(spec, guess, estimate) > MAX_GUESS_SIGMAS


def largest_deviation(spec: ParameterSpec, guess: np.ndarray, estimate: np.ndarray) -> float:
    """The largest deviation of a guess from an estimate, over the prior standard deviation of a guess. Infinite if a
    length or factor is not positive."""
    if spec.manifold == "rotation":
        return float(np.linalg.norm(so3.log(np.ascontiguousarray(guess.T @ estimate)))) / spec.prior_sigma
    if spec.is_positive:
        if (guess <= 0.0).any() or (estimate <= 0.0).any():
            return np.inf
        return float(np.abs(np.log(estimate / guess)).max()) / FACTOR_PRIOR_SIGMA
    return float(np.abs(estimate - guess).max()) / spec.prior_sigma


def merged_value(
    spec: ParameterSpec, parameter: Parameter, stated: np.ndarray | None, estimate: np.ndarray
) -> np.ndarray:
    """Start value of a parameter: `stated`, the value of the rig file in the form that a state has. It is `estimate`
    instead if the rig file has no value, or only a guess that `estimate` contradicts."""
    if stated is None or (parameter.mode == "free" and is_contradicted(spec, stated, estimate)):
        return estimate
    return stated


_REFUSES_FAR_OFF = ContextVar("_REFUSES_FAR_OFF", default=False)


class MotionContradictedError(EstimationError):
    """A sensor contradicts the motion that another sensor measured."""


class FarOffError(EstimationError):
    """A length or a lever arm that the rig file fixes is far from the initial guess by the data."""


@contextmanager
def refusing_far_off() -> Iterator[None]:
    """Within this context `refuse_far_off` raises; outside it does nothing."""
    token = _REFUSES_FAR_OFF.set(True)
    try:
        yield
    finally:
        _REFUSES_FAR_OFF.reset(token)


def refuse_far_off(sensor: Sensor, estimates: dict[Key, np.ndarray]) -> None:
    """Raises FarOffError if a fixed length or lever arm of the sensor contradicts its estimate. Needs the context
    `refusing_far_off`."""
    for (_, name), value in estimates.items() if _REFUSES_FAR_OFF.get() else ():
        stated, spec = getattr(sensor, name), sensor.spec(name)
        checked = spec.is_positive or spec == TRANSLATION
        if checked and stated.mode == "fixed" and is_contradicted(spec, stated.value, value):
            raise FarOffError(f"{sensor.name}: {name} in the rig file contradicts the data.")


def merged_values(
    sensor: Sensor, stated: dict[Key, np.ndarray], estimates: dict[Key, np.ndarray]
) -> dict[Key, np.ndarray]:
    """Start values of a sensor: `stated` values of the rig file, completed by `estimates`. An estimate replaces a guess
    that it contradicts. It also replaces a prior on a length or factor, as the solver may not recover from a wrong
    one."""
    replaced = {
        key
        for key, value in stated.items()
        if key in estimates
        and _is_replaceable(sensor, key[1])
        and is_contradicted(sensor.spec(key[1]), value, estimates[key])
    }
    return estimates | {key: value for key, value in stated.items() if key not in replaced}


def _is_replaceable(sensor: Sensor, name: str) -> bool:
    """Whether an estimate may replace the value of the rig file for the parameter `name`."""
    mode = getattr(sensor, name).mode
    return mode == "free" or (mode == "prior" and sensor.spec(name).is_positive)


def has_guesses(sensor: Sensor, stated: dict[Key, np.ndarray]) -> bool:
    """Whether some of the `stated` values are guesses: neither fixed nor with a prior."""
    return any(getattr(sensor, name).mode == "free" for _, name in stated)


def merged_translation(guess: np.ndarray, estimate: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """The `guess` of a translation (3,) m, corrected by the `estimate` of covariance (3, 3) m^2. Components along
    principal axes of the covariance are replaced if the estimate is more certain than a guess, and contradicts it."""
    variance, axes = np.linalg.eigh(covariance)
    deviation = axes.T @ (estimate - guess)
    sigma = TRANSLATION.prior_sigma
    return guess + axes @ np.where(
        (variance < sigma**2) & (np.abs(deviation) > MAX_GUESS_SIGMAS * sigma), deviation, 0.0
    )


def nearest_about_axis(axis: np.ndarray, guess: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """The `rotation` Exp(t axis), over all t, that is nearest to the `guess` (3, 3). axis (3,): unit vector, about
    which the data do not show the rotation."""
    turn = guess.T @ rotation
    sine = axis @ np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    cosine = np.trace(turn) - axis @ turn @ axis
    return rotation @ so3.exp(-np.arctan2(sine, cosine) * axis)


def known_value(parameter: Parameter) -> np.ndarray | None:
    """The value of a parameter that is fixed or has a prior, else None. A mere guess may be far off, so other guesses
    must not depend on it."""
    return None if parameter.mode == "free" else parameter.value


def stated_values(inputs: Inputs, sensor: Sensor, names: Sequence[str] | None = None) -> dict[Key, np.ndarray]:
    """Values that the rig file gives for the parameters `names`, by default extrinsics and time offset, whatever their
    mode. Time offsets refer to first stamps; a clock that restarts has one for each recording."""
    out: dict[Key, np.ndarray] = {}
    for name in mounted_names(sensor) if names is None else names:
        value = getattr(sensor, name).value
        if value is not None:
            shift = origin_difference(inputs.measurements, inputs.stream(sensor.name)) if name == "time_offset" else 0.0
            out[sensor.name, name] = np.array(value, dtype=np.float64) + shift
    if (offset := out.get((sensor.name, "time_offset"))) is not None:
        out[sensor.name, "time_offset"] = np.repeat(offset, inputs.clocks_of(sensor))
    return out


def mounted_names(sensor: Sensor) -> list[str]:
    """Names of the extrinsics and time offset that this kind of sensor has."""
    return [spec.name for spec in sensor.specs() if spec.name in MOUNTED_NAMES]


def known_names(sensor: Sensor) -> list[str]:
    """Names of the extrinsics and time offset that are fixed or have a prior."""
    return [name for name in mounted_names(sensor) if known_value(getattr(sensor, name)) is not None]


def known_extrinsics(inputs: Inputs, sensor: Sensor, guesses: bool = False) -> KnownExtrinsics:
    """Extrinsics and time offset that the rig file fixes or gives a prior for; with `guesses`, those that it only
    guesses as well."""
    known = stated_values(inputs, sensor, mounted_names(sensor) if guesses else known_names(sensor))
    offset = known.get((sensor.name, "time_offset"))
    return KnownExtrinsics(
        known.get((sensor.name, "rotation")),
        known.get((sensor.name, "translation")),
        None if offset is None else float(offset[0]),
    )
