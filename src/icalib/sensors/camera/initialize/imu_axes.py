"""Detects an IMU whose recorded axes are not the true ones: inverted, permuted or left-handed.

If the readings do not fit the motion that cameras measured, each convention is tried. An error names one that fits far
better.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.motion.imu_data import ImuData
from icalib.rig import Axes, ImuSensor

UNCHANGED_AXES: Axes = ("x", "y", "z")
MAX_GOOD_UNEXPLAINED = 0.4  # unexplained share of the acceleration below which a convention fits
# largest unexplained share of another convention, relative to that of the present one, at which it is named
MAX_UNEXPLAINED_RATIO = 0.5
_UNIQUE_BEST_RATIO = 0.8  # best over second best unexplained share, above which both conventions are named


@dataclass(frozen=True)
class AxisConvention:
    """gyro, accel: the recorded columns that are the true x, y, z axes, with sign; words: the convention as a
    clause."""

    gyro: Axes
    accel: Axes
    words: str

    def of(self, imu: ImuData) -> ImuData:
        """The readings of `imu` in the true axes, if this convention holds."""
        return replace(imu, gyro=_in_axes(imu.gyro, self.gyro), accel=_in_axes(imu.accel, self.accel))

    def fields(self, sensor: ImuSensor) -> str:
        """Text with the fields `gyro_axes` and `accel_axes` to set in the rig file, whose present axes are those of
        `sensor`."""
        fields = []
        for name, stated, axes in (
            ("gyro_axes", sensor.gyro_axes, self.gyro),
            ("accel_axes", sensor.accel_axes, self.accel),
        ):
            if axes != UNCHANGED_AXES:
                fields.append(f"{name}: [{', '.join(_composed(stated or UNCHANGED_AXES, axes))}]")
        return " and ".join(fields)


def axis_conventions() -> Iterator[AxisConvention]:
    """All conventions that are tried, the most common first. A rotation between both triads is assigned to the
    gyroscope."""
    yield AxisConvention(UNCHANGED_AXES, ("-x", "-y", "-z"), "has an inverted accelerometer, which reads -g at rest")
    for k, axis in enumerate("xyz"):
        yield AxisConvention(_flipped(k), UNCHANGED_AXES, f"has a left-handed gyroscope, axis {axis} reversed")
    yield AxisConvention(("-x", "-y", "-z"), UNCHANGED_AXES, "has a gyroscope with all axes reversed")
    for k, axis in enumerate("xyz"):
        yield AxisConvention(UNCHANGED_AXES, _flipped(k), f"has a left-handed accelerometer, axis {axis} reversed")
    for k in range(3):
        others = tuple(j for j in range(3) if j != k)
        names = " and ".join("xyz"[j] for j in others)
        yield AxisConvention(_flipped(*others), UNCHANGED_AXES, f"has a gyroscope whose axes {names} are reversed")
        yield AxisConvention(_swapped(*others), UNCHANGED_AXES, f"has a gyroscope whose axes {names} are swapped")
        yield AxisConvention(UNCHANGED_AXES, _swapped(*others), f"has an accelerometer whose axes {names} are swapped")
    for axes in (("y", "z", "x"), ("z", "x", "y")):
        yield AxisConvention(axes, UNCHANGED_AXES, "has a gyroscope whose axes differ from those of its accelerometer")


def refuse_other_axes(
    sensor: ImuSensor, imu: ImuData, unexplained: Callable[[ImuData], float], failed: EstimationError | None
) -> None:
    """Raises EstimationError if readings in another convention fit far better. unexplained(imu): share of the measured
    acceleration that the readings do not explain; it may raise EstimationError. failed: the error that the present
    readings raised, if any."""
    if sensor.assumed:
        return
    now = _unexplained_or_inf(unexplained, imu)
    ranked = sorted(
        (
            (_unexplained_or_inf(unexplained, convention.of(imu)), k, convention)
            for k, convention in enumerate(axis_conventions())
        ),
        key=lambda x: x[:2],
    )
    best, _, convention = ranked[0]
    if best < min(MAX_GOOD_UNEXPLAINED, MAX_UNEXPLAINED_RATIO * now):
        alternative = (
            f" (or {ranked[1][2].fields(sensor)}, which fits as well)"
            if best > _UNIQUE_BEST_RATIO * ranked[1][0]
            else ""
        )
        raise EstimationError(
            f"{sensor.name} {convention.words}: its readings fit the cameras only then; set "
            f"{convention.fields(sensor)}{alternative} of {sensor.name} in the rig file."
        ) from failed


def _unexplained_or_inf(unexplained: Callable[[ImuData], float], imu: ImuData) -> float:
    """The unexplained share, infinite if it raises EstimationError."""
    try:
        return unexplained(imu)
    except EstimationError:
        return np.inf


def _in_axes(values: np.ndarray, axes: Axes) -> np.ndarray:
    """Columns of `values` (N, 3), permuted and signed as in `axes`."""
    sign = [-1.0 if entry.startswith("-") else 1.0 for entry in axes]
    return np.ascontiguousarray(values[:, ["xyz".index(entry[-1]) for entry in axes]] * sign)


def _composed(stated: Axes, axes: Axes) -> list[str]:
    """The axes of the rig file after the axes `axes` are applied to those in `stated`."""
    columns = [(stated["xyz".index(entry[-1])], entry.startswith("-")) for entry in axes]
    return [f"{'-' if name.startswith('-') != is_negated else ''}{name[-1]}" for name, is_negated in columns]


def _flipped(*which: int) -> Axes:
    """Axes with the columns in `which` negated."""
    x, y, z = (f"-{axis}" if k in which else axis for k, axis in enumerate("xyz"))
    return x, y, z


def _swapped(i: int, j: int) -> Axes:
    """Axes with columns i and j exchanged."""
    axes = list("xyz")
    axes[i], axes[j] = axes[j], axes[i]
    return axes[0], axes[1], axes[2]
