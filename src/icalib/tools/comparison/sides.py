"""What one side of a comparison says: poses of sensors, clocks, lenses and more, as far as it says them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

PoseCovariance = Callable[[str, str], np.ndarray]


@dataclass(frozen=True)
class Quantity:
    """value (n,) and covariance (n, n), NaN where it is not known. what: its words; open: undetermined there. unit: SI;
    is_relative: changes are shares of the value."""

    what: str
    labels: tuple[str, ...]
    value: np.ndarray
    covariance: np.ndarray
    open: bool = False
    unit: str = ""
    is_relative: bool = True


@dataclass(frozen=True)
class LensSide:
    """params: fx, fy, cx, cy [px], distortion; covariance of them all, NaN where it is not known."""

    model: str
    resolution: tuple[int, int]
    params: np.ndarray
    covariance: np.ndarray
    open: bool = False


@dataclass(frozen=True)
class Side:
    """One side. body: the sensor whose frame the poses T_body_sensor (4, 4) are seen from, NaN where not given; the
    body's own is there, too. has_imu: whether the body is an IMU.

    covariance(frame, sensor): (6, 6) of T_frame_sensor, rotation about the sensor's axes [rad], translation [m]; NaN
    where it is not known. open: rotations and translations that the data of a result did not determine.
    quantities: by sensor and key ("time_offset", "radii", "baseline", "gyro", ...).
    """

    path: str
    kind: str
    body: str
    has_imu: bool
    poses: dict[str, np.ndarray] = field(default_factory=dict)
    covariance: PoseCovariance = lambda frame, sensor: unknown(6)
    open: frozenset[tuple[str, str]] = frozenset()
    quantities: dict[tuple[str, str], Quantity] = field(default_factory=dict)
    lenses: dict[str, LensSide] = field(default_factory=dict)

    def T(self, frame: str, sensor: str) -> np.ndarray:
        """4x4 T_frame_sensor; NaN where it is not given."""
        a, b, out = self.poses[frame], self.poses[sensor], np.eye(4)
        if frame == self.body:
            return b
        out[:3, :3] = a[:3, :3].T @ b[:3, :3]
        out[:3, 3] = a[:3, :3].T @ (b[:3, 3] - a[:3, 3])
        return out

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of all that something is said of."""
        return tuple(dict.fromkeys([*self.poses, *(name for name, _ in self.quantities), *self.lenses]))

    def renamed(self, old: str, new: str) -> Side:
        """The same with the sensor `old` called `new`."""

        def now(name: str) -> str:
            return new if name == old else name

        def covariance(frame: str, sensor: str) -> np.ndarray:
            return self.covariance(*(old if name == new else name for name in (frame, sensor)))

        return dataclasses.replace(
            self,
            body=now(self.body),
            poses={now(name): T for name, T in self.poses.items()},
            covariance=covariance,
            open=frozenset((now(name), key) for name, key in self.open),
            quantities={(now(name), key): q for (name, key), q in self.quantities.items()},
            lenses={now(name): lens for name, lens in self.lenses.items()},
        )


def unknown(size: int) -> np.ndarray:
    """A covariance that is not known."""
    return np.full((size, size), np.nan)
