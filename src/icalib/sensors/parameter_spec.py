"""The definition of a parameter: all that is known of it before it is measured.

Rig file, layout of the problem, tolerances, units, labels, keys of a result, comparison and simulated truth read it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from typing import Literal

# How a parameter is perturbed; see `optim.state.Block`.
Manifold = Literal["vector", "nuisance", "rotation", "tilt", "plane"]
ToleranceSetting = Literal[
    "rotation_tolerance_deg", "translation_tolerance_m", "time_tolerance_s", "pixel_tolerance"
]  # fields of `rig.Settings`
# Units in which people read parameters, and by how much SI values are to be multiplied.
SHOWN_UNITS = {"rad": ("deg", 180.0 / pi), "m": ("mm", 1e3), "s": ("ms", 1e3)}
AXES = ("x", "y", "z")


@dataclass(frozen=True)
class ParameterSpec:
    """One group of parameters.

    name: in the rig file and in a result. size: numbers, or degrees of freedom of a rotation. unit: SI, or px; empty
    for ratios. labels (size,): of the numbers; a single number has the name of the group. tolerance: the number is
    determined if its standard deviation is below; in `unit`, or a setting of the rig file. prior_sigma: standard
    deviation of an initial guess for which the rig file gives none, in `unit`.

    is_positive: a length or a factor above 0; its guess is off by a share of it, and its changes are shown in percent.
    one: name of one of the numbers, where `name` is a plural. is_auxiliary: estimated so that the rest is right, and
    not judged itself; `meaning` explains it. by_images: images show it, and not motion. motion: what to do where the
    data do not determine it, with {axes} for those about which the rig hardly turned; on wheels, and without a target,
    the other sentence where there is one.
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
    meaning: str = ""
    by_images: bool = False
    motion: str = "move the rig more"
    motion_on_wheels: str = ""
    motion_without_target: str = ""

    def in_recordings(self, count: int) -> ParameterSpec:
        """The same with one number for each of `count` recordings."""
        labels = tuple(f"in recording {k}" for k in range(1, count + 1))
        return self if count == 1 else replace(self, size=count, labels=labels)

    def entry(self, owner: str, estimated: bool = True) -> tuple[str, str, Manifold, int, bool]:
        """What `optim.state.make_layout` takes, for the group of a sensor or of a part of the scene."""
        return owner, self.name, self.manifold, self.size, estimated

    @property
    def shown_unit(self) -> tuple[str, float]:
        """The unit in which people read it, and what SI values are to be multiplied by."""
        return shown_unit(self.unit)


def shown_unit(unit: str) -> tuple[str, float]:
    """The unit in which people read values of an SI `unit`, and what they are to be multiplied by."""
    return SHOWN_UNITS.get(unit, (unit, 1.0))
