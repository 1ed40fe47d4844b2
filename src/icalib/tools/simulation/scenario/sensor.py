"""Base class of simulated sensors other than IMU and cameras.

The class of a kind is `icalib.sensors.KIND.simulate.SIMULATED`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from icalib.base.yaml_nodes import YamlValue
from icalib.sensors import SENSOR_KINDS, facet
from icalib.sensors.sensor import Sensor
from icalib.sensors.stream import Stream
from icalib.tools.simulation.output import BagWriter
from icalib.tools.simulation.scenario.robot import Drive
from icalib.tools.simulation.scenario.room import Room
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory

BagEvent = tuple[int, Callable[[BagWriter], Any]]  # instant of reception on the IMU's clock [ns]; maker of the message


@dataclass(frozen=True, eq=False)
class SimScene:
    """The world that sensors measure. trajectory: of the IMU; imu_seconds (N,): instants of its readings on its clock
    since the origin; noisy: whether sensors have noise."""

    trajectory: TrueTrajectory
    imu_seconds: np.ndarray
    duration_s: float
    room: Room | None
    noisy: bool


class Report(NamedTuple):
    """Measurements of a sensor, and their truth (without noise), in a class of its kind."""

    stream: Stream
    truth: Any = None


@dataclass(frozen=True, eq=False)
class BagTopic:
    """The messages of one sensor. name: of the topic; message: their type; events: in order of reception."""

    name: str
    message: str
    events: Iterator[BagEvent]


@dataclass(frozen=True, eq=False)
class SimSensor(ABC):
    """A simulated sensor that is rigidly mounted to the IMU and has a separate clock.

    T_imu_sensor (4, 4): p_imu = T_imu_sensor p_sensor. Measurement i is taken at phase_s + i / rate_hz on the IMU's
    clock, and stamped by the sensor's clock, as images of `SimCamera`.

    Class variables: sensor_type, as in the rig file; random_stream, number of the first sensor's random stream, at
    least 1000 apart from those of other kinds; measures, noun for its measurements in messages; rolls, whether its
    frame is the wheel frame of motions on the ground; effects, name in the section `effects` of a scenario file -> name
    of the field that it sets, a ratio of true to stated length.
    """

    sensor_type: ClassVar[str]
    random_stream: ClassVar[int]
    measures: ClassVar[str] = "readings"
    rolls: ClassVar[bool] = False
    effects: ClassVar[dict[str, str]] = {}

    name: str
    T_imu_sensor: np.ndarray
    time_offset_s: float = 0.0
    rate_hz: float = 10.0
    phase_s: float = 0.0
    clock_origin_ns: int = 0

    @classmethod
    @abstractmethod
    def parse(cls, name: str, value: YamlValue, start_ns: int) -> SimSensor:
        """The sensor from its section `value` of a scenario file; start_ns: origin of all clocks. Raises RigError
        naming file, line and field."""

    def check(self, room: Room | None, drive: Drive | None) -> None:  # noqa: B027 - most kinds need nothing
        """Raises RigError if the sensor cannot measure in this room, or on this motion (None: handheld)."""

    @property
    def points(self) -> int:
        """Number of points of one measurement; 0 for a sensor without points."""
        return 0

    def values(self) -> dict[str, np.ndarray]:
        """True values of its parameters by their names in the rig, except extrinsics and time offset."""
        return {}

    def drawn_values(self, rng: np.random.Generator, relative_error: float) -> dict[str, np.ndarray]:
        """Initial guesses of `values`, drawn about the truth; relative_error: standard deviation relative to the
        value."""
        return {}

    def plain(self) -> dict[str, Any]:
        """The sensor's entries in truth.yaml, except type, extrinsics and time offset."""
        return {}

    @abstractmethod
    def report(self, scene: SimScene, seed: list[int], progress: Callable[[float], None]) -> Report:
        """Simulates the measurements; seed: of the sensor's random numbers. Raises RigError if there are fewer than two
        measurements."""

    @abstractmethod
    def rig_entry(self) -> Sensor:
        """The sensor as a user would write it in the rig, with the simulated noise and without known parameters."""

    @abstractmethod
    def write_table(self, folder: Path, stream: Any) -> None:
        """Writes the measurements to the sensor's folder, as a table with the path in `rig_entry`."""

    @abstractmethod
    def bag_topic(self, stream: Any, offset_ns: int) -> BagTopic | str:
        """The messages that the sensor's driver would send, or a sentence if it has none. offset_ns: to be added to the
        sensor's stamps to get the IMU's clock [ns]."""


def simulated_kinds() -> dict[str, type[SimSensor]]:
    """Classes of simulated sensors by their type in the rig file, in the order of `SENSOR_KINDS`."""
    modules = {kind: facet(kind, "simulate") for kind in SENSOR_KINDS}
    return {kind: module.SIMULATED for kind, module in modules.items() if module is not None}
