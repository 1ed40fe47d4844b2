"""The result of a calibration, as frozen dataclasses."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from icalib.base.extras import load_pandas
from icalib.base.remark import Remark
from icalib.data.measurements import Part
from icalib.motion.factor import ResidualRows
from icalib.result.verdict import Usability, failure_words, lens_projections_px, reasons, usability
from icalib.rig.rig import SENSOR_TYPES
from icalib.sensors import SENSOR_KINDS
from icalib.sensors.camera.stream import CornerResiduals, ImageResiduals, TrackResiduals
from icalib.sensors.imu.stream import ImuResiduals
from icalib.sensors.parameter import AXES
from icalib.sensors.sensor import MOUNTED_NAMES
from icalib.sensors.stream import Residuals, RowResiduals, Shapes

if TYPE_CHECKING:
    from icalib.result.derived import RelativePose


Verdict = Literal["determined", "weak", "too uncertain", "unobservable", "fixed"]


@dataclass(frozen=True)
class ParameterGroup:
    """One group of n parameters of one sensor, such as its rotation.

    value: (3, 3) R_imu_sensor of a rotation, else (n,). std_formal, std: (n,) standard deviations, zero if fixed; those
    of a rotation are about the sensor's axes [rad]. std = std_formal * max(factor, 1). columns: (n,) indices of the
    parameters in `Calibration.covariance`, None if fixed.
    """

    sensor: str  # "cam0", "imu0", "board0"
    name: str  # "rotation", "translation", "time_offset", "intrinsics", "distortion", "bloom", "shape", ...
    labels: tuple[str, ...]  # one per entry: ("x", "y", "z"), ("fx", "fy", "cx", "cy"), ...
    unit: str  # SI unit of value and std: "rad", "m", "s", "px", ""
    value: np.ndarray
    std_formal: np.ndarray
    std: np.ndarray
    verdict: tuple[Verdict, ...]
    mode: str  # free, fixed, prior
    columns: tuple[int, ...] | None = None
    factor: np.ndarray | None = None  # (n,) empirical factor, of which only values above 1 scale std_formal
    # (n,) part of std that the recording does not reduce, by its source: "imu0.intrinsics", "board0.size"
    std_by: Mapping[str, np.ndarray] = field(default_factory=dict)


@dataclass(frozen=True)
class SensorFit:
    """Goodness of fit of one kind of measurement: chi^2 over post-fit degrees of freedom."""

    sensor: str
    kind: str  # "corners", "gyroscope", "accelerometer", "bias walk", "points", "wheels", "lateral slip", ...
    count: int  # scalar residuals used
    dof: float  # post-fit degrees of freedom
    chi2: float
    rms: float | None = None  # of the raw residual, in `unit`
    unit: str = ""
    rejected: int = 0  # number of rejected outliers among corners

    @property
    def chi2_per_dof(self) -> float | None:
        """chi^2 per degree of freedom, near 1 if residuals are as large as the stated noise predicts. None if `dof` is
        below sqrt(count), which is about the sampling error of `dof`."""
        return float(self.chi2 / self.dof) if self.dof > np.sqrt(self.count) else None


@dataclass(frozen=True)
class Trajectory:
    """State of the reference frame (the IMU, if there is one) at the K keyframes, SI units. Each recording has a world
    frame, z up. seconds: since the first stamp of the reference sensor."""

    seconds: np.ndarray  # (K,)
    rotation: np.ndarray  # (K, 3, 3) R_world_imu
    position: np.ndarray  # (K, 3) m
    velocity: np.ndarray  # (K, 3) m/s
    gyro_bias: np.ndarray  # (K, 3) rad/s
    accel_bias: np.ndarray  # (K, 3) m/s^2


@dataclass(frozen=True)
class RecordingSpan:
    """Start and end of one recording on the clock of the result, where recordings follow one another.

    start, end: times of the first and the last measurement [s]. origin_ns: raw stamp of the body's clock at `start`, so
    that time t of the result is the raw stamp origin_ns + 1e9 (t - start).
    """

    name: str
    start: float
    end: float
    origin_ns: int


@dataclass(frozen=True)
class Iteration:
    """One step of the solver."""

    stage: str
    cost: float  # half the robust chi^2
    predicted_decrease: float
    damping: float
    accepted: bool


@dataclass(frozen=True)
class Visited:
    """Value and formal standard deviation of each estimated group, by (sensor, name), at a state from which the solver
    took a step. Units are those of `ParameterGroup`. The standard deviation is zero for groups that are fixed at the
    initial guess."""

    stage: str
    values: dict[tuple[str, str], np.ndarray]
    std: dict[tuple[str, str], np.ndarray]


@dataclass(frozen=True)
class PointsInImage:
    """Points of a LiDAR in an image: uv (n, 2) px, distance (n,) m from the camera; edge (n,) bool: on depth edges of
    the cloud, see `depth_edges`."""

    uv: np.ndarray
    distance: np.ndarray
    edge: np.ndarray


@dataclass(frozen=True)
class ReportImage:
    """An image of a camera, recorded at `seconds` of the result, for the report.

    title: why it was chosen. jpeg: the whole image, of any size. outline (n, 2) px: of the target; a row of NaN
    separates two lines. file: name of the image, where it tells more than the instant, at a stop. after: points of the
    LiDAR `sensor`; before: the same by the extrinsics and time offsets of the first guess, None if unknown. Both are
    None, and `sensor` is empty, in pictures of the camera alone.
    """

    camera: str
    seconds: float
    title: str
    jpeg: bytes
    outline: np.ndarray
    file: str = ""
    sensor: str = ""
    before: PointsInImage | None = None
    after: PointsInImage | None = None


@dataclass(frozen=True)
class Calibration:
    """Everything that a run estimated, and the inputs that it used."""

    groups: tuple[ParameterGroup, ...]
    covariance: np.ndarray  # (B, B) formal covariance of all estimated parameters, SI, right perturbation
    covariance_names: tuple[str, ...]  # B names: "cam0.rotation.x", ...
    null_space: np.ndarray  # (B, m) unobservable directions, orthonormal in units of the tolerances
    unobservable: tuple[Remark, ...]  # one sentence each: unobservable combination and the missing motion
    fits: tuple[SensorFit, ...]
    residuals: dict[tuple[str, str], Residuals]  # (sensor, kind), such as ("cam0", "corners"); see `by_key`
    trajectory: Trajectory
    iterations: tuple[Iteration, ...]
    converged: bool
    status: str  # one sentence
    warnings: tuple[Remark, ...]  # one sentence each: reasons to use the result with care
    notes: tuple[Remark, ...]  # what was assumed, dropped, repaired
    rig: dict[str, Any] = field(default_factory=dict)  # the rig as plain data
    rates: dict[str, float] = field(default_factory=dict)  # sensor -> Hz, as recorded
    inputs: dict[str, str] = field(default_factory=dict)  # file -> sha256
    settings: dict[str, Any] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    timings: dict[str, float] = field(default_factory=dict)  # stage -> seconds
    made: str = ""  # date and time of the calibration, UTC, ISO 8601; empty if unknown
    recordings: tuple[RecordingSpan, ...] = ()  # in order of time; arrays of seconds cover all of them
    planes: tuple[Plane, ...] = ()  # planes of the scene that LiDAR points lie on
    cross_validation: CrossValidation | None = None  # None if the recording could not be split
    wrong: tuple[Remark, ...] = ()  # those of `warnings` that show an error in the rig file or the recording
    # Effects that were tested and are not in the model, by "sensor.name": value and std [unit] of each of the labels.
    effects: dict[str, dict[str, Any]] = field(default_factory=dict)
    # Known only where the calibration is made, not where it is loaded: rotation, translation and time offset of each
    # sensor in the first guess, if a LiDAR is in the rig; and pictures for the report.
    first_guess: Mapping[tuple[str, str], np.ndarray] = field(default_factory=dict)
    pictures: tuple[ReportImage, ...] = ()

    def residuals_of(self, *kinds: str) -> tuple[Any, ...]:
        """Residual records of these kinds of measurement ("corners", "points", ...), in the order of `kinds`."""
        return tuple(r for kind in kinds for r in self.residuals.values() if r.kind == kind)

    @property
    def image_residuals(self) -> tuple[ImageResiduals, ...]:
        """Residuals of each camera with measurements: of target corners, of tracked points, or of both."""
        return tuple(r for r in (*self.corner_residuals, *self.track_residuals) if len(r.uv))

    @property
    def corner_residuals(self) -> tuple[CornerResiduals, ...]:
        """Corner residuals of each camera that detects a target."""
        return self.residuals_of(CornerResiduals.kind)

    @property
    def track_residuals(self) -> tuple[TrackResiduals, ...]:
        """Residuals of tracked points, one record for each camera; empty if no camera tracks points."""
        return self.residuals_of(TrackResiduals.kind)

    @property
    def imu_residuals(self) -> tuple[ImuResiduals, ...]:
        """Residuals of each IMU, that of the body first."""
        return self.residuals_of(ImuResiduals.kind)

    @property
    def lidar_residuals(self) -> tuple[Any, ...]:
        """Point-to-plane residuals of each LiDAR that observes planes."""
        return self.residuals_of("points")

    @property
    def wheel_residuals(self) -> tuple[RowResiduals, ...]:
        """Residuals of the wheel increments, one record for each set of wheels."""
        return self.residuals_of("increments")

    @property
    def pose_residuals(self) -> tuple[RowResiduals, ...]:
        """Residuals of each pose sensor."""
        return self.residuals_of("poses")

    @property
    def verdict(self) -> Usability:
        """Whether the result can be used; see `icalib.result.verdict`."""
        return usability(self)

    @property
    def reasons(self) -> tuple[Remark, ...]:
        """Sentences on why the verdict is not `usable`, the most important first; empty if it is."""
        return reasons(self)

    @cached_property
    def lens_projections_px(self) -> dict[str, float | None]:
        """By camera: median standard deviation of the projection over the image cells with observations [px]. None if
        the lens is fixed, or its model has no ray in the image."""
        return lens_projections_px(self)

    @property
    def failure(self) -> str:
        """A sentence that the solver did not converge and why; empty if it converged."""
        return "" if self.converged else failure_words(self.status)

    def recording_of(self, seconds: np.ndarray) -> np.ndarray:
        """(n,) index into `recordings` of the recording in which each of `seconds` (n,) lies, on the clock of the
        result."""
        middles = [0.5 * (a.end + b.start) for a, b in pairwise(self.recordings)]
        return np.searchsorted(middles, seconds)

    def group(self, sensor: str, name: str) -> ParameterGroup:
        """The group `name` of `sensor`. Raises KeyError, which lists the existing groups."""
        if (group := self.group_or_none(sensor, name)) is not None:
            return group
        raise KeyError(f"no {name} of {sensor}; there are {', '.join(f'{g.sensor}.{g.name}' for g in self.groups)}")

    def group_or_none(self, sensor: str, name: str) -> ParameterGroup | None:
        """The group `name` of `sensor`; None if the sensor has no such group."""
        return next((g for g in self.groups if g.sensor == sensor and g.name == name), None)

    def T_imu_sensor(self, sensor: str) -> np.ndarray:
        """4x4 pose of `sensor` in the IMU frame, or in the frame of `reference` if there is no IMU. A sensor without a
        rotation, such as an antenna, gets the axes of that frame."""
        T = np.eye(4)
        if (rotation := self.group_or_none(sensor, "rotation")) is not None:
            T[:3, :3] = rotation.value
        T[:3, 3] = self.group(sensor, "translation").value
        return T

    def T_body_sensor(self, sensor: str) -> np.ndarray:
        """4x4 pose of any sensor in the frame of the sensor `body`."""
        if sensor == self.body:
            return np.eye(4)
        return self.T_imu_sensor(sensor) if self.body == self.reference else self.T(self.body, sensor).T

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the rigid bodies of a target that has several, otherwise empty. The first defines the scene
        frame."""
        return tuple(g.sensor for g in self.groups if g.name == "rotation" and g.sensor not in self.rig["sensors"])

    def T_scene_body(self, body: str) -> np.ndarray:
        """4x4 pose of a rigid body of the target in the scene frame, which is the frame of the first of `bodies`."""
        return self.T_imu_sensor(body)

    @property
    def imu(self) -> str | None:
        """Name of the IMU, or None."""
        return next(iter(self.of_type("imu")), None)

    @property
    def body(self) -> str:
        """Name of the sensor relative to which `T_body_sensor` gives poses: `body` of the rig file, or `reference`."""
        return self.rig.get("body") or self.reference

    @property
    def reference(self) -> str:
        """Name of the sensor in whose frame groups and trajectory are given. It is the IMU; without an IMU the first
        camera if the rig has a target, else the first LiDAR or pose sensor; or else the wheels."""
        if self.imu:
            return self.imu
        alone = (*self.lidars, *self.of_type("pose"))
        follow = not ({"target", "targets"} & set(self.rig))
        first = (*alone, *self.cameras) if follow else (*self.cameras, *alone)
        return (*first, *self.of_type("wheels"))[0]

    def of_type(self, kind: str) -> tuple[str, ...]:
        """Names of the sensors of type `kind` in the rig file ("imu", "camera", "lidar", ...), in the order of the
        rig."""
        return tuple(name for name, sensor in self.rig["sensors"].items() if sensor["type"] == kind)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras, in the order of the rig."""
        return self.of_type("camera")

    @property
    def lidars(self) -> tuple[str, ...]:
        """Names of the LiDARs, in the order of the rig."""
        return self.of_type("lidar")

    @property
    def wheels(self) -> tuple[str, ...]:
        """Names of the sets of wheels, in the order of the rig."""
        return self.of_type("wheels")

    @property
    def pose_sensors(self) -> tuple[str, ...]:
        """Names of the pose sensors, in the order of the rig."""
        return self.of_type("pose")

    @property
    def lenses(self) -> dict[str, tuple[str, ...]]:
        """Names of the parameter groups of each lens, by sensor, in the order of the rig; without sensors that have
        none."""
        sensors = self.rig["sensors"].items()
        return {name: lens for name, sensor in sensors if (lens := SENSOR_TYPES[sensor["type"]].lens)}

    @property
    def mounted(self) -> tuple[str, ...]:
        """Names of all sensors except the IMU, ordered by kind as in `SENSOR_KINDS`."""
        return tuple(name for kind in SENSOR_KINDS for name in self.of_type(kind) if name != self.imu)

    @property
    def on_body(self) -> tuple[str, ...]:
        """Names of all sensors except `body`, the IMU first, then ordered by kind as in `SENSOR_KINDS`."""
        return tuple(name for name in (*self.of_type("imu"), *self.mounted) if name != self.body)

    def value(self, sensor: str, name: str) -> np.ndarray:
        """Value of the group `name` of `sensor`, SI: (3, 3) R_imu_sensor of a rotation, else (n,); or () of one
        parameter by its key in calibration.yaml, such as "fx". Raises KeyError, which lists the groups."""
        group, at = self._find(sensor, name)
        return np.asarray(group.value[at])

    def std(self, sensor: str, name: str) -> np.ndarray:
        """(n,) standard deviations of the group `name` of `sensor`, SI, empirical factors included. Those of a rotation
        are about the sensor's axes [rad]. () of one parameter, see `value`."""
        group, at = self._find(sensor, name)
        return np.asarray(group.std[at])

    def _find(self, sensor: str, name: str) -> tuple[ParameterGroup, Any]:
        """The group `name`, and the index of all its entries; or the group with the parameter `name`, and its index."""
        from icalib.result.saving import parameter_keys

        if self.group_or_none(sensor, name) is None:
            groups = tuple(g for g in self.groups if g.sensor == sensor and g.name not in MOUNTED_NAMES)
            for (group, label), key in parameter_keys(groups).items():
                if key == name:
                    return self.group(sensor, group), self.group(sensor, group).labels.index(label)
        return self.group(sensor, name), ...

    def T(self, frame: str, sensor: str) -> RelativePose:
        """T_frame_sensor, which takes coordinates of `sensor` to `frame`, with its (6, 6) covariance.

        `frame` or `sensor` may be the IMU. `np.asarray` of the returned pose is the 4x4 matrix. Raises KeyError, which
        lists the sensors.
        """
        from icalib.result.derived import relative_pose

        known = list(dict.fromkeys([self.reference, *self.mounted]))
        for name in (frame, sensor):
            if name not in known:
                raise KeyError(f"no sensor {name}; there are {', '.join(known)}")
        return relative_pose(self, frame, sensor)

    def summary(self) -> str:
        """Verdict, reasons, and a table of all parameters with standard deviations and verdicts, as text."""
        from icalib.result.quantities import summary_text

        return summary_text(self)

    def to_dataframe(self) -> Any:
        """All parameters as a pandas DataFrame, SI: sensor, group, entry, value, std, unit, verdict, a row for each
        entry. A rotation has the entries roll, pitch and yaw. Raises CalibrationError where pandas is not installed."""
        from icalib.result.quantities import records

        return load_pandas().DataFrame(records(self))

    def export(self, to: str, folder: str | Path) -> tuple[str, ...]:
        """Write the files of another program into `folder`; to: one of `icalib.export.formats.FORMATS`. Returns
        sentences on what the format cannot hold. Raises CalibrationError if files cannot be made or written."""
        from icalib.export.formats import write_export

        return write_export(self, to, folder)

    def report(self, path: str | Path) -> None:
        """Write the report, a page of HTML, to `path`. Raises CalibrationError if it cannot be written, or a file that
        icalib did not write is there."""
        from icalib.base.files import printable, refuse_foreign, write_sealed

        refuse_foreign([Path(path)], (), "choose another name")
        from icalib.report import report_html

        write_sealed(Path(path), printable(report_html(self)))

    def plot_rig(self) -> Any:
        """The sensors in the frame of `reference` as a plotly figure in 3D, with their uncertainty."""
        from icalib.report.page import plotly_figure, rig_figures

        return plotly_figure(rig_figures.rig_picture(self))

    def plot_trajectory(self) -> Any:
        """The trajectory in the world and the target as a plotly figure in 3D."""
        from icalib.report.page import plotly_figure, rig_figures

        return plotly_figure(rig_figures.trajectory(self))

    def plot_residuals(self, sensor: str, kind: str = "") -> Any:
        """Residuals of `sensor` over time as a plotly figure; kind: of several, by default the first. Raises KeyError,
        which lists sensors and kinds."""
        from icalib.report.page import plotly_figure, residuals_over_time

        return plotly_figure(residuals_over_time(self, sensor, kind))

    def plot_coverage(self, camera: str) -> Any:
        """Number of corners or tracked points in use over the image of `camera` as a plotly figure. Raises KeyError,
        which lists the cameras with residuals."""
        from icalib.report.page import image_coverage, plotly_figure

        return plotly_figure(image_coverage(self, camera))

    def __repr__(self) -> str:
        from icalib.result.quantities import one_line

        return one_line(self)

    def _repr_html_(self) -> str:
        from icalib.report.page import summary_html

        return summary_html(self)

    def save(self, folder: str | Path) -> None:
        """Write calibration.yaml, result.json and result.npz (docs/files.md) into `folder`, as one set.

        Raises CalibrationError if the folder cannot be written, or contains files of these names that icalib did not
        write.
        """
        from icalib.base.files import refuse_foreign_set, write_files
        from icalib.result.saving import calibration_files

        refuse_foreign_set(Path(folder))
        write_files(Path(folder), calibration_files(self))


def by_key(records: Iterable[Residuals]) -> dict[tuple[str, str], Residuals]:
    """Residual records by (sensor, kind), as in `Calibration.residuals`."""
    return {(r.sensor, r.kind): r for r in records}


# Two-fold cross-validation of a calibration, and its change if one segment of the recording is left out (jackknife).

SIGNIFICANT = 3.0  # standard deviations of the statistic under pure noise; smaller deviations count as chance


@dataclass(frozen=True)
class PredictedFit:
    """Fit of one kind of residual in one half (fold) of the recording, with the trajectory optimised each time. inside:
    with the calibration from both halves. outside: with the calibration from the other half alone. chi2: chi^2; rms: in
    `unit`, None for residuals without a unit."""

    sensor: str
    kind: str
    count: int
    chi2_inside: float
    chi2_outside: float
    rms_inside: float | None = None
    rms_outside: float | None = None
    unit: str = ""


@dataclass(frozen=True)
class CrossValidation:
    """Two-fold cross-validation: the odd and the even ones of `segments` segments make the two halves (folds).

    directions: number of directions of the calibration that both halves determine. excess: chi^2 of both halves, each
    with the calibration of the other half, minus that with the calibration of both. expected, spread: mean and standard
    deviation of `excess` for noise of the stated sizes. shift (G, B): change of the calibration without each of the G
    segments [SI]; shift_sigma (G, B): its formal standard deviation.
    """

    segments: int
    directions: int
    excess: float
    expected: float
    spread: float
    fits: tuple[PredictedFit, ...]
    shift: np.ndarray
    shift_sigma: np.ndarray

    @property
    def factor(self) -> float:
        """Factor by which the formal standard deviations are too small; near 1 if noise of the stated sizes is the only
        error."""
        return float(np.sqrt(max(self.excess, 0.0) / self.expected))

    @property
    def optimistic(self) -> bool:
        """Whether the formal standard deviations are significantly too small."""
        return self.excess > self.expected + SIGNIFICANT * self.spread

    @property
    def pessimistic(self) -> bool:
        """Whether the formal standard deviations are significantly too large."""
        return self.excess < self.expected - SIGNIFICANT * self.spread

    @property
    def whitened(self) -> np.ndarray:
        """(G, B) `shift` over `shift_sigma`: standard normal if noise is the only error; NaN if the sigma is 0."""
        return self.shift / np.where(self.shift_sigma > 0.0, self.shift_sigma, np.nan)


# Planes of the scene.


@dataclass(frozen=True)
class Plane:
    """A plane of the scene on which LiDAR points lie, in the world frame. normal: unit vector (3,); point: (3,) a point
    on the plane [m]; count: number of points on it, over all LiDARs."""

    name: str
    normal: np.ndarray
    point: np.ndarray
    count: int


# Checks dtypes and shapes of arrays of a result that was read from files, which may have been edited.

_WORDS = {"f": "decimal", "iu": "whole", "b": "boolean"}  # by accepted values of numpy's dtype.kind
_TRAJECTORY: Shapes = {
    "seconds": ("f", "n"),
    "rotation": ("f", "n", 3, 3),
    "position": ("f", "n", 3),
    "velocity": ("f", "n", 3),
    "gyro_bias": ("f", "n", 3),
    "accel_bias": ("f", "n", 3),
}


def check_arrays(c: Calibration) -> None:
    """Raise ValueError, naming the array, if a dtype is wrong or a shape is inconsistent with the other arrays.

    Shapes of the covariance and of the null space are not checked here.
    """
    _check_kind("the covariance", c.covariance, "f")
    _check_kind("the null space", c.null_space, "f")
    for (sensor, _), record in c.residuals.items():
        _check(record, sensor, record.shapes)
    _check(c.trajectory, Trajectory.__name__, _TRAJECTORY)


def _check(part: Any, what: str, shapes: Shapes) -> None:
    """Check the arrays of one object against `shapes`, in which equal names of axes are equal lengths."""
    lengths: dict[str, int] = {"labels": len(getattr(part, "labels", ()))}
    for name, (kind, *axes) in shapes.items():
        array = getattr(part, name)
        _check_kind(f"{name} of {what}", array, str(kind))
        if array.ndim != len(axes) or any(
            n != (lengths.setdefault(a, n) if isinstance(a, str) else a) for a, n in zip(axes, array.shape, strict=True)
        ):
            raise ValueError(f"{name} of {what} has shape {array.shape}, which does not fit the rest")
    if "edges" in lengths:
        start, images, n = part.start, lengths["images"], lengths["n"]
        if len(start) != images + 1 or start[0] != 0 or start[-1] != n or (np.diff(start) < 0).any():
            raise ValueError(f"start of {what} does not divide its points among its images")


def _check_kind(what: str, array: np.ndarray, kinds: str) -> None:
    if array.dtype.kind not in kinds:
        raise ValueError(f"{what} holds {array.dtype}, not {_WORDS[kinds]} values")


# The clock of a result: recordings follow one another with a pause of `PAUSE_S` between them.

PAUSE_S = 1.0


@dataclass(frozen=True)
class Timeline:
    """Conversion from the joined clock of the estimator to the clock of the result. parts, spans: the n recordings on
    the first and on the second. shift (n,): added to the times of each recording [s]."""

    parts: tuple[Part, ...]
    spans: tuple[RecordingSpan, ...]
    shift: np.ndarray

    @classmethod
    def of(cls, parts: tuple[Part, ...], image_times: Mapping[str, np.ndarray], body: str) -> Timeline:
        """Timeline of recordings `parts`. image_times: times of images on the joined clock [s], by the key of their
        stream. body: name of the sensor that defines the joined clock."""
        spans, shift = [], np.zeros(len(parts))
        for k, part in enumerate(parts):
            first, last = _extent(part, image_times, body)
            shift[k] = spans[-1].end + PAUSE_S - first if spans else 0.0
            origin_ns = part.measurements.origin_ns + round(1e9 * (first - part.begin))
            spans.append(RecordingSpan(part.name, first + shift[k], last + shift[k], origin_ns))
        return cls(parts, tuple(spans), shift)

    def on_result_clock(self, seconds: np.ndarray, recording: np.ndarray) -> np.ndarray:
        """(n,) times on the clock of the result, from times (n,) on the joined clock and recording indices (n,) [s]."""
        return seconds + self.shift[recording]

    def recordings_of(self, stream: str) -> np.ndarray:
        """(N,) index of the recording of each stamp of the stream with the key `stream`."""
        counts = [p.rows[stream].stop - p.rows[stream].start for p in self.parts]
        return np.repeat(np.arange(len(counts)), counts)

    def recording_of(self, seconds: np.ndarray) -> np.ndarray:
        """(n,) index of the recording in which each of `seconds` (n,) on the joined clock lies. The body sensor must
        have been running at these times."""
        return np.searchsorted([p.begin for p in self.parts[1:]], seconds, side="right")

    def words(self, second: float) -> str:
        """Text for an instant on the joined clock [s]: seconds since the start of its recording (the nearest image if
        it has no clock), and the name of that if there are several. The body sensor must have been running."""
        part = self.parts[int(self.recording_of(np.array(second)))]
        m, since = part.measurements, second - part.begin
        text = f"{since:.3f} s" if m.has_clock else f"image {m.cameras[0].nearest(since)}"
        return text if len(self.parts) == 1 else f"{text} of {part.name}"

    @property
    def can_be_cut(self) -> bool:
        """Whether --from and --to select a part: there is one recording, and it has a clock."""
        return len(self.parts) == 1 and self.parts[0].measurements.has_clock


def _extent(part: Part, image_times: Mapping[str, np.ndarray], body: str) -> tuple[float, float]:
    """Times of the first and the last measurement of a recording, on the joined clock [s]."""
    images = [times[part.rows[key]] for key, times in image_times.items()]
    if not images or part.measurements.imu is not None:  # else the clock is that of a camera
        images.append(part.begin + part.measurements.streams[body].seconds)
    times = np.concatenate(images)
    return float(times.min()), float(times.max())


# Converts residuals of a factor of the estimator to a record in the result.

CLIP = 4.0  # standard deviations, so that outliers do not dominate the correlation


def row_record(
    kind: str, rows: Sequence[ResidualRows], timeline: Timeline, labels: Mapping[str, tuple[str, ...]] | None = None
) -> RowResiduals:
    """One record of all residuals `rows` of one factor, which have the same times. kind: name of the record. labels:
    names of the columns by kind of residual; the default is the kind, followed by the axis (or index) if there are
    several columns."""
    names = {r.kind: _labels(r) for r in rows} | dict(labels or {})
    columns = [(label, r.unit) for r in rows for label in names[r.kind]]
    seconds = timeline.on_result_clock(rows[0].seconds, timeline.recording_of(rows[0].seconds))
    residual, whitened = (np.hstack([getattr(r, name) for r in rows]) for name in ("residual", "whitened"))
    return RowResiduals(
        rows[0].sensor,
        kind,
        tuple(label for label, _ in columns),
        tuple(unit for _, unit in columns),
        seconds,
        residual,
        whitened,
    )


def _labels(r: ResidualRows) -> tuple[str, ...]:
    n = r.residual.shape[1]
    if n == 1:
        return (r.kind,)
    return tuple(f"{r.kind} {mark}" for mark in (AXES if n == len(AXES) else range(1, n + 1)))


def lag_one_correlation(whitened: np.ndarray) -> float:
    """Lag-one autocorrelation of whitened residuals (n, m) over all columns, with values clipped at `CLIP`; 0 if n <
    2."""
    clipped = np.clip(whitened, -CLIP, CLIP)
    return float((clipped[1:] * clipped[:-1]).sum() / max((clipped**2).sum(), 1e-30))
