"""Trajectory of a rig without an IMU: dead reckoning by wheels on a flat floor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from icalib.data.measurements import WheelPoses, WheelStream
from icalib.errors import EstimationError
from icalib.geometry import so3
from icalib.initialize.steps.smooth_trajectory import BodyPoses
from icalib.rig import Wheels
from icalib.sensors.parameter import fixed
from icalib.sensors.wheels.integrals import integrals_of


@dataclass(frozen=True)
class PlanarSteps:
    """Steps between n + 1 stamps, seconds (n + 1,). turn (n,) rad; along (n,) complex: displacement [m] in the wheel
    frame at the earlier stamp, x + i y. scaled: whether sizes of the wheels scale them."""

    seconds: np.ndarray
    turn: np.ndarray
    along: np.ndarray
    scaled: bool

    @cached_property
    def yaw(self) -> np.ndarray:
        """(n + 1,) rad, relative to the first stamp."""
        return np.append(0.0, np.cumsum(self.turn))

    @cached_property
    def distance(self) -> np.ndarray:
        """(n + 1,) m: length of the path since the first stamp."""
        return np.append(0.0, np.cumsum(np.abs(self.along)))

    @cached_property
    def advance(self) -> np.ndarray:
        """(n + 1,) m: as `distance`, but decreasing while the vehicle drives backwards."""
        return np.append(0.0, np.cumsum(np.copysign(np.abs(self.along), np.real(self.along))))

    def path(
        self, distance_factor: float = 1.0, turn_factor: float = 1.0, bend: float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Yaw (n + 1,) rad and position (n + 1,) m, complex, relative to the first stamp, by dead reckoning. bend: yaw
        per distance [rad/m] that the readings lack, as for steering with an offset or unequal radii."""
        yaw = turn_factor * self.yaw + bend * distance_factor * self.advance
        chords = self.along * np.exp(1j * (yaw[:-1] + 0.5 * (np.diff(yaw) - self.turn)))
        return yaw, distance_factor * np.append(0.0, np.cumsum(chords))


def wheel_path(wheels: Wheels, stream: WheelStream | WheelPoses) -> BodyPoses:
    """Poses of the wheel frame at the stamps, relative to the first pose, in the plane z = 0.

    Raises EstimationError if the rig file does not state the sizes of the wheels.
    """
    return planar_poses(stream.seconds, *planar_steps(wheels, stream).path())


def planar_poses(seconds: np.ndarray, yaw: np.ndarray, position: np.ndarray) -> BodyPoses:
    """Poses in the plane z = 0 at seconds (n,): yaw (n,) rad, position (n,) m, complex."""
    points = np.stack([np.real(position), np.imag(position), np.zeros(len(position))], axis=1)
    return BodyPoses(seconds, so3.exp_many(yaw[:, None] * [0.0, 0.0, 1.0]), points)


def with_sizes(wheels: Wheels) -> Wheels:
    """The wheels with 1 m, or 1, for each size that the rig file does not state, and no steering offset."""
    unknown = [spec for spec in wheels.drive_specs if getattr(wheels, spec.name).value is None]
    return replace(wheels, **{spec.name: fixed(np.full(spec.size, float(spec.is_positive))) for spec in unknown})


def planar_steps(wheels: Wheels, stream: WheelStream | WheelPoses) -> PlanarSteps:
    """The steps between the stamps. Raises EstimationError if the rig file does not state the sizes of the wheels."""
    if isinstance(stream, WheelPoses):
        return PlanarSteps(stream.seconds, stream.pose[:, 0], stream.pose[:, 1] + 1j * stream.pose[:, 2], False)
    turned = np.diff(integrals_of(stream), axis=0)
    if stream.kind == "pair":
        path = turned * _size(wheels, "radii")
        ahead, yaw = path.mean(axis=1), (path[:, 1] - path[:, 0]) / _size(wheels, "baseline")[0]
    elif stream.kind == "twist":
        scales = np.ones(2) if wheels.scales.value is None else wheels.scales.value
        ahead, yaw = (turned * scales).T
    else:
        offset = 0.0 if wheels.steering_offset.value is None else float(wheels.steering_offset.value[0])
        ahead = turned[:, 0] * _size(wheels, "radius")[0]
        steer = np.arctan2(turned[:, 2], turned[:, 1]) + offset
        yaw = ahead * np.tan(steer) / _size(wheels, "wheelbase")[0]
    half = 0.5 * yaw  # the displacement is the chord of an arc
    return PlanarSteps(stream.seconds, yaw, ahead * np.sinc(half / np.pi) * np.exp(1j * half), True)


def _size(wheels: Wheels, name: str) -> np.ndarray:
    """The stated value of the parameter `name`. Raises EstimationError if the rig file has none."""
    value = getattr(wheels, name).value
    if value is None:
        raise EstimationError(
            f"without IMU, target and pose sensor only {wheels.name} determines the scale; give its "
            f"{' and '.join(spec.name for spec in wheels.drive_specs)} in the rig file, or add one of these sensors."
        )
    return np.asarray(value, dtype=np.float64)
