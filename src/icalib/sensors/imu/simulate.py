"""A simulated IMU that is mounted on the body's IMU."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.rig import UNFILTERED, ImuNoise, ImuSensor
from icalib.sensors.imu.stream import ImuStream
from icalib.tools.simulation.motion import Errors, readings_with_errors
from icalib.tools.simulation.output import IMU, BagWriter, write_table
from icalib.tools.simulation.scenario import (
    ADIS16448,
    GRAVITY_WORLD,
    BagEvent,
    BagTopic,
    Interval,
    Report,
    SimRecord,
    SimScene,
    SimSensor,
    TrueParameters,
    imu_noise,
    intervals,
    mounted_fields,
)
from icalib.tools.simulation.trajectory import LEAD_S, TrueTrajectory, stamped

_STEP_S = 2e-3  # of central differences of fourth order: they miss 2e-7 of an acceleration of 5 Hz
_HEADER = "t [ns],wx [rad/s],wy [rad/s],wz [rad/s],ax [m/s^2],ay [m/s^2],az [m/s^2]"


@dataclass(frozen=True, eq=False)
class SimImu(SimSensor):
    """An IMU at T_imu_sensor on the first one. Its noise, biases at the first reading [rad/s, m/s^2] and intrinsics
    (24,) are as in `Scenario`. size_effect (6,) [m]: places of the accelerometer's y and z axes relative to that of x,
    in the axes of its gyroscope. Readings inside `gaps` are lost."""

    sensor_type: ClassVar[str] = "imu"
    random_stream: ClassVar[int] = 6000

    rate_hz: float = 200.0
    noise: ImuNoise = ADIS16448
    gyro_bias: tuple[float, float, float] = (0.01, -0.02, 0.015)
    accel_bias: tuple[float, float, float] = (0.05, -0.08, 0.1)
    intrinsics: np.ndarray = field(default_factory=lambda: np.zeros(24))
    size_effect: tuple[float, ...] = (0.0,) * 6
    gaps: tuple[Interval, ...] = ()

    @classmethod
    def parse(cls, name: str, value: YamlValue, start_ns: int) -> SimImu:
        fields, common = mounted_fields(
            value, start_ns, options=("noise", "gyro_bias", "accel_bias", "size_effect", "gaps")
        )
        chosen: dict[str, Any] = {n: tuple(fields[n].vector(3)) for n in ("gyro_bias", "accel_bias") if n in fields}
        if "noise" in fields:
            chosen["noise"] = imu_noise(fields["noise"])
        if "size_effect" in fields:
            chosen["size_effect"] = tuple(fields["size_effect"].vector(6))
        if "gaps" in fields:
            chosen["gaps"] = intervals(fields["gaps"])
        return cls(name, **common, **chosen)

    def true_parameters(self) -> TrueParameters:
        values = {"intrinsics": self.intrinsics}
        return TrueParameters(values | ({"size_effect": np.array(self.size_effect)} if any(self.size_effect) else {}))

    def report(self, scene: SimScene, seed: list[int], progress: Callable[[float], None]) -> Report:
        """Readings at instants within those of the first IMU; the truth is these readings with their biases."""
        stamps, seconds = stamped(self, scene.imu_seconds[-1] - LEAD_S)
        kept = np.all([(seconds < a) | (seconds > b) for a, b in self.gaps], axis=0) if self.gaps else slice(None)
        stamps, seconds = stamps[kept], seconds[kept]
        errors = Errors(self.noise, scene.noisy, self.rate_hz, (*self.gyro_bias, *self.accel_bias), self.intrinsics)
        true = _true_readings(scene.trajectory, self.T_imu_sensor, seconds)
        for axis, place in enumerate(np.reshape(self.size_effect, (2, 3)), start=1):
            T = self.T_imu_sensor.copy()
            T[:3, 3] += T[:3, :3] @ place
            true[:, 3 + axis] = _true_readings(scene.trajectory, T, seconds)[:, 3 + axis]
        readings = readings_with_errors(errors, seconds, true, np.random.default_rng(seed))
        return Report(ImuStream(self.name, stamps, readings.gyro, readings.accel), readings)

    def rig_entry(self) -> ImuSensor:
        return ImuSensor(self.name, f"{self.name}/data.csv", self.noise, low_pass=UNFILTERED)

    def record(self, stream: ImuStream, offset_ns: int) -> SimRecord:
        """A table, and the readings as messages, received `offset_ns` after their stamps."""
        return SimRecord(partial(_write, stream), BagTopic(f"/{self.name}", IMU, _messages(stream, offset_ns)))


SIMULATED = SimImu


def _true_readings(trajectory: TrueTrajectory, T_imu_sensor: np.ndarray, seconds: np.ndarray) -> np.ndarray:
    """(N, 6) angular rate [rad/s] and specific force [m/s^2] of the sensor without errors: the rate of the body turned
    into its axes, and the second difference of its own position."""
    R_is, p_is = T_imu_sensor[:3, :3], T_imu_sensor[:3, 3]

    def position(t: np.ndarray) -> np.ndarray:
        R, p, _ = trajectory.pose_at(t)
        return p + R @ p_is

    weights = ((-2, -1.0), (-1, 16.0), (0, -30.0), (1, 16.0), (2, -1.0))
    acceleration = sum(w * position(seconds + k * _STEP_S) for k, w in weights) / (12.0 * _STEP_S**2)
    R_ws = trajectory.pose_at(seconds)[0] @ R_is
    force = np.einsum("nji,nj->ni", R_ws, acceleration - GRAVITY_WORLD)
    return np.concatenate([trajectory.rate_at(seconds) @ R_is, force], axis=1)


def _write(stream: ImuStream, folder: Path) -> None:
    write_table(folder / "data.csv", _HEADER, stream.stamps_ns, stream.gyro, stream.accel)


def _messages(stream: ImuStream, offset_ns: int) -> Iterator[BagEvent]:
    values = np.concatenate([stream.gyro, stream.accel], axis=1).tolist()

    def message(bag: BagWriter, stamp_ns: int, row: list[float]) -> Any:
        return bag.imu(stamp_ns, row, stream.name)

    for stamp_ns, row in zip(stream.stamps_ns.tolist(), values, strict=True):
        yield stamp_ns + offset_ns, partial(message, stamp_ns=stamp_ns, row=row)
