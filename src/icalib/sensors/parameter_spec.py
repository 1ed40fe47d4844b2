"""The definition of a parameter: its size, manifold, unit, labels, tolerance and prior uncertainty.

Rig file, layout of the problem, result, comparison and simulated truth follow from it.
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
    plural. is_auxiliary: estimated beside the calibration, such as edge bloom, and without a verdict; `meaning`
    explains it. by_images: determined by images, not by motion. motion: advice if the data do not determine the group;
    {axes} stands for the axes about which the rig hardly turned. motion_on_wheels and motion_without_target replace
    `motion` for rigs on wheels and without target.
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
