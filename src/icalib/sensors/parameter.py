"""One group of parameters of a sensor and its treatment in the estimation: free, guess, fixed or prior."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import pi
from typing import Any, Literal, get_args, get_origin, get_type_hints

import numpy as np

from icalib.base.yaml_nodes import suggestion
from icalib.errors import RigError

Mode = Literal["free", "fixed", "prior"]
ROUNDING = 1e-3  # largest |R R^T - 1| of a rotation with few digits; larger values are a mistake
_EXACT = 1e-12  # |R R^T - 1| below which a rotation is not changed
_ANY_VECTOR = "a vector of numbers, or a 3x3 rotation matrix"


@dataclass(frozen=True)
class Parameter:
    """The treatment of one group of parameters, made by `icalib.free`, `guess`, `fixed` and `prior`.

    free: estimated, with `value` (if given) as initial guess. fixed: constant at `value`. prior: estimated, with a
    Gaussian prior of mean `value` and standard deviation `sigma`. value None: the program finds an initial guess.
    Rotations are 3x3 matrices R_imu_sensor with sigma (3,) in rad about the sensor's axes (right perturbation). Other
    values are vectors with sigma of the same shape. of_class: it is the prior of a class of sensors, not one that the
    rig file states. Raises RigError for an invalid value or sigma.
    """

    mode: Mode = "free"
    value: np.ndarray | None = None
    sigma: np.ndarray | None = None
    of_class: bool = False

    def __post_init__(self) -> None:
        if self.mode not in get_args(Mode):
            raise RigError(f"a parameter is {', '.join(get_args(Mode))}, not {self.mode!r}; use one of these.")
        if self.value is not None:
            object.__setattr__(self, "value", _checked_value(self.value))
        if self.mode == "prior":
            if self.value is None or self.sigma is None:
                raise RigError("a prior needs a value and its sigma; give both, or use a guess.")
            object.__setattr__(self, "sigma", _checked_sigma(self.sigma, self.size))
        elif self.sigma is not None:
            raise RigError(f"sigma belongs to a prior, and this parameter is {self.mode}; use icalib.prior.")

    @property
    def size(self) -> int:
        """Degrees of freedom of the value: 3 for a rotation; 0 without a value."""
        return 0 if self.value is None else 3 if self.value.ndim == 2 else len(self.value)


def free() -> Parameter:
    """A parameter that is estimated; the program finds an initial guess."""
    return Parameter("free")


def guess(value: Any) -> Parameter:
    """A parameter that is estimated from the initial guess `value`: a number, a vector, a 3x3 rotation matrix or a
    scipy Rotation."""
    return Parameter("free", _array(value))


def fixed(value: Any) -> Parameter:
    """A parameter that is constant at `value`: a number, a vector, a 3x3 rotation matrix or a scipy Rotation."""
    return Parameter("fixed", _array(value))


def prior(value: Any, sigma: Any) -> Parameter:
    """A parameter that is estimated with a Gaussian prior of mean `value` and standard deviation `sigma`.

    value: as in `guess`. sigma: one number for all entries, or one for each, in the unit of the value; for a rotation
    in rad about the sensor's axes.
    """
    return Parameter("prior", _array(value), _array(sigma))


def check_sizes(sensor: Any, specs: Iterable[ParameterSpec]) -> None:
    """Raises RigError if the value of a group of `sensor` has another size than `specs` define."""
    for spec in specs:
        p = getattr(sensor, spec.name, None)
        if p is None or p.value is None:
            continue
        is_rotation = spec.manifold == "rotation"
        if p.value.shape != ((3, 3) if is_rotation else (spec.size,)):
            wanted = "a 3x3 rotation matrix" if is_rotation else f"{spec.size} number{'s' * (spec.size > 1)}"
            raise RigError(
                f"{sensor.name}: {spec.name} needs {wanted}, but the value has shape {p.value.shape}; correct the "
                "value."
            )


def check_fields(where: str, old: Any, fields: dict[str, Any]) -> None:
    """Raises RigError if `fields` are not valid for the dataclass `old`: it has no such field, a value is none of the
    choices of its field, or a value for a `Parameter` is no `Parameter`. where: name of `old` in messages."""
    kinds = get_type_hints(type(old))
    for name, value in fields.items():
        if name not in kinds:
            raise RigError(f"{where} has no field {name}{suggestion(name, kinds)}; available are {', '.join(kinds)}.")
        choices = get_args(kinds[name])
        if get_origin(kinds[name]) is Literal and value not in choices:
            raise RigError(f"{where}: {name} is {', '.join(map(str, choices))}, not {value!r}; use one of these.")
        if kinds[name] is Parameter and not isinstance(value, Parameter):
            raise RigError(f"{where}: {name} must be a parameter; write icalib.guess(...), fixed(...) or prior(...).")


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """(3, 3) rotation nearest to `matrix`; `matrix` itself if it is orthonormal within _EXACT. Raises RigError if it is
    a reflection, or not orthonormal within ROUNDING."""
    error = float(np.abs(matrix @ matrix.T - np.eye(3)).max())
    if not error <= ROUNDING:
        raise RigError(f"is not a rotation matrix (R R^T differs from the identity by {error:.2g})")
    if np.linalg.det(matrix) < 0:
        raise RigError("is a reflection (its determinant is -1), not a rotation")
    if error <= _EXACT:
        return matrix
    u, _, vt = np.linalg.svd(matrix)
    return u @ vt


def _array(value: Any) -> np.ndarray:
    """`value` as a float64 array: a number as a vector of one, a scipy Rotation as its matrix. Raises RigError if it is
    not numeric."""
    value = value.as_matrix() if hasattr(value, "as_matrix") else value
    try:
        return np.atleast_1d(np.asarray(value, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise RigError(f"a parameter's value is {_ANY_VECTOR}, not {value!r:.60}; correct the value.") from error


def _checked_value(value: Any) -> np.ndarray:
    array = _array(value)
    if array.shape != (3, 3) and (array.ndim != 1 or not len(array)):
        raise RigError(f"a parameter's value is {_ANY_VECTOR}, but it has shape {array.shape}; correct the value.")
    if not np.isfinite(array).all():
        raise RigError("a parameter's value has entries that are NaN or infinite; leave the value out, or correct it.")
    if array.ndim == 1:
        return array
    try:
        return nearest_rotation(array)
    except RigError as error:
        raise RigError(f"a parameter's 3x3 value {error}; correct the matrix.") from None


def _checked_sigma(sigma: Any, size: int) -> np.ndarray:
    array = _array(sigma)
    if array.shape not in ((1,), (size,)):
        raise RigError(f"a prior's sigma needs 1 or {size} numbers, but it has shape {array.shape}; correct sigma.")
    if not (np.isfinite(array) & (array > 0.0)).all():
        raise RigError(
            f"a prior's sigma must be above 0 and finite, but one entry is {_worst(array):g}; for an exact value use "
            "icalib.fixed, for an unknown one icalib.guess."
        )
    return np.broadcast_to(array, (size,)).copy() if len(array) != size else array


def _worst(sigma: np.ndarray) -> float:
    return float(next(s for s in sigma if not (np.isfinite(s) and s > 0.0)))


# The definition of a parameter: its size, manifold, unit, labels, tolerance and prior uncertainty.
#
# Rig file, layout of the problem, result, comparison and simulated truth follow from it.

# How a parameter is perturbed; see `optim.state.Block`.
Manifold = Literal["vector", "nuisance", "rotation", "tilt", "plane"]
ToleranceSetting = Literal[
    "rotation_tolerance_deg", "translation_tolerance_m", "time_tolerance_s", "pixel_tolerance"
]  # fields of `rig.Settings`
# SI unit -> unit in reports and messages, and the factor by which SI values are multiplied.
DISPLAY_UNITS = {"rad": ("deg", 180.0 / pi), "m": ("mm", 1e3), "s": ("ms", 1e3)}
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class ParameterSpec:
    """One group of parameters.

    name: name in the rig file and in a result. size: count of numbers, or degrees of freedom of a rotation. unit: SI,
    or px; empty for ratios. labels (size,): names of the numbers; a single number has the name of the group. tolerance:
    largest standard deviation of a number with the verdict `determined`, in `unit`, or the name of a setting of the rig
    file. prior_sigma: standard deviation of an initial guess, in `unit`, if the rig file states none.

    is_positive: a length or a factor above 0, whose changes are shown in percent. one: singular of `name`, if that is a
    plural, with which names of numbers begin. is_auxiliary: estimated beside the calibration, such as edge bloom, and
    without a verdict. meaning: what pages say of it. is_effect: zero of an ideal sensor; where the rig file gives no
    value, whether it is zero is tested. is_considered: all standard deviations then include the response to it, as far
    as prior and data let it differ from zero. starts_at_zero: needs no guess. largest: absolute value that the rig file
    may state, in `unit`; larger ones were meant in another. least: smallest value that a sensor can have. by_images:
    determined by images, not by motion. motion: advice if the data do not determine the group; {axes} stands for the
    axes about which the rig hardly turned. motion_on_wheels, motion_without_target and motion_at_rest replace `motion`
    for rigs on wheels, without target, and where nothing connects the instants.
    """

    name: str
    size: int
    manifold: Manifold
    unit: str
    labels: tuple[str, ...]
    tolerance: float | tuple[float, ...] | ToleranceSetting
    prior_sigma: float
    is_positive: bool = False
    one: str = ""
    is_auxiliary: bool = False
    is_effect: bool = False
    is_considered: bool = False
    meaning: str = ""
    starts_at_zero: bool = False
    by_images: bool = False
    largest: float = np.inf
    least: float = -np.inf
    motion: str = "move the rig more"
    motion_on_wheels: str = ""
    motion_without_target: str = ""
    motion_at_rest: str = ""

    def in_recordings(self, count: int) -> ParameterSpec:
        """The definition with one number for each of `count` recordings."""
        labels = tuple(f"in recording {k}" for k in range(1, count + 1))
        return self if count == 1 else replace(self, size=count, labels=labels)

    def entry(self, owner: str, estimated: bool = True) -> tuple[str, str, Manifold, int, bool]:
        """The entry of this group for `optim.state.make_layout`; owner: name of a sensor, or of a part of the scene."""
        return owner, self.name, self.manifold, self.size, estimated

    @property
    def display_unit(self) -> tuple[str, float]:
        """The unit in reports and messages, and the factor by which SI values are multiplied."""
        return display_unit(self.unit)


def display_unit(unit: str) -> tuple[str, float]:
    """The unit in reports and messages for values in the SI `unit`, and the factor by which they are multiplied."""
    return DISPLAY_UNITS.get(unit, (unit, 1.0))
