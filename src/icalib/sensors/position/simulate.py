"""A simulated position sensor: positions of its antenna or prism in a static frame, without orientation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.sensors.position.spec import LEVELLED, TILTED, PositionSensor
from icalib.sensors.position.stream import PositionStream
from icalib.tools.simulation.output import BagWriter, write_table
from icalib.tools.simulation.scenario import (
    BagEvent,
    BagTopic,
    Report,
    SimRecord,
    SimScene,
    SimSensor,
    TrueParameters,
    at_least,
    mounted_fields,
    pose,
)
from icalib.tools.simulation.trajectory import LEAD_S, stamped

_POINT = "geometry_msgs/msg/PointStamped"


@dataclass(frozen=True, eq=False)
class PositionTruth:
    """True values of N fixes. seconds (N,): instants on the IMU's clock; position (N, 3) m: p_frame_sensor without
    noise."""

    seconds: np.ndarray
    position: np.ndarray


@dataclass(frozen=True, eq=False)
class SimPositions(SimSensor):
    """A simulated sensor that reports its position in the frame T_world_frame (4, 4). Errors of a fix are the sum of:

    - white noise of position_noise [m] on x and y, and vertical_noise on z (None: position_noise);
    - a Gauss-Markov process of standard deviation drift_noise [m] and correlation time drift_time_s, as by multipath;
    - a random walk of each axis of density random_walk [m/sqrt(s)], which starts at 0;
    - outliers: the fraction of single fixes with an error of up to outlier_m on each axis;
    - bursts: the fraction of time in which all fixes share one offset of burst_m / 2 to burst_m in length, as behind a
      building that hides the direct signal. A burst lasts burst_s on average.

    shared_frame: name of the target or sensor whose frame this is, "" for a frame of this sensor. T_world_frame must
    then be the pose of that frame.
    """

    sensor_type: ClassVar[str] = "position"
    random_stream: ClassVar[int] = 5000

    rate_hz: float = 5.0
    T_world_frame: np.ndarray = field(default_factory=lambda: np.eye(4))
    position_noise: float = 0.02
    vertical_noise: float | None = None
    shared_frame: str = ""
    drift_noise: float = 0.0
    drift_time_s: float = 10.0
    outliers: float = 0.0
    outlier_m: float = 3.0
    random_walk: float = 0.0
    bursts: float = 0.0
    burst_s: float = 4.0
    burst_m: float = 3.0

    @classmethod
    def parse(cls, name: str, value: YamlValue, start_ns: int) -> SimPositions:
        sizes = (
            "position_noise", "vertical_noise", "drift_noise", "drift_time_s", "outliers", "outlier_m", "random_walk",
            "bursts", "burst_s", "burst_m",
        )  # fmt: skip
        fields, common = mounted_fields(value, start_ns, options=("T_world_frame", "shared_frame", *sizes))
        chosen: dict[str, Any] = {key: at_least(fields[key], 0.0) for key in sizes if key in fields}
        if "T_world_frame" in fields:
            chosen["T_world_frame"] = pose(fields["T_world_frame"])
        if "shared_frame" in fields:
            chosen["shared_frame"] = fields["shared_frame"].text()
        return cls(name, **common, **chosen)

    def true_parameters(self) -> TrueParameters:
        return TrueParameters(entries={"T_world_frame": self.T_world_frame.tolist()})

    def report(self, scene: SimScene, seed: list[int], progress: Callable[[float], None]) -> Report:
        """Fixes within the span of the IMU's readings, noisy if the scene is, and their true values."""
        stamps, seconds = stamped(self, scene.imu_seconds[-1] - LEAD_S)
        R, p, _ = scene.trajectory.pose_at(seconds)
        positions = p + R @ self.T_imu_sensor[:3, 3]
        positions = (positions - self.T_world_frame[:3, 3]) @ self.T_world_frame[:3, :3]
        truth = PositionTruth(seconds, positions.copy())
        if scene.noisy:
            positions = positions + self._errors(seconds, np.random.default_rng(seed))
        return Report(PositionStream(self.name, stamps, positions, np.zeros((0, 3, 3))), truth)

    def _errors(self, seconds: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(N, 3) m: errors of the fixes at `seconds` (N,)."""
        vertical = self.position_noise if self.vertical_noise is None else self.vertical_noise
        error = rng.standard_normal((len(seconds), 3)) * [self.position_noise, self.position_noise, vertical]
        if self.drift_noise:
            slow = rng.standard_normal((len(seconds), 3))
            for k in range(1, len(seconds)):
                kept = np.exp(-(seconds[k] - seconds[k - 1]) / self.drift_time_s)
                slow[k] = kept * slow[k - 1] + np.sqrt(1.0 - kept**2) * slow[k]
            error += self.drift_noise * slow
        if self.outliers:
            wrong = rng.random(len(seconds)) < self.outliers
            error[wrong] += self.outlier_m * rng.uniform(-1.0, 1.0, (int(wrong.sum()), 3))
        if self.random_walk:
            steps = np.sqrt(np.diff(seconds, prepend=seconds[0]))[:, None] * rng.standard_normal((len(seconds), 3))
            error += self.random_walk * np.cumsum(steps, axis=0)
        return error + self._bursts(seconds, rng) if self.bursts else error

    def _bursts(self, seconds: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """(N, 3) m: offsets in bursts, 0 between them. The durations of bursts, and of the times between, are
        exponentially distributed."""
        error, t = np.zeros((len(seconds), 3)), seconds[0]
        while t < seconds[-1]:
            begin = t + rng.exponential(self.burst_s * (1.0 - self.bursts) / self.bursts)
            t = begin + rng.exponential(self.burst_s)
            direction = rng.standard_normal(3)
            size = self.burst_m * rng.uniform(0.5, 1.0) / np.linalg.norm(direction)
            error[(seconds >= begin) & (seconds < t)] = size * direction
        return error

    def rig_entry(self) -> PositionSensor:
        vertical = self.position_noise if self.vertical_noise is None else self.vertical_noise
        plain = vertical == self.position_noise and not (self.drift_noise or self.outliers or self.bursts)
        tilted = abs(self.T_world_frame[2, 2] - 1.0) > 1e-12
        return PositionSensor(
            self.name,
            f"{self.name}/positions.csv",
            frame=self.shared_frame or (TILTED if tilted else LEVELLED),
            position_noise=self.position_noise if plain and self.position_noise > 0.0 else None,
        )

    def record(self, stream: PositionStream, offset_ns: int) -> SimRecord:
        """A table, and the fixes as PointStamped messages, received `offset_ns` after their stamps."""
        topic = BagTopic(f"/{self.name}/position", _POINT, _messages(stream, offset_ns))
        return SimRecord(partial(_write_fixes, stream), topic)


SIMULATED = SimPositions


def _write_fixes(stream: PositionStream, folder: Path) -> None:
    write_table(folder / "positions.csv", "t [ns],x [m],y [m],z [m]", stream.stamps_ns, stream.position)


def _messages(stream: PositionStream, offset_ns: int) -> Iterator[BagEvent]:
    frame = f"{stream.name}_frame"
    for stamp_ns, position in zip(stream.stamps_ns.tolist(), stream.position, strict=True):
        yield (
            stamp_ns + offset_ns,
            lambda bag, stamp_ns=stamp_ns, position=position: _message(bag, stamp_ns, frame, position),
        )


def _message(bag: BagWriter, stamp_ns: int, frame: str, position: np.ndarray) -> Any:
    """PointStamped message; position (3,) m in `frame`."""
    point = bag.make("geometry_msgs/msg/Point", *position.tolist())
    return bag.make(_POINT, bag.header(stamp_ns, frame), point)
