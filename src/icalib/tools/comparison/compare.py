"""Two calibrations, block by block."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from icalib.errors import CalibrationError
from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.sensors.parameter_spec import shown_unit
from icalib.sensors.sensor import TIME_OFFSET
from icalib.tools.comparison.sides import LensSide, Quantity, Side
from icalib.tools.comparison.significance import sigmas
from icalib.tools.comparison.units import DEFAULT_TOLERANCES

_GRID = (24, 18)  # pixels across and down on which lenses are compared


@dataclass(frozen=True)
class ComparisonTolerances:
    """Differences up to these do not count. None: they count by their standard deviations alone, and up to the default
    where there are none."""

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
    """One block that both sides have, B against A.

    what: rotation, translation, lens, or the words of a quantity. vector (n,): rotation vector in the sensor's axes
    [deg], translation in `frame`'s [mm], time offset [ms], of a quantity [percent] by label. size: its norm; of a lens
    RMS [px]. std (n,), sigmas: of both sides together, None where not known; given_by: whose standard deviations they
    are ("both", "A", "B", ""). most: of a lens the largest distance [px]. open: sides ("A", "B") on which the data did
    not determine it.
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
    """reference: the sensor that poses are seen from. notes: what could not be compared, and why."""

    a: Side
    b: Side
    reference: str
    differences: tuple[Difference, ...]
    notes: tuple[str, ...]

    @property
    def same(self) -> bool:
        return not any(d.differs for d in self.differences)


@dataclass(frozen=True)
class _Pair:
    """Two sides, and what counts."""

    a: Side
    b: Side
    tolerances: ComparisonTolerances
    limit: float  # sigmas

    def difference(
        self,
        names: tuple[str, str, str],
        unit: str,
        scale: float,
        labels: tuple[str, ...],
        vector: np.ndarray,
        covariances: tuple[np.ndarray, np.ndarray],
        open_: tuple[str, ...],
        lens: tuple[float, float] | None = None,
    ) -> Difference:
        """names: sensor, frame, what. vector in SI, which times `scale` is in `unit`."""
        known = [bool(np.isfinite(c).all() and c.any()) for c in covariances]
        total = sum((np.zeros_like(c) if not np.isfinite(c).all() else c for c in covariances), np.zeros((1, 1)))
        count = sigmas(vector, total) if any(known) else None
        size = float(scale * np.linalg.norm(vector)) if lens is None else lens[0]
        tolerance = self.tolerances.of(unit, count is not None)
        std = tuple((scale * np.sqrt(np.diag(total))).tolist()) if any(known) else None
        return Difference(
            *names,
            unit=unit,
            labels=labels,
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
    """All that both say. A block differs where it is off by more than its tolerance and, where standard deviations are
    known, by more than `limit` of them.

    Raises CalibrationError where they share nothing.
    """
    if a.has_imu and b.has_imu and a.body != b.body:
        b = b.renamed(b.body, a.body)
    pair = _Pair(a, b, tolerances or ComparisonTolerances(), limit)
    shared = [name for name in a.poses if name in b.poses]
    reference = a.body if a.body == b.body else next(iter(shared), a.body)
    found = tuple(_poses(pair, reference, shared)) + tuple(_quantities(pair)) + tuple(_lenses(pair))
    if not found:
        raise CalibrationError(
            f"{a.path} ({_names(a)}) and {b.path} ({_names(b)}) have nothing in common to compare; the names "
            "of sensors must match, or give --frame SENSOR=NAME."
        )
    return Comparison(a, b, reference, found, _notes(a, b, shared))


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
    """Each sensor as seen from the reference; cameras from the first camera, too, which is known better."""
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
        covariances = Ca[:3, :3], Cb[:3, :3]
        names = (sensor, frame, "rotation")
        yield pair.difference(names, "deg", 180.0 / np.pi, ("x", "y", "z"), turn, covariances, open_["rotation"])
    if np.isfinite([Ta[:3, 3], Tb[:3, 3]]).all():
        covariances = Ca[3:, 3:], Cb[3:, 3:]
        names, move = (sensor, frame, "translation"), Tb[:3, 3] - Ta[:3, 3]
        yield pair.difference(names, "mm", 1e3, ("x", "y", "z"), move, covariances, open_["translation"])


def _open(pair: _Pair, frame: str, sensor: str, name: str) -> tuple[str, ...]:
    sides = (("A", pair.a), ("B", pair.b))
    return tuple(letter for letter, side in sides if {(frame, name), (sensor, name)} & side.open)


def _quantities(pair: _Pair) -> Iterator[Difference]:
    clocks = pair.a.has_imu and pair.b.has_imu  # without, a time offset is against another clock
    for (sensor, key), qa in pair.a.quantities.items():
        qb = pair.b.quantities.get((sensor, key))
        if qb is None or (key == TIME_OFFSET.name and not clocks):
            continue
        change, (Ca, Cb) = qb.value - qa.value, (qa.covariance, qb.covariance)
        # Without a unit, as the intrinsics of an IMU, it is a share already.
        unit, scale = shown_unit(qa.unit) if qa.unit and not qa.is_relative else ("percent", 1e2)
        if qa.is_relative:
            relative = np.outer(1.0 / qa.value, 1.0 / qa.value)
            change, Ca, Cb = change / qa.value, Ca * relative, Cb * relative
        names = (sensor, pair.a.body, qa.what)
        yield pair.difference(names, unit, scale, qa.labels, change, (Ca, Cb), _open_of(qa, qb))


def _lenses(pair: _Pair) -> Iterator[Difference]:
    for sensor, la in pair.a.lenses.items():
        lb = pair.b.lenses.get(sensor)
        if lb is None:
            continue
        away = distance_px(la, lb)
        same = la.model == lb.model
        labels = camera_model(la.model).parameter_names if same else ()
        change = lb.params - la.params if same else np.zeros(0)
        nothing = np.full((0, 0), np.nan)
        covariances = (la.covariance, lb.covariance) if same else (nothing, nothing)
        yield pair.difference(
            (sensor, sensor, "lens"), "px", 1.0, labels, change, covariances, _open_of(la, lb), lens=away
        )


def _open_of(a: Quantity | LensSide, b: Quantity | LensSide) -> tuple[str, ...]:
    return tuple(letter for letter, one in (("A", a), ("B", b)) if one.open)


def distance_px(a: LensSide, b: LensSide) -> tuple[float, float]:
    """RMS and largest distance [px] between where the two project the rays of pixels all over the image of a."""
    width, height = a.resolution
    u, v = np.meshgrid(np.linspace(0, width - 1, _GRID[0]), np.linspace(0, height - 1, _GRID[1]))
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, ok = camera_model(a.model).unproject(a.params, uv)
    there, seen = camera_model(b.model).project(b.params, rays[ok])
    off = np.linalg.norm(there - uv[ok], axis=1)[seen]
    return float(np.sqrt((off**2).mean())), float(off.max())
