"""The trajectory of a sensor by its own measurements, and the guess of its extrinsics."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from icalib.optim.state import Key


@dataclass(frozen=True)
class SensorTrajectory:
    """Poses of a sensor in a frame of its own, the map: seconds (n,) on its clock since its first stamp, R_map_sensor
    (n, 3, 3), p_map_sensor (n, 3) m; ok (n,): whether the pose is known."""

    seconds: np.ndarray
    rotation: np.ndarray
    position: np.ndarray
    ok: np.ndarray

    def only(self, chosen: np.ndarray) -> SensorTrajectory:
        """The poses selected by `chosen` (n,)."""
        return SensorTrajectory(self.seconds[chosen], self.rotation[chosen], self.position[chosen], self.ok[chosen])


@dataclass(frozen=True)
class ExtrinsicsGuess:
    """rotation: R_imu_sensor (3, 3); position: p_imu_sensor (3,) m; offset: t_imu - t_sensor [s], both since their
    clocks' first stamps; rotation_observable: whether the sensor turned about more than one axis."""

    rotation: np.ndarray
    position: np.ndarray
    offset: float
    rotation_observable: bool = False

    def values(self, name: str) -> dict[Key, np.ndarray]:
        """The guess as calibration parameters of the sensor `name`."""
        return {
            (name, "rotation"): self.rotation,
            (name, "translation"): self.position,
            (name, "time_offset"): np.array([self.offset]),
        }
