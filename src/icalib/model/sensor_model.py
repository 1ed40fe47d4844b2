"""What the problem asks of a kind of sensor. `sensors/KIND/model.py` has an instance for its kind, called `MODEL`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np

from icalib.data.joining import Part
from icalib.data.measurements import Measurements
from icalib.model.bodies import Bodies
from icalib.model.statistics import PassEnd, ResidualStatistics
from icalib.motion.clouds import Clouds
from icalib.motion.factor import Factor, FactorKey
from icalib.motion.imu_data import ImuData
from icalib.motion.sweep import EstimatedMotion
from icalib.motion.time_offsets import instants
from icalib.optim.state import Entry, Key, Layout, State
from icalib.rig import ParameterSpec, Rig, Sensor, Settings
from icalib.sensors import SENSOR_KINDS, facet
from icalib.sensors.sensor import TIME_OFFSET

S = TypeVar("S", bound=Sensor)
N = TypeVar("N")


@dataclass(frozen=True)
class Pass:
    """The state, motion and layout at which factors are built for one outer iteration.

    motion: of the IMU; None without one. starts: the first keyframe of each recording. coarse: an early pass, which
    needs less accuracy and shall cost little. measurements: all recordings joined; parts: the recordings, each with a
    chain of its own; a single one without an IMU. bodies: those of the target that are in use."""

    rig: Rig
    clouds: Clouds
    layout: Layout
    state: State
    motion: EstimatedMotion | None
    starts: tuple[int, ...]
    measurements: Measurements
    parts: tuple[Part, ...]
    bodies: Bodies
    coarse: bool = False

    @property
    def imu(self) -> ImuData | None:
        """Readings of the IMU; None without one."""
        return None if self.motion is None else self.motion.imu


@dataclass(frozen=True)
class Clusters:
    """Clusters of measurements whose errors may correlate.

    of_factor: the cluster of each measurement, by factor and as its `accumulate_clusters` takes it. is_sample: whether
    the clusters are a sample of all there could be, such as groups of feature tracks; else they are all there are.
    """

    of_factor: Mapping[FactorKey, Any]
    is_sample: bool = False


class SensorModel(Generic[S, N]):
    """How the sensors S of one kind enter the problem, with noise of the class N. The defaults are those of a sensor
    with a pose and a clock, and with no factor.

    keyframes: what keyframes are placed at, as in "images of cam0"; empty where the kind places none.
    only_first_places_keyframes: if the kind has several sensors, only the first places keyframes. refitted: the kind of
    residuals whose noise is fitted again where another density of the IMU's noise is tried; empty where there is none.
    """

    keyframes: ClassVar[str] = ""
    only_first_places_keyframes: ClassVar[bool] = False
    refitted: ClassVar[str] = ""

    # Parameters

    def takes_part(self, sensor: S, clouds: Clouds) -> bool:
        """Whether the sensor has parameters and factors. clouds: points of LiDARs on planes."""
        del sensor, clouds
        return True

    def is_estimated(self, sensor: S, spec: ParameterSpec, rig: Rig) -> bool:
        """Whether one of the sensor's own groups of parameters is estimated."""
        del rig
        return sensor.is_estimated(spec)

    def entries(self, sensor: S, rig: Rig, n_recordings: int) -> list[Entry]:
        """The sensor's own groups of parameters in the layout."""
        return own_entries(sensor, n_recordings, lambda spec: self.is_estimated(sensor, spec, rig))

    def scene_entries(self, sensor: S, rig: Rig, n_recordings: int) -> list[Entry]:
        """What the scene has because of this sensor, such as the frame that it reports in."""
        del sensor, rig, n_recordings
        return []

    def start_value(self, sensor: S, spec: ParameterSpec, rig: Rig) -> np.ndarray | None:
        """Start (spec.size,) of a nuisance or auxiliary group (bias, scale, shape): the stated value, or zero. None for
        groups that the initial guess finds."""
        del rig
        if not (spec.manifold == "nuisance" or spec.is_auxiliary):
            return None
        stated = getattr(sensor, spec.name).value
        return np.zeros(spec.size) if stated is None else stated.copy()

    def keyframe_times(self, sensor: S, stream: Any, values: dict[Key, np.ndarray], rig: Rig) -> np.ndarray:
        """(n,) instants at which the sensor wants keyframes, s on the body's clock since its first stamp."""
        del sensor, rig
        return instants(stream, values)

    # Noise

    def first_noise(self, sensor: S, settings: Settings) -> N:
        """The noise before any residuals are known: the stated, or a usual one."""
        raise NotImplementedError

    def next_noise(self, sensor: S, noise: N, found: ResidualStatistics) -> N:
        """The noise that the residuals of a pass with `noise` show, as far as it is estimated."""
        del sensor, found
        return noise

    def noise_passes(self, sensor: S) -> int:
        """How many passes the estimate of the noise takes; 0: all of it is stated."""
        del sensor
        return 0

    def noise_is_estimated(self, sensor: S) -> bool:
        """Whether the residuals show some of the noise."""
        return self.noise_passes(sensor) > 0

    def scaled_noise(self, noise: N, scale: float) -> N:
        """The noise with standard deviations `scale` times as large, of kinds that have `refitted` residuals."""
        raise NotImplementedError

    # Noise and inliers of all sensors of the kind; a kind whose sensors share measurements overrides these

    def first_noises(self, sensors: Sequence[S], rig: Rig, measurements: Measurements) -> dict[str, N]:
        """`first_noise` of each sensor."""
        del measurements
        return {s.name: self.first_noise(s, rig.settings) for s in sensors}

    def next_noises(self, sensors: Sequence[S], noise: Mapping[str, N], end: PassEnd) -> dict[str, N]:
        """`next_noise` of each sensor, after a pass with `noise`."""
        return {s.name: self.next_noise(s, noise[s.name], end.of(s.name)) for s in sensors}

    def passes(self, sensors: Sequence[S], rig: Rig, measurements: Measurements) -> int:
        """How many passes the estimates of noise and inliers take."""
        del rig, measurements
        return max((self.noise_passes(s) for s in sensors), default=0)

    # Factors

    def factors(self, sensor: S, stream: Any, noise: N, at: Pass) -> Iterable[Factor]:
        """The sensor's factors for a rig with an IMU, whose motion is `at.motion`."""
        del sensor, stream, noise, at
        return ()

    def still_factors(self, sensor: S, stream: Any, noise: N, at: Pass) -> Iterable[Factor]:
        """The sensor's factors for a rig without an IMU. Measurements are taken at keyframes; nothing links
        keyframes."""
        del sensor, stream, noise, at
        return ()

    def joint_factors(
        self, sensors: Sequence[S], factors: Sequence[Factor], noise: Mapping[str, N], at: Pass
    ) -> Sequence[Factor]:
        """Factors of what several sensors of the kind measure together; `factors`: those of each sensor."""
        del sensors, factors, noise, at
        return ()

    def uses_more(self, used: Mapping[FactorKey, Factor], rebuilt: Callable[[], Mapping[FactorKey, Factor]]) -> bool:
        """Whether the factors of a pass, `rebuilt` at its end, would use many more measurements than it `used`."""
        del used, rebuilt
        return False

    def clusters(self, factors: Mapping[FactorKey, Factor]) -> Iterator[Clusters]:
        """Measurements whose errors may correlate, cluster by cluster; each item covers all of the kind's factors."""
        del factors
        yield from ()

    def points_on_planes(self, sensor: S, stream: Any, at: Pass) -> tuple[np.ndarray, np.ndarray] | None:
        """Some points (n, 3) m of the sensor in the world, and the plane (n,) of `at.clouds` that each lies on.

        None for sensors without points.
        """
        del sensor, stream, at
        return None


def model_of(sensor: Sensor) -> SensorModel[Any, Any]:
    """The model of a sensor's kind."""
    return kind_model(sensor.sensor_type)


def by_kind(sensors: Iterable[Sensor]) -> Iterator[tuple[SensorModel[Any, Any], list[Sensor]]]:
    """The models of the kinds that have any of `sensors`, in the order of `SENSOR_KINDS`, with their sensors."""
    every = list(sensors)
    for kind in SENSOR_KINDS:
        if own := [s for s in every if s.sensor_type == kind]:
            yield kind_model(kind), own


def all_models() -> Iterator[SensorModel[Any, Any]]:
    """The models of all kinds, in the order of `SENSOR_KINDS`."""
    return map(kind_model, SENSOR_KINDS)


@cache
def kind_model(kind: str) -> SensorModel[Any, Any]:
    """The model of one of `SENSOR_KINDS`."""
    return facet(kind, "model").MODEL


def own_entries(
    sensor: Sensor, n_recordings: int = 1, is_estimated: Callable[[ParameterSpec], bool] | None = None
) -> list[Entry]:
    """The parameters of a sensor; a clock that restarts has a time offset in each recording."""
    n_clocks = clocks_of(sensor, n_recordings)
    specs = (spec.in_recordings(n_clocks) if spec == TIME_OFFSET else spec for spec in sensor.specs())
    free = is_estimated or sensor.is_estimated
    return [spec.entry(sensor.name, free(spec)) for spec in specs]


def clocks_of(sensor: Sensor, n_recordings: int) -> int:
    """How many time offsets a sensor has: one in each recording where its clock restarts."""
    return n_recordings if sensor.clock_restarts else 1
