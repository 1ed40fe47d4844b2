"""Compares two calibrations, block by block (rotation, translation, time offset, lens, ...)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from math import erfc, exp, floor, gamma, log10, sqrt
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from icalib.base.files import json_text, printable
from icalib.errors import CalibrationError
from icalib.estimate.inputs import groups_of
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.result import Calibration, joint_covariance, relative_pose
from icalib.result.verdict import UNUSABLE
from icalib.rig import Parameter, ParameterSpec, Sensor
from icalib.rig.file import load_rig
from icalib.rig.rig import SENSOR_TYPES
from icalib.sensors.parameter import display_unit
from icalib.sensors.sensor import CLOCK_RATE, ROTATION, TIME_OFFSET, TRANSLATION

_GRID = (24, 18)  # columns and rows of the grid of pixels at which lenses are compared


@dataclass(frozen=True)
class ComparisonTolerances:
    """Differences up to these tolerances are ignored. None: the tolerance is 0 if a standard deviation is known, else
    that of `DEFAULT_TOLERANCES`."""

    deg: float | None = None
    mm: float | None = None
    ms: float | None = None
    px: float | None = None  # RMS over the image
    percent: float | None = None  # of radii, baselines, noise

    def of(self, unit: str, has_sigma: bool) -> float:
        given = getattr(self, unit)
        return given if given is not None else (0.0 if has_sigma else DEFAULT_TOLERANCES[unit])


@dataclass(frozen=True)
class Difference:
    """Difference of one block that both sides have, B minus A.

    sensor, frame: the block is of `sensor`, relative to `frame`. what: "rotation", "translation", "lens", or the name
    of a quantity. vector (n,): rotation vector in the sensor's axes [deg], translation in the axes of `frame` [mm],
    other quantities in `unit`; entries are named by `labels`. size: norm of `vector`; for a lens, RMS distance of image
    points [px]. std (n,), sigmas: from both sides, None if unknown; given_by: the sides that have standard deviations
    ("both", "A", "B", ""). differs: beyond tolerance and limit. open: sides ("A", "B") in which the block is
    unusable. most: for a lens, the largest distance of image points [px].
    """

    sensor: str
    frame: str
    what: str
    unit: str
    labels: tuple[str, ...]
    vector: tuple[float, ...]
    size: float
    std: tuple[float, ...] | None
    sigmas: float | None
    given_by: str
    tolerance: float
    differs: bool
    open: tuple[str, ...] = ()
    most: float | None = None


@dataclass(frozen=True)
class Comparison:
    """Result of a comparison. reference: the sensor to which poses are relative; notes: what could not be compared."""

    a: Side
    b: Side
    reference: str
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]

    @property
    def same(self) -> bool:
        return not any(d.differs for d in self.differences)


@dataclass(frozen=True)
class _Change:
    """Change of one block from side A to side B, in SI units. covariances: of both sides, NaN if unknown."""

    labels: tuple[str, ...]
    vector: np.ndarray
    covariances: tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class _Pair:
    """Two sides, with the tolerances and the limit in standard deviations above which they differ."""

    a: Side
    b: Side
    tolerances: ComparisonTolerances
    limit: float  # sigmas

    def difference(
        self,
        names: tuple[str, str, str],
        change: _Change,
        display: tuple[str, float],
        open_: tuple[str, ...],
        lens: tuple[float, float] | None = None,
    ) -> Difference:
        """The difference of one block. names: sensor, frame, what; display: unit, and factor from SI to it; open_:
        sides on which the block is unusable; lens: RMS and largest distance of image points [px]."""
        vector, covariances, (unit, scale) = change.vector, change.covariances, display
        known = [bool(np.isfinite(c).all() and c.any()) for c in covariances]
        total = sum((np.zeros_like(c) if not np.isfinite(c).all() else c for c in covariances), np.zeros((1, 1)))
        count = sigmas(vector, total) if any(known) else None
        size = float(scale * np.linalg.norm(vector)) if lens is None else lens[0]
        tolerance = self.tolerances.of(unit, count is not None)
        std = tuple((scale * np.sqrt(np.diag(total))).tolist()) if any(known) else None
        return Difference(
            *names,
            unit=unit,
            labels=change.labels,
            vector=tuple((scale * vector).tolist()),
            size=size,
            std=std,
            sigmas=count,
            given_by={(True, True): "both", (True, False): "A", (False, True): "B"}.get((known[0], known[1]), ""),
            tolerance=tolerance,
            differs=bool(size > tolerance and (count is None or count > self.limit)),
            open=open_,
            most=None if lens is None else lens[1],
        )


def compare_sides(a: Side, b: Side, tolerances: ComparisonTolerances | None = None, limit: float = 3.0) -> Comparison:
    """Compares all blocks that both sides have. A block differs if its change exceeds the tolerance and, if standard
    deviations are known, also `limit` of them.

    Raises CalibrationError if the sides have no block in common.
    """
    if a.has_imu and b.has_imu and a.body != b.body:
        b = b.renamed(b.body, a.body)
    pair = _Pair(a, b, tolerances or ComparisonTolerances(), limit)
    shared = [name for name in a.poses if name in b.poses]
    reference = a.body if a.body == b.body else next(iter(shared), a.body)
    differences = tuple(_poses(pair, reference, shared)) + tuple(_quantities(pair)) + tuple(_lenses(pair))
    if not differences:
        raise CalibrationError(
            f"{a.path} ({_names(a)}) and {b.path} ({_names(b)}) have nothing in common to compare; the names "
            "of sensors must match, or give --frame SENSOR=NAME."
        )
    return Comparison(a, b, reference, differences, _notes(a, b, shared))


def _names(side: Side) -> str:
    return ", ".join(side.sensors) or "no sensors"


def _notes(a: Side, b: Side, shared: list[str]) -> tuple[str, ...]:
    notes = []
    for side, other in ((a, b), (b, a)):
        alone = [name for name in side.poses if name not in shared and name != side.body]
        if alone:
            notes.append(f"only {side.path} has {', '.join(alone)}.")
        missing = [n for n in shared if (np.isnan(side.poses[n]) & ~np.isnan(other.poses[n])).any()]
        if missing:
            notes.append(f"{side.path} gives only a part of the pose of {', '.join(missing)}.")
    if a.has_imu != b.has_imu:
        notes.append("only one side has an IMU, so poses are compared relative to a sensor that both have.")
    return tuple(notes)


def _poses(pair: _Pair, reference: str, shared: list[str]) -> Iterator[Difference]:
    """Poses of each sensor relative to the reference; those of cameras also relative to the first camera, which are
    known more accurately."""
    for sensor in shared:
        if sensor != reference and reference in shared:
            yield from _pose(pair, reference, sensor)
    cameras = [name for name in shared if name in pair.a.lenses or name in pair.b.lenses]
    for sensor in cameras[1:]:
        if cameras[0] != reference:
            yield from _pose(pair, cameras[0], sensor)


def _pose(pair: _Pair, frame: str, sensor: str) -> Iterator[Difference]:
    Ta, Tb = (side.T(frame, sensor) for side in (pair.a, pair.b))
    Ca, Cb = (side.covariance(frame, sensor) for side in (pair.a, pair.b))
    open_ = {name: _open(pair, frame, sensor, name) for name in ("rotation", "translation")}
    if np.isfinite([Ta[:3, :3], Tb[:3, :3]]).all():
        turn = so3.log(np.ascontiguousarray(Ta[:3, :3].T @ Tb[:3, :3]))
        change = _Change(("x", "y", "z"), turn, (Ca[:3, :3], Cb[:3, :3]))
        yield pair.difference((sensor, frame, "rotation"), change, ("deg", 180.0 / np.pi), open_["rotation"])
    if np.isfinite([Ta[:3, 3], Tb[:3, 3]]).all():
        change = _Change(("x", "y", "z"), Tb[:3, 3] - Ta[:3, 3], (Ca[3:, 3:], Cb[3:, 3:]))
        yield pair.difference((sensor, frame, "translation"), change, ("mm", 1e3), open_["translation"])


def _open(pair: _Pair, frame: str, sensor: str, name: str) -> tuple[str, ...]:
    sides = (("A", pair.a), ("B", pair.b))
    return tuple(letter for letter, side in sides if {(frame, name), (sensor, name)} & side.open)


def _quantities(pair: _Pair) -> Iterator[Difference]:
    clocks = pair.a.has_imu and pair.b.has_imu  # else time offsets may be relative to different clocks
    for (sensor, key), qa in pair.a.quantities.items():
        qb = pair.b.quantities.get((sensor, key))
        if qb is None or (key == TIME_OFFSET.name and not clocks):
            continue
        vector, (Ca, Cb) = qb.value - qa.value, (qa.covariance, qb.covariance)
        # Quantities without a unit, such as the intrinsics of an IMU, are ratios already.
        display = display_unit(qa.unit) if qa.unit and not qa.is_relative else ("percent", 1e2)
        if qa.is_relative:
            relative = np.outer(1.0 / qa.value, 1.0 / qa.value)
            vector, Ca, Cb = vector / qa.value, Ca * relative, Cb * relative
        change = _Change(qa.labels, vector, (Ca, Cb))
        yield pair.difference((sensor, pair.a.body, qa.what), change, display, _open_of(qa, qb))


def _lenses(pair: _Pair) -> Iterator[Difference]:
    for sensor, la in pair.a.lenses.items():
        lb = pair.b.lenses.get(sensor)
        if lb is None:
            continue
        same = la.model == lb.model
        labels = camera_model(la.model).parameter_names if same else ()
        vector = lb.params - la.params if same else np.zeros(0)
        unknown = np.full((0, 0), np.nan)
        change = _Change(labels, vector, (la.covariance, lb.covariance) if same else (unknown, unknown))
        yield pair.difference((sensor, sensor, "lens"), change, ("px", 1.0), _open_of(la, lb), distance_px(la, lb))


def _open_of(a: Quantity | LensSide, b: Quantity | LensSide) -> tuple[str, ...]:
    return tuple(letter for letter, one in (("A", a), ("B", b)) if one.open)


def distance_px(a: LensSide, b: LensSide) -> tuple[float, float]:
    """RMS and largest distance [px] between the image points of the two lenses. The points are a grid of pixels of
    lens a, and the projections of their rays by lens b."""
    width, height = a.resolution
    u, v = np.meshgrid(np.linspace(0, width - 1, _GRID[0]), np.linspace(0, height - 1, _GRID[1]))
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, ok = camera_model(a.model).unproject(a.params, uv)
    projections, valid = camera_model(b.model).project(b.params, rays[ok])
    off = np.linalg.norm(projections - uv[ok], axis=1)[valid]
    return float(np.sqrt((off**2).mean())), float(off.max())


# Sides of a comparison from a result of icalib, or from a rig file with values from CAD or a data sheet.

DENSITIES = {
    "gyro": "noise density of the gyroscope",
    "gyro_walk": "bias walk of the gyroscope",
    "accel": "noise density of the accelerometer",
    "accel_walk": "bias walk of the accelerometer",
}


def compared_specs(kind: type[Sensor]) -> dict[str, ParameterSpec]:
    """The parameters of a kind of sensor that are compared as quantities, by name. Extrinsics are compared as poses,
    and parameters of a lens by projection. The rate of a clock changes with its temperature."""
    return {s.name: s for s in kind.stated() if s not in (ROTATION, TRANSLATION, CLOCK_RATE) and not s.by_images}


def noise_quantities(imu: str, noise: dict[str, Any]) -> dict[tuple[str, str], Quantity]:
    """Noise densities as quantities by (imu, name), without standard deviation. noise: densities by name."""
    return {
        (imu, key): Quantity(what, ("",), np.array([float(noise[key])]), unknown(1)) for key, what in DENSITIES.items()
    }


def side_of_result(c: Calibration, path: str) -> Side:
    """The side of a calibration, with covariances; path: its name in messages."""
    poses = {name: _pose_of_result(c, name) for name in c.mounted} | {c.reference: np.eye(4)}
    bad = [g for g in c.groups if {*UNUSABLE} & {*g.verdict}]
    quantities = {}
    for g in c.groups:
        # If a clock restarts in each recording, its time offsets have no counterpart in another result.
        several = g.name == TIME_OFFSET.name and len(g.value) > 1
        if g.sensor in c.rig["sensors"] and not several:
            spec = compared_specs(SENSOR_TYPES[c.rig["sensors"][g.sensor]["type"]]).get(g.name)
            if spec is not None:
                quantities[g.sensor, g.name] = quantity(spec, g.value, joint_covariance(c, [g]), g in bad)
    if c.imu is not None:
        quantities |= noise_quantities(c.imu, c.rig["sensors"][c.imu]["noise"])
    return Side(
        path=path,
        kind="result",
        body=c.reference,
        has_imu=c.imu is not None,
        poses=poses,
        covariance=lambda frame, sensor: relative_pose(c, frame, sensor).covariance,
        open=frozenset((g.sensor, g.name) for g in bad),
        quantities=quantities,
        lenses={name: _lens_of_result(c, name) for name in c.lenses},
    )


def _pose_of_result(c: Calibration, sensor: str) -> np.ndarray:
    """(4, 4) T_body_sensor; the rotation is NaN if the sensor has none, such as a position sensor."""
    T = c.T_imu_sensor(sensor)
    if not any((g.sensor, g.name) == (sensor, ROTATION.name) for g in c.groups):
        T[:3, :3] = np.nan
    return T


def _lens_of_result(c: Calibration, name: str) -> LensSide:
    groups = [c.group(name, key) for key in c.lenses[name]]
    is_open = any({*UNUSABLE} & {*g.verdict} for g in groups)
    return _lens(c.rig["sensors"][name], [g.value for g in groups], joint_covariance(c, groups), is_open)


def _lens(fields: dict[str, Any], values: list[np.ndarray], covariance: np.ndarray, is_open: bool = False) -> LensSide:
    """A lens. fields: those of its sensor in the rig file; values: those of its parameter groups."""
    width, height = fields["resolution"]
    return LensSide(fields["model"], (int(width), int(height)), np.concatenate(values), covariance, is_open)


def side_of_rig(path: Path) -> Side:
    """The side of a rig file: its guesses, fixed values and priors, the latter with their sigma. Raises RigError if the
    file is wrong."""
    rig = load_rig(path)
    poses = {s.name: _pose_of_rig(s) for s in rig.mounted} | {rig.reference: np.eye(4)}
    quantities = {}
    for s, name, p in groups_of(rig):
        spec = compared_specs(type(s)).get(name)
        if spec is not None and p.value is not None:
            quantities[s.name, name] = quantity(spec, p.value, _covariance(p, p.size))
    if rig.imu is not None:
        noise = {key: getattr(rig.imu.noise, key) for key in DENSITIES}
        quantities |= noise_quantities(rig.imu.name, noise)

    def covariance(frame: str, sensor: str) -> np.ndarray:
        out = unknown(6)
        if frame == rig.reference:
            for block, p in zip((slice(3), slice(3, 6)), _extrinsics(rig.sensors[sensor]), strict=True):
                out[block, block] = _covariance(p, 3)
        return out

    return Side(
        path=str(path),
        kind="rig file",
        body=rig.reference,
        has_imu=rig.imu is not None,
        poses=poses,
        covariance=covariance,
        quantities=quantities,
        lenses={s.name: lens for s in rig.mounted if s.lens and (lens := _lens_of_rig(s)) is not None},
    )


def quantity(spec: ParameterSpec, value: np.ndarray, covariance: np.ndarray, is_open: bool = False) -> Quantity:
    """Quantity of a parameter group. A group of one number has an empty label."""
    labels = spec.labels if spec.size > 1 else ("",)
    what = (spec.one or spec.name).replace("_", " ")
    return Quantity(what, labels, value, covariance, is_open, spec.unit, spec.is_positive)


def _extrinsics(sensor: Sensor) -> tuple[Parameter, Parameter]:
    """Rotation and translation; a Parameter without value if the sensor has none."""
    return getattr(sensor, ROTATION.name, Parameter()), getattr(sensor, TRANSLATION.name, Parameter())


def _pose_of_rig(sensor: Sensor) -> np.ndarray:
    """(4, 4) T_body_sensor; NaN for values that the rig file does not give."""
    (rotation, translation), T = _extrinsics(sensor), np.eye(4)
    T[:3, :3] = np.nan if rotation.value is None else rotation.value
    T[:3, 3] = np.nan if translation.value is None else translation.value
    return T


def _covariance(p: Parameter, size: int) -> np.ndarray:
    return unknown(size) if p.sigma is None else np.diag(np.broadcast_to(p.sigma, size) ** 2)


def _lens_of_rig(sensor: Sensor) -> LensSide | None:
    """The lens of a sensor; None if the rig file does not give all its values."""
    values = [getattr(sensor, name).value for name in sensor.lens]
    if any(value is None for value in values):
        return None
    return _lens(sensor.plain(), values, unknown(sum(map(len, values))))


# One side of a comparison: poses, time offsets, lenses and other quantities of sensors, as far as they are known.

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


# Significance of a difference, in standard deviations of a normal variable.

_SINGULAR = 1e-10  # smaller eigenvalues of the correlation matrix are zero
_SMALLEST_P = 1e-14  # the normal quantile of a smaller probability has lost its digits


def sigmas(difference: np.ndarray, covariance: np.ndarray) -> float | None:
    """Significance of a difference (n,) with covariance (n, n): the two-sided normal deviate that has the p-value of
    its Mahalanobis distance.

    None if the covariance is unknown (NaN), or if an entry with variance 0 differs. Entries with variance 0 that do not
    differ are left out.
    """
    if not np.isfinite(covariance).all():
        return None
    loose = np.diag(covariance) > 0
    if not loose.any() or np.any(difference[~loose] != 0):
        return None
    scale = np.sqrt(np.diag(covariance)[loose])
    correlation = covariance[np.ix_(loose, loose)] / np.outer(scale, scale)
    whitened = difference[loose] / scale
    chi2 = float(whitened @ np.linalg.pinv(correlation, _SINGULAR, hermitian=True) @ whitened)
    dof = int(np.linalg.matrix_rank(correlation, _SINGULAR * len(scale), hermitian=True))
    p = chi2_above(chi2, dof)
    return sqrt(chi2) if p < _SMALLEST_P else max(0.0, NormalDist().inv_cdf(1.0 - 0.5 * p))


def chi2_above(x: float, dof: int) -> float:
    """Probability that chi^2 with `dof` degrees of freedom is above x (Abramowitz and Stegun 26.4.4, 26.4.5)."""
    half = 0.5 * x
    p = erfc(sqrt(half)) if dof % 2 else exp(-half)
    return p + sum(exp(-half) * half ** (0.5 * k - 1.0) / gamma(0.5 * k) for k in range(4 - dof % 2, dof + 1, 2))


# Units of tolerances.

# Tolerances of differences without a known standard deviation.
DEFAULT_TOLERANCES = {"deg": 0.1, "mm": 5.0, "ms": 1.0, "px": 1.0, "percent": 0.1}
UNITS = tuple(DEFAULT_TOLERANCES)


# A comparison as sentences, and as JSON.

_ALONG = 0.95  # a vector is along one axis if this component is a larger share of its norm
ROUNDING = 1e-6  # deg, mm, ms, px, %: smaller differences come from the arithmetic, such as that of unprojection
_TITLES = {True: "same", False: "DIFFERS"}


def lines(comparison: Comparison) -> list[str]:
    """Lines to print: the two sides, a line for each block (differing ones first), notes, and the verdict."""
    c = comparison
    text_lines = [f"A: {c.a.path} ({c.a.kind})", f"B: {c.b.path} ({c.b.kind}); from A to B:"]
    width = max(map(len, _TITLES.values()))
    for d in sorted(c.differences, key=lambda d: not d.differs):
        text_lines.append(f"  {_TITLES[not d.differs]:<{width}}  {sentence(d, c)}")
    text_lines += [f"Note: {note}" for note in c.notes]
    count = sum(d.differs for d in c.differences)
    compared = len(c.differences)
    return [
        *text_lines,
        f"The same in all {compared} that were compared." if c.same else f"{count} of {compared} differ.",
    ]


def sentence(d: Difference, c: Comparison) -> str:
    """A sentence on one difference, such as "cam1 turned by 0.12 deg about its x axis, 4.0 sigma"."""
    relative = "" if d.frame in (c.reference, d.sensor) else f" relative to {d.frame}"
    if d.size < ROUNDING:
        return f"the {d.what} of {d.sensor}{relative} did not change{_open_words(d)}"
    match d.what:
        case "rotation":
            turn = _axis(d, "about its {} axis", "about its axis {}")
            words = f"{d.sensor} turned by {turn}{relative}"
        case "translation":
            along = f"along {{}} of {d.frame}"
            words = f"{d.sensor} moved by {_axis(d, along, along)}"
        case "lens":
            words = (
                f"the lens of {d.sensor} moved points by {digits(d.size)} px RMS, {digits(d.most or 0.0)} px at most"
            )
        case _:
            most = int(np.argmax(np.abs(d.vector)))
            unit = "%" if d.unit == "percent" else d.unit
            label = f"{d.labels[most]} " if d.labels[most] else ""
            words = f"the {label}{d.what} of {d.sensor} changed by {_signed(d.vector[most])} {unit}"
    return f"{words}, {_certainty(d)}"


def comparison_json(comparison: Comparison) -> str:
    """The comparison as JSON."""
    c = comparison
    plain = {
        "a": {"path": c.a.path, "kind": c.a.kind},
        "b": {"path": c.b.path, "kind": c.b.kind},
        "same": c.same,
        "reference": c.reference,
        "differences": [dataclasses.asdict(d) | {"sentence": sentence(d, c)} for d in c.differences],
        "notes": list(c.notes),
    }
    return printable(json_text(plain))


def comparison_html(comparison: Comparison) -> str:
    """The comparison as one HTML document."""
    c = comparison
    return changes_html(
        c,
        c.differences,
        tuple(d for d in c.differences if d.differs),
        title=f"{c.a.path} and {c.b.path}",
        answer=lines(c)[-1],
        trust="good" if c.same else "care",
        notes=c.notes,
    )


def changes_html(
    c: Comparison | None, differences: tuple[Difference, ...], changed: tuple[Difference, ...], **values: object
) -> str:
    """One HTML document about `differences` of `c`, those in `changed` first. c: None if there is nothing to compare;
    values: what else its template names."""
    from icalib.report.page import document  # takes a second

    ordered = sorted(differences, key=lambda d: d not in changed)
    plots = [_plot(ordered, changed)] if any(d.sigmas is not None for d in ordered) else []
    sides = f"A: {c.a.path} ({c.a.kind}), B: {c.b.path} ({c.b.kind})" if c else ""
    rows = [_row(d, c, d in changed) for d in ordered] if c else []
    others = {"residuals": [], "question": "What changed?"}
    return printable(
        document("tools/comparison/page.html", plots, plots=plots, sides=sides, rows=rows, **others | values)
    )


def _row(d: Difference, c: Comparison, changed: bool) -> tuple[str, ...]:
    """Verdict, sentence, and standard deviations of at most three numbers of a difference, as text."""
    std = f"{', '.join(map(digits, d.std))} {d.unit}" if d.std and len(d.std) <= 3 else ""
    return "changed" if changed else "same", sentence(d, c), std


def _plot(differences: list[Difference], changed: tuple[Difference, ...]) -> Any:
    """Bars of the sigmas of all differences that have some."""
    from icalib.report.figures import COLORS, REJECTED, axis, figure
    from icalib.report.page import Plot

    known = [d for d in differences if d.sigmas is not None]
    names = [f"{d.sensor} {d.what}" + (f" from {d.frame}" if d.frame != d.sensor else "") for d in known]
    colors = [REJECTED if d in changed else COLORS[0] for d in known]
    sizes = [round(d.sigmas or 0.0, 2) for d in known]
    bars = {"type": "bar", "orientation": "h", "x": sizes, "y": names, "marker": {"color": colors}}
    rows = axis("", automargin=True, autorange="reversed")
    drawn = figure([bars], 24 * len(known) + 110, xaxis=axis("change [sigma]"), yaxis=rows)
    return Plot("changes-in-sigma", drawn, "Size of each change", "In standard deviations of both sides. Red: changed.")


def digits(value: float) -> str:
    """The value with two significant digits; with an exponent below 1e-4 and from 1e5 on."""
    if value == 0.0 or not 1e-4 <= abs(value) < 1e5:
        return f"{value:.1e}" if value else "0"
    return f"{value:.{max(0, 1 - floor(log10(abs(value))))}f}"


def _signed(value: float) -> str:
    return f"{'+' if value >= 0 else '-'}{digits(abs(value))}"


def _axis(d: Difference, one: str, several: str) -> str:
    """Size and direction of a vector. one: format for a coordinate axis, along which the component has its sign;
    several: format for a unit vector."""
    vector = np.array(d.vector)
    most = int(np.argmax(np.abs(vector)))
    if abs(vector[most]) >= _ALONG * d.size:
        return f"{digits(float(vector[most]))} {d.unit} {one.format(d.labels[most])}"
    axis = ", ".join(f"{v:.2f}" for v in vector / d.size)
    return f"{digits(d.size)} {d.unit} {several.format(f'[{axis}]')}"


def _certainty(d: Difference) -> str:
    if d.sigmas is None:
        words = f"no standard deviation is known (tolerance {_tolerance(d)})"
    else:
        words = f"{d.sigmas:.1f} sigma" + (f" of {d.given_by} alone" if d.given_by in ("A", "B") else "")
        words += f" (tolerance {_tolerance(d)})" if d.tolerance > 0 else ""
    return words + _open_words(d)


def _open_words(d: Difference) -> str:
    return f", unobservable or too uncertain in {' and '.join(d.open)}" if d.open else ""


def _tolerance(d: Difference) -> str:
    return f"{d.tolerance:g} {'%' if d.unit == 'percent' else d.unit}"
