"""One side of a comparison: poses, time offsets, lenses and other quantities of sensors, as far as they are known."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

PoseCovariance = Callable[[str, str], np.ndarray]


@dataclass(frozen=True)
class Quantity:
    """A parameter that is compared by its value. what: its name in sentences; value (n,) in `unit` (SI); covariance
    (n, n), NaN if unknown; open: unobservable or too uncertain; is_relative: changes are relative to the value."""

    what: str
    labels: tuple[str, ...]
    value: np.ndarray
    covariance: np.ndarray
    open: bool = False
    unit: str = ""
    is_relative: bool = True


@dataclass(frozen=True)
class LensSide:
    """A camera model. resolution: (width, height) px; params (n,): fx, fy, cx, cy [px], distortion; covariance (n, n),
    NaN if unknown; open: unobservable or too uncertain."""

    model: str
    resolution: tuple[int, int]
    params: np.ndarray
    covariance: np.ndarray
    open: bool = False


@dataclass(frozen=True)
class Side:
    """One side of a comparison. kind: of its file; body: the sensor that is the reference frame; has_imu: whether the
    body is an IMU. poses: T_body_sensor (4, 4) by sensor, the body included; NaN for unknown parts.

    covariance(frame, sensor): (6, 6) of T_frame_sensor, rotation in the sensor's axes [rad], then translation [m]; NaN
    if unknown. open: (sensor, "rotation" or "translation") that the data of a result did not determine.
    quantities: by sensor and key ("time_offset", "radii", "baseline", "gyro", ...). lenses: by camera.
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
        """(4, 4) T_frame_sensor; NaN for unknown parts."""
        a, b, out = self.poses[frame], self.poses[sensor], np.eye(4)
        if frame == self.body:
            return b
        out[:3, :3] = a[:3, :3].T @ b[:3, :3]
        out[:3, 3] = a[:3, :3].T @ (b[:3, 3] - a[:3, 3])
        return out

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of all sensors with a pose, a quantity or a lens."""
        return tuple(dict.fromkeys([*self.poses, *(name for name, _ in self.quantities), *self.lenses]))

    def renamed(self, old: str, new: str) -> Side:
        """This side with the sensor `old` renamed to `new`."""

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
    """(size, size) NaN: an unknown covariance."""
    return np.full((size, size), np.nan)
