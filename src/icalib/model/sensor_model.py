"""Interface of a kind of sensor for the estimator. `sensors/KIND/model.py` has an instance for its kind, called
`MODEL`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Generic, TypeVar

import numpy as np

from icalib.data.measurements import Measurements, Part
from icalib.kinds import models
from icalib.model.bodies import Bodies
from icalib.motion.factor import Factor, FactorKey, FitKey, Residuals, Squares
from icalib.motion.imu_data import ImuData
from icalib.motion.point_planes import PlaneAssociation
from icalib.motion.poses import EstimatedMotion, instants
from icalib.optim.state import Entry, Key, Layout, State, in_recording
from icalib.rig import ParameterSpec, Rig, Sensor, scene
from icalib.sensors.sensor import CLOCK_RATE, TIME_OFFSET

S = TypeVar("S", bound=Sensor)
N = TypeVar("N")


@dataclass(frozen=True)
class Pass:
    """Data from which factors are built for one outer iteration.

    motion: of the IMU; None without one. starts: first keyframe of each recording. coarse: an early pass, which needs
    less accuracy and shall be cheap. measurements: all recordings joined. parts: the recordings, each with its own
    chain; a single part without an IMU. bodies: bodies of the target in use.
    """

    rig: Rig
    association: PlaneAssociation
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

    of_factor: cluster of each measurement by factor, in the form that the factor's `accumulate_clusters` takes.
    is_sample: True if the clusters are a sample of many possible ones, such as groups of feature tracks; False if they
    are all, such as image cells.
    """

    of_factor: Mapping[FactorKey, Any]
    is_sample: bool = False


class SensorModel(Generic[S, N]):
    """Interface of the sensors S of one kind for the estimator, with noise of the class N. The defaults fit a sensor
    with a pose and a clock; `first_noise` must be given."""

    # Measurements

    def prepared(self, rig: Rig, recordings: Sequence[Measurements]) -> tuple[Sequence[Measurements], Bodies | None]:
        """The recordings with their streams of this kind as factors need them, and the bodies of the target that these
        connect; None for kinds that see no target."""
        return recordings, None

    # Parameters

    def is_estimated(self, sensor: S, spec: ParameterSpec, rig: Rig, association: PlaneAssociation) -> bool:
        """Whether a parameter group of the sensor is estimated, with points of LiDARs on planes as in `association`."""
        return sensor.is_estimated(spec)

    def scene_entries(self, sensor: S, rig: Rig, n_recordings: int) -> list[Entry]:
        """Layout entries of quantities of the scene that this sensor needs, such as the reference frame of its
        poses."""
        return []

    def keyframe_times(
        self, sensors: Sequence[S], rig: Rig, streams: Mapping[str, Any], values: Mapping[Key, np.ndarray]
    ) -> dict[str, np.ndarray]:
        """By sensor: (n,) times at which keyframes are wanted [s, body's clock since its first stamp]; empty if the
        kind places none."""
        return {s.name: instants(streams[s.name], values) for s in sensors}

    def widen_guess_sigma(self, sensor: S, layout: Layout, state: State, sigma: np.ndarray) -> None:
        """Enlarges standard deviations (B,) of the initial guess where errors of other parameters of the sensor add to
        them, to first order at `state`."""

    # Noise and inliers of all sensors of the kind

    def first_noise(self, sensors: Sequence[S], rig: Rig, measurements: Measurements) -> dict[str, N]:
        """Noise of each sensor before any residuals are known: stated, or usual values."""
        raise NotImplementedError

    def next_noise(self, sensors: Sequence[S], noise: Mapping[str, N], end: PassEnd) -> dict[str, N]:
        """Noise of each sensor, estimated after a pass with `noise`. Stated parts are unchanged."""
        return {s.name: noise[s.name] for s in sensors}

    def passes(self, sensors: Sequence[S], rig: Rig, measurements: Measurements, association: PlaneAssociation) -> int:
        """Number of passes that the estimates of noise and inliers need; 0 if all noise is stated."""
        return 0

    # Factors

    def factors(self, sensor: S, stream: Any, noise: N, at: Pass) -> Iterable[Factor]:
        """Factors of the sensor. Without an IMU `at.motion` is None; then measurements are at keyframes, which are
        independent."""
        return ()

    def joint_factors(
        self, sensors: Sequence[S], factors: Sequence[Factor], noise: Mapping[str, N], at: Pass
    ) -> Sequence[Factor]:
        """Factors of measurements that several sensors of the kind make together. factors: those of the single
        sensors."""
        return ()

    def uses_more(self, used: Mapping[FactorKey, Factor], rebuilt: Callable[[], Mapping[FactorKey, Factor]]) -> bool:
        """Whether factors `rebuilt` at the end of a pass would use many more measurements than those `used` in it."""
        return False

    def clusters(self, factors: Mapping[FactorKey, Factor]) -> Iterator[Clusters]:
        """Yields each kind of clusters of measurements whose errors may correlate, over all factors of the sensor
        kind."""
        yield from ()

    def points_on_planes(self, sensor: S, stream: Any, at: Pass) -> tuple[np.ndarray, np.ndarray] | None:
        """Some points (n, 3) of the sensor in the world [m], and the index (n,) of the plane in `at.association` that
        each lies on.

        None for sensors without points.
        """
        return None


def model_of(sensor: Sensor) -> SensorModel[Any, Any]:
    """The model of a sensor's kind."""
    return models()[sensor.sensor_type]


def by_kind(sensors: Iterable[Sensor]) -> Iterator[tuple[SensorModel[Any, Any], list[Sensor]]]:
    """(model, sensors) of each kind that occurs in `sensors`, in the order of `SENSOR_KINDS`."""
    every = list(sensors)
    for kind, model in models().items():
        if sensors_of_kind := [s for s in every if s.sensor_type == kind]:
            yield model, sensors_of_kind


def own_entries(sensor: Sensor, rig: Rig, n_recordings: int, association: PlaneAssociation) -> list[Entry]:
    """Layout entries of a sensor's parameters. A clock that restarts has a time offset in each recording."""
    model, n_clocks, entries = model_of(sensor), clocks_of(sensor, n_recordings), []
    for spec in sensor.specs():
        needed = (spec, TIME_OFFSET) if spec == CLOCK_RATE else (spec,)
        estimated = all(model.is_estimated(sensor, each, rig, association) for each in needed)
        entries.append((spec.in_recordings(n_clocks) if spec == TIME_OFFSET else spec).entry(sensor.name, estimated))
    return entries


def clocks_of(sensor: Sensor, n_recordings: int) -> int:
    """Number of time offsets of a sensor: one, or one per recording if its clock restarts."""
    return n_recordings if sensor.clock_restarts else 1


# Residual statistics of a pass, from which the noise of each sensor is estimated.

LEAST_DOF_SHARE = 0.2  # degrees of freedom over residuals: below it, the motion absorbs too much noise for an estimate
# Subtracted from the degrees of freedom of sensors at rest, which may be few. This gives the posterior mean of the
# variance under Jeffreys' prior; standard deviations are then those of Student's t distribution.
FEW_DOF = 2.0


@dataclass(frozen=True)
class Fit:
    """chi^2 of one kind of residual, number of residuals, and degrees of freedom left after the fit.

    kind: "gyroscope", "accelerometer", "bias walk", "corners", "features", "points on planes", or "common error" and
    "stamp jitter" for the errors that all corners of an image share.
    """

    sensor: str
    kind: str
    count: int
    dof: float
    chi2: float


@dataclass(frozen=True)
class ResidualStatistics:
    """Residual statistics of one sensor, by kind of residual. at_rest: True without an IMU, when keyframes are
    independent. all_squares, all_fits: statistics of all sensors, computed on demand, because degrees of freedom need
    posterior draws."""

    sensor: str
    at_rest: bool
    all_squares: Callable[[], dict[FitKey, Squares]]
    all_fits: Callable[[], list[Fit]]

    @cached_property
    def squares(self) -> dict[str, Squares]:
        """Number and chi^2 by kind, with the current robust weights."""
        return {kind: squares for (sensor, kind), squares in self.all_squares().items() if sensor == self.sensor}

    @cached_property
    def fits(self) -> dict[str, Fit]:
        """Number, chi^2 and degrees of freedom after the fit, by kind."""
        return {f.kind: f for f in self.all_fits() if f.sensor == self.sensor}

    def variance_factors(self) -> dict[str, float]:
        """chi^2 over degrees of freedom by kind: 1 if the noise is as assumed. Kinds with too few degrees of freedom
        are left out. At rest, FEW_DOF degrees of freedom are subtracted (see there)."""
        known = {kind: f for kind, f in self.fits.items() if f.dof > LEAST_DOF_SHARE * f.count}
        return {k: f.chi2 / (max(f.dof - FEW_DOF, 1.0) if self.at_rest else f.dof) for k, f in known.items()}


@dataclass(frozen=True)
class PassEnd:
    """End of a pass: its factors, and their residuals at `state`.

    is_first: whether it was the first pass. at_rest, all_squares, all_fits: see `ResidualStatistics`.
    """

    rig: Rig
    state: State
    factors: Mapping[FactorKey, Factor]
    residuals: Residuals
    is_first: bool
    at_rest: bool
    all_squares: Callable[[], dict[FitKey, Squares]]
    all_fits: Callable[[], list[Fit]]

    def of(self, sensor: str) -> ResidualStatistics:
        """Residual statistics of one sensor."""
        return ResidualStatistics(sensor, self.at_rest, self.all_squares, self.all_fits)


# Reference frames of sensors that report poses or positions. They are fixed in the world of each recording.

FRAME = tuple(spec.name for spec in scene.FRAME)  # R_world_frame, p_world_frame


def frame_of(sensor: str, recording: int) -> str:
    """Name of a sensor's reference frame in a `recording` (counted from 0): the first part of the keys of the blocks
    `FRAME`."""
    return in_recording(f"frame of {sensor}", recording)


def frame_entries(
    sensor: str, n_recordings: int, estimated: bool = True, specs: Sequence[ParameterSpec] = scene.FRAME
) -> list[Entry]:
    """Layout entries of a sensor's reference frame in each recording. estimated: False if the frame is the world
    frame."""
    return [spec.entry(frame_of(sensor, k), estimated) for k in range(n_recordings) for spec in specs]
