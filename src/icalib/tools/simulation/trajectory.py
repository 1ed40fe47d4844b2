"""Protocol of the true trajectory of the IMU."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from icalib.errors import RigError


class TrueTrajectory(Protocol):
    """True poses and readings of the IMU at any instant."""

    def pose_at(self, seconds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """R_world_imu (N, 3, 3), position (N, 3) m and velocity (N, 3) m/s in the world, at seconds (N,) since the IMU
        clock's origin."""
        ...

    def rate_at(self, seconds: np.ndarray) -> np.ndarray:
        """Angular rate (N, 3) [rad/s] in the IMU frame at seconds (N,) since the IMU clock's origin."""
        ...

    def readings_at(self, seconds: np.ndarray) -> np.ndarray:
        """(N, 6) true angular rate [rad/s] and specific force [m/s^2] in the IMU frame at seconds (N,)."""
        ...


# Functions of time with their derivatives, by arithmetic of truncated Taylor series (automatic differentiation).

Vector = tuple["Jet", "Jet", "Jet"]
Rows = tuple[Vector, Vector, Vector]  # a matrix, row by row


@dataclass(frozen=True, eq=False)
class Jet:
    """A function of time at N instants. c (K + 1, N): Taylor coefficients f, f', f''/2, ... f^(K)/K! at each."""

    c: np.ndarray

    @staticmethod
    def time(seconds: np.ndarray, order: int) -> Jet:
        """The function t at seconds (N,), with derivatives up to `order`, at least 1."""
        c = np.zeros((order + 1, len(seconds)))
        c[0], c[1] = seconds, 1.0
        return Jet(c)

    def constant(self, value: float) -> Jet:
        """The constant function `value`, with the instants and the order of this one."""
        c = np.zeros_like(self.c)
        c[0] = value
        return Jet(c)

    def derivative(self) -> Jet:
        """The derivative f', with an order lower by one."""
        return Jet(self.c[1:] * np.arange(1, len(self.c))[:, None])

    def shortened(self, order: int) -> Jet:
        return Jet(self.c[: order + 1])

    def at(self, order: int) -> np.ndarray:
        """(N,) derivative of order 0, 1 or 2 at each instant."""
        return self.c[order] * (1.0, 1.0, 2.0)[order]

    def __add__(self, other: Jet | float) -> Jet:
        return Jet(self.c + (other.c if isinstance(other, Jet) else self.constant(other).c))

    def __neg__(self) -> Jet:
        return Jet(-self.c)

    def __sub__(self, other: Jet | float) -> Jet:
        return self + (-other)

    def __mul__(self, other: Jet | float) -> Jet:
        if not isinstance(other, Jet):
            return Jet(self.c * other)
        return Jet(np.stack([_folded(self.c, other.c, range(k + 1), k) for k in range(len(self.c))]))

    __rmul__ = __mul__
    __radd__ = __add__

    def __truediv__(self, other: Jet) -> Jet:
        c = np.empty_like(self.c)
        for k in range(len(c)):
            c[k] = (self.c[k] - _folded(c, other.c, range(k), k)) / other.c[0]
        return Jet(c)

    def sqrt(self) -> Jet:
        c = np.empty_like(self.c)
        c[0] = np.sqrt(self.c[0])
        for k in range(1, len(c)):
            c[k] = (self.c[k] - _folded(c, c, range(1, k), k)) / (2.0 * c[0])
        return Jet(c)

    def sine_cosine(self) -> tuple[Jet, Jet]:
        """sin(f) and cos(f), coefficient by coefficient from s' = c f' and c' = -s f'."""
        sine, cosine = np.empty_like(self.c), np.empty_like(self.c)
        sine[0], cosine[0] = np.sin(self.c[0]), np.cos(self.c[0])
        slope = self.derivative().c
        for k in range(1, len(sine)):
            sine[k] = _folded(slope, cosine, range(k), k - 1) / k
            cosine[k] = -_folded(slope, sine, range(k), k - 1) / k
        return Jet(sine), Jet(cosine)


def _folded(a: np.ndarray, b: np.ndarray, terms: range, k: int) -> np.ndarray:
    """(N,) sum of a[i] b[k - i] over the indices i in `terms`."""
    total = np.zeros(a.shape[1])
    for i in terms:
        total += a[i] * b[k - i]
    return total


def dot(a: Vector, b: Vector) -> Jet:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def unit(a: Vector) -> Vector:
    length = dot(a, a).sqrt()
    return a[0] / length, a[1] / length, a[2] / length


def cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def values(vector: Vector, order: int) -> np.ndarray:
    """(N, 3) derivative of order 0, 1 or 2 of a vector."""
    return np.stack([component.at(order) for component in vector], axis=1)


def matrices(rows: Rows, order: int) -> np.ndarray:
    """(N, 3, 3) derivative of order 0, 1 or 2 of a matrix."""
    return np.stack([values(row, order) for row in rows], axis=1)


# Instants and stamps of a sensor's measurements.

LEAD_S = 0.05  # sensors start this long after the IMU, and end this long before it


class Clocked(Protocol):
    """A simulated sensor with a separate clock; the attributes are explained in `SimCamera`."""

    @property
    def name(self) -> str: ...
    @property
    def time_offset_s(self) -> float: ...
    @property
    def clock_rate_ppm(self) -> float: ...
    @property
    def rate_hz(self) -> float: ...
    @property
    def phase_s(self) -> float: ...
    @property
    def clock_origin_ns(self) -> int: ...


def stamped(sensor: Clocked, end_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (M,) int64 [ns] on the sensor's clock of its measurements up to end_s, and their true instants (M,) [s] on
    the IMU's clock since its origin. Raises RigError if there are fewer than two."""
    begin = LEAD_S + sensor.phase_s
    nominal = begin + np.arange(int((end_s - begin) * sensor.rate_hz + 1e-9) + 1) / sensor.rate_hz
    check_enough(sensor.name, nominal)
    return by_clock(sensor, nominal, 0.5 * (end_s + LEAD_S))


def by_clock(sensor: Clocked, taken: np.ndarray, middle_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Stamps (M,) int64 [ns] that the sensor's clock gives to instants `taken` (M,) [s] on the IMU's clock since its
    origin, and the instants (M,) that the rounded stamps mean. middle_s: when the offset is time_offset_s."""
    pace, middle = 1.0 + 1e-6 * sensor.clock_rate_ppm, middle_s - sensor.time_offset_s
    since_origin = np.round((middle + (taken - middle_s) / pace) * 1e9).astype(np.int64)
    seconds = middle_s + pace * (since_origin.astype(np.float64) * 1e-9 - middle)
    return since_origin + np.int64(sensor.clock_origin_ns), seconds


def check_enough(name: str, instants: np.ndarray) -> None:
    """Raises RigError if the sensor `name` has fewer than two instants of measurement."""
    if len(instants) < 2:
        raise RigError(
            f"{name} has fewer than two measurements in this time; make the scenario longer, or its rate higher."
        )


# Settings of a robot's motion through a room, and of the points that its cameras track.

DriveKind = Literal[
    "free",
    "planar",
    "ramps",
    "single-axis",
    "constant-velocity",
    "straight-line",
    "standing",
    "arc",
    "spin",
    "recorded",
]
GROUND: tuple[DriveKind, ...] = (
    "planar",
    "ramps",
    "constant-velocity",
    "straight-line",
    "standing",
    "arc",
    "spin",
)


@dataclass(frozen=True)
class Drive:
    """Motion of a robot through its room.

    free: smooth, in all six degrees of freedom. single-axis: as free, but with rotation about `axis_imu` only.
    recorded: along a spline through the poses in the file `path` (TUM or EuRoC), shifted so that the middle of its
    extent is above the middle of the room. The others are motions of a wheel frame on the floor, without lateral and
    vertical velocity. They are planar and ramps (curves, on the flat floor and on the room's hills), straight-line
    (back and forth without rotation), constant-velocity, arc (constant speed and yaw rate), spin (rotation on the spot,
    back and forth) and standing.

    sideslip_deg: largest angle between the wheel frame's x axis and its velocity, which oscillates at 0.5 to 2 Hz:
    lateral slip of the wheels.
    """

    kind: DriveKind = "free"
    axis_imu: tuple[float, float, float] = (0.0, 0.0, 1.0)
    path: Path | None = None
    sideslip_deg: float = 0.0
    seed: int | None = None  # of the motion; None: the seed of the simulation

    def __post_init__(self) -> None:
        if (self.kind == "recorded") != (self.path is not None):
            raise RigError("a recorded motion needs a path, and only a recorded one; correct the motion.")

    @property
    def on_ground(self) -> bool:
        """Whether it is a motion of a wheel frame on the floor."""
        return self.kind in GROUND


@dataclass(frozen=True)
class Features:
    """Points on the room's surfaces, and settings of the front end that tracks them.

    The first `persistent` of `count` points keep their feature number. Other points get a new number if no camera saw
    them for 1.5 periods of the slowest camera, or after longest_track_s. A camera tracks at most per_image points, none
    further away than range_m [m]. seed: of the points, independent of the seed of the simulation. relief_m: standard
    deviation of their distance from the surfaces.
    """

    count: int = 1500
    persistent: int = 0
    longest_track_s: float = 5.0
    per_image: int = 100
    range_m: float = 15.0
    seed: int = 0
    relief_m: float = 0.0
