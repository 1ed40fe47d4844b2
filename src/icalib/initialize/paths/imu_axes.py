"""An IMU whose readings are recorded another way than its axes are: inverted, permuted, or of left-handed axes.

Each way is tried where the readings as they are do not fit what a camera saw, and named where it fits far better.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import EstimationError
from icalib.motion.imu_data import ImuData
from icalib.rig import Axes, ImuSensor

AS_THEY_ARE: Axes = ("x", "y", "z")
WELL = 0.4  # of the acceleration that was seen is left: readings that fit so are as they should be
BETTER = 0.5  # times what is left of the readings as they are
_NEXT_BEST = 0.8  # times what the next best way leaves; two that fit alike are both named


@dataclass(frozen=True)
class ImuWay:
    """The columns that become x, y, z of each sensor, and words for it."""

    gyro: Axes
    accel: Axes
    words: str

    def of(self, imu: ImuData) -> ImuData:
        return replace(imu, gyro=_in_axes(imu.gyro, self.gyro), accel=_in_axes(imu.accel, self.accel))

    def fields(self, sensor: ImuSensor) -> str:
        """What to write in the rig file, on top of what it says."""
        found = []
        for name, given, own in (
            ("gyro_axes", sensor.gyro_axes, self.gyro),
            ("accel_axes", sensor.accel_axes, self.accel),
        ):
            if own != AS_THEY_ARE:
                found.append(f"{name}: [{', '.join(_composed(given or AS_THEY_ARE, own))}]")
        return " and ".join(found)


def ways() -> Iterator[ImuWay]:
    """The commonest first. A turn of one sensor's axes against the other's stands as one of the gyroscope's."""
    yield ImuWay(AS_THEY_ARE, ("-x", "-y", "-z"), "has an inverted accelerometer, which reads -g at rest")
    for k, axis in enumerate("xyz"):
        yield ImuWay(_flipped(k), AS_THEY_ARE, f"has a left-handed gyroscope, axis {axis} reversed")
    yield ImuWay(("-x", "-y", "-z"), AS_THEY_ARE, "has a gyroscope with all axes reversed")
    for k, axis in enumerate("xyz"):
        yield ImuWay(AS_THEY_ARE, _flipped(k), f"has a left-handed accelerometer, axis {axis} reversed")
    for k in range(3):
        others = tuple(j for j in range(3) if j != k)
        names = " and ".join("xyz"[j] for j in others)
        yield ImuWay(_flipped(*others), AS_THEY_ARE, f"has a gyroscope whose axes {names} are reversed")
        yield ImuWay(_swapped(*others), AS_THEY_ARE, f"has a gyroscope whose axes {names} are swapped")
        yield ImuWay(AS_THEY_ARE, _swapped(*others), f"has an accelerometer whose axes {names} are swapped")
    for axes in (("y", "z", "x"), ("z", "x", "y")):
        yield ImuWay(axes, AS_THEY_ARE, "has a gyroscope whose axes differ from those of its accelerometer")


def refuse_other_axes(
    sensor: ImuSensor, imu: ImuData, left: Callable[[ImuData], float], failed: EstimationError | None
) -> None:
    """Raises EstimationError where readings recorded another way would fit far better. left: what readings leave of the
    acceleration that was seen, or raises EstimationError; failed: where those as they are did."""
    if sensor.assumed:
        return
    now = _left(left, imu)
    found = sorted(((_left(left, way.of(imu)), k, way) for k, way in enumerate(ways())), key=lambda x: x[:2])
    best, _, way = found[0]
    if best < min(WELL, BETTER * now):
        other = f" (or {found[1][2].fields(sensor)}, which fits as well)" if best > _NEXT_BEST * found[1][0] else ""
        raise EstimationError(
            f"{sensor.name} {way.words}: its readings fit the cameras only then; set "
            f"{way.fields(sensor)}{other} of {sensor.name} in the rig file."
        ) from failed


def _left(left: Callable[[ImuData], float], imu: ImuData) -> float:
    try:
        return left(imu)
    except EstimationError:
        return np.inf


def _in_axes(values: np.ndarray, axes: Axes) -> np.ndarray:
    sign = [-1.0 if entry.startswith("-") else 1.0 for entry in axes]
    return np.ascontiguousarray(values[:, ["xyz".index(entry[-1]) for entry in axes]] * sign)


def _composed(given: Axes, own: Axes) -> list[str]:
    """The columns of what is recorded, of `own` axes of the `given` ones."""
    columns = [(given["xyz".index(entry[-1])], entry.startswith("-")) for entry in own]
    return [f"{'-' if name.startswith('-') != turned else ''}{name[-1]}" for name, turned in columns]


def _flipped(*which: int) -> Axes:
    x, y, z = (f"-{axis}" if k in which else axis for k, axis in enumerate("xyz"))
    return x, y, z


def _swapped(i: int, j: int) -> Axes:
    axes = list("xyz")
    axes[i], axes[j] = axes[j], axes[i]
    return axes[0], axes[1], axes[2]
