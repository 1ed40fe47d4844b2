"""Simulated sensors on the robot beside its IMU and its cameras: the base class of all kinds.

Each kind has its own class in `icalib.sensors.KIND.simulate`, under the name `SIMULATED`.
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
from icalib.tools.simulation.output.bag_writer import BagWriter
from icalib.tools.simulation.scenario.robot import Drive
from icalib.tools.simulation.scenario.room import Room
from icalib.tools.simulation.scenario.trajectory import TrueTrajectory

BagEvent = tuple[int, Callable[[BagWriter], Any]]  # when it is received, on the IMU's clock [ns]; what makes it


@dataclass(frozen=True, eq=False)
class SimScene:
    """What sensors measure. imu_seconds (N,): instants of the IMU's readings, on its clock. noisy: whether sensors have
    noise."""

    trajectory: TrueTrajectory
    imu_seconds: np.ndarray
    duration_s: float
    room: Room | None
    noisy: bool


class Report(NamedTuple):
    """What a sensor measured, as a stream of `Measurements`, and the same without noise, in the form of its kind."""

    stream: Stream
    truth: Any = None


@dataclass(frozen=True, eq=False)
class BagTopic:
    """The messages of one sensor. message: their type. events: in the order in which they are received."""

    name: str
    message: str
    events: Iterator[BagEvent]


@dataclass(frozen=True, eq=False)
class SimSensor(ABC):
    """One true sensor that is rigidly mounted beside the IMU, with a clock of its own.

    T_imu_sensor (4, 4): p_imu = T_imu_sensor p_sensor. Measurement i is taken at phase_s + i / rate_hz on the IMU's
    clock, and stamped by the sensor's clock, as images of `SimCamera` are.

    Of a kind: sensor_type, as in the rig file; random_stream, number of the first sensor's stream of random numbers, by
    at least 1000 apart from those of other kinds; measures, what its measurements are called; rolls, whether its frame
    is what rolls on the floor where the motion is one on the ground; effects, fields that `effects` of a scenario file
    change: name in the file -> name of the field, a ratio of true over stated lengths.
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
        """The sensor as a scenario file states it, all clocks starting at start_ns. Raises RigError naming file, line
        and field."""

    def check(self, room: Room | None, drive: Drive | None) -> None:  # noqa: B027 - most kinds need nothing
        """Raises RigError where it cannot measure in this room, or on this motion (None: handheld)."""

    @property
    def points(self) -> int:
        """Points of one measurement; 0 where a measurement is a few numbers."""
        return 0

    def values(self) -> dict[str, np.ndarray]:
        """True values of its parameters by their names in the rig, except extrinsics and time offset."""
        return {}

    def drawn_values(self, rng: np.random.Generator, relative_error: float) -> dict[str, np.ndarray]:
        """Guesses of `values`, drawn about the truth; relative_error: standard deviation of a factor."""
        return {}

    def plain(self) -> dict[str, Any]:
        """Its entries in truth.yaml, except type, extrinsics and time offset."""
        return {}

    @abstractmethod
    def report(self, scene: SimScene, seed: list[int], progress: Callable[[float], None]) -> Report:
        """What it measures; `seed` is that of its random numbers. Raises RigError where it measures less than twice."""

    @abstractmethod
    def rig_entry(self) -> Sensor:
        """The sensor as a user would write it in the rig, noise as simulated, with nothing known of its parameters."""

    @abstractmethod
    def write_table(self, folder: Path, stream: Any) -> None:
        """Writes what it reported into its folder, to the path that `rig_entry` states."""

    @abstractmethod
    def bag_topic(self, stream: Any, offset_ns: int) -> BagTopic | str:
        """The messages that its driver would send, or a sentence where there are none. offset_ns: what is to be added
        to its stamps to get the IMU's."""


def simulated_kinds() -> dict[str, type[SimSensor]]:
    """The class of each kind by its type in the rig file, in the order of `SENSOR_KINDS`."""
    modules = {kind: facet(kind, "simulate") for kind in SENSOR_KINDS}
    return {kind: module.SIMULATED for kind, module in modules.items() if module is not None}
