"""Compares two calibrations, block by block (rotation, translation, time offset, lens, ...)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from icalib.errors import CalibrationError
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.sensors.parameter_spec import display_unit
from icalib.sensors.sensor import TIME_OFFSET
from icalib.tools.comparison.sides import LensSide, Quantity, Side
from icalib.tools.comparison.significance import sigmas
from icalib.tools.comparison.units import DEFAULT_TOLERANCES

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
