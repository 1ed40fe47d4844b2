"""Fixes as recorded, and as positions in metres relative to the first good one.

Tables of positions: metric x, y, z, or latitude, longitude and height; with standard deviations where a header names
them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from icalib.data.images.image_checks import Note, ignore
from icalib.data.tables.columns import STAMP, TableKind, places_by_name
from icalib.data.tables.table import named, read_table
from icalib.errors import RecordingError
from icalib.geometry.geodesy import earth_centred, local_metres
from icalib.sensors.position.read.fixes import RecordedFix
from icalib.sensors.position.spec import STATUSES, PositionSensor, Status
from icalib.sensors.stream import RawReadings

NO_COVARIANCE = np.zeros((0, 3, 3))
Recorded = Literal["geodetic", "earth", "local"]  # coordinates; latitude, longitude and height; Earth-centred; metric
MAX_DISTANCE_M = 20_000.0  # from the first fix: the vertical turns by 3 mrad, which is 0.03 m/s^2 of gravity


@dataclass(frozen=True)
class LocalFrame:
    """A frame relative to the recorded coordinates: origin + axes^T p is the recorded position of p (3,) m. origin (3,)
    m; axes (3, 3): R_local_recorded; on_earth: the recorded coordinates are Earth-centred, or latitude, longitude and
    height."""

    origin: np.ndarray
    axes: np.ndarray
    on_earth: bool = False

    def moved(self, by: np.ndarray) -> LocalFrame:
        """This frame with its origin shifted by `by` (3,) m along its axes."""
        return replace(self, origin=self.origin + by @ self.axes)


AS_RECORDED = LocalFrame(np.zeros(3), np.eye(3))


@dataclass(frozen=True)
class PositionReadings(RawReadings):
    """position (N, 3) m in `frame`, or latitude, longitude [deg] and height [m] until they are converted; covariance
    (N, 3, 3) m^2, or (0, 3, 3); status (N,) index into `STATUSES`, -1: no fix, or (0,) where none is stated."""

    position: np.ndarray
    covariance: np.ndarray
    status: np.ndarray
    frame: LocalFrame = AS_RECORDED

    def inside(self, what: str, frame: LocalFrame, owner: str) -> PositionReadings:
        """The readings in the frame of `owner`. Raises RecordingError if only one of the two frames is on the Earth."""
        if self.frame.on_earth != frame.on_earth:
            kind = "latitudes and longitudes" if self.frame.on_earth else "positions in metres"
            raise RecordingError(
                f"{what}: {kind} cannot be in the frame of {owner}; write frame: levelled in the rig file."
            )
        R = frame.axes @ self.frame.axes.T
        covariance = R @ self.covariance @ R.T if len(self.covariance) else self.covariance
        position = self.position @ R.T + frame.axes @ (self.frame.origin - frame.origin)
        return replace(self, position=position, covariance=covariance, frame=frame)


def good_fixes(status: np.ndarray, least: Status, n: int) -> np.ndarray:
    """(n,) bool: which of n fixes have at least the status `least`; all of them if status, (n,) or (0,), is empty."""
    return status >= STATUSES.index(least) if len(status) else np.ones(n, dtype=bool)


def left_out(what: str, status: np.ndarray, good: np.ndarray, least: Status) -> tuple[str, ...]:
    """A note on fixes that are not good."""
    if good.all():
        return ()
    none, worse = int((status < 0).sum()), int((~good & (status >= 0)).sum())
    parts = [f"{none} without a fix"] * (none > 0) + [f"{worse} worse than {least} (least_status)"] * (worse > 0)
    return (f"{what}: {none + worse} of {len(good)} positions were left out, {' and '.join(parts)}.",)


def from_geodetic(what: str, readings: PositionReadings, good: np.ndarray) -> tuple[PositionReadings, tuple[str, ...]]:
    """Those of `readings` that are `good` (N,) bool, in metres east, north and up of the first, and a note. Covariances
    are in these axes already, positions latitude and longitude [deg] and height over the WGS84 ellipsoid [m].

    Raises RecordingError where latitudes, longitudes or heights cannot be right.
    """
    degrees = readings.position
    usable = good & np.isfinite(degrees).all(axis=1) & (np.abs(degrees[:, :2]) > 1e-9).any(axis=1)
    _refuse_heights(what, degrees, good)
    if not usable.any():
        raise RecordingError(f"{what}: no position has latitude, longitude and height; record again with a fix.")
    latitude, longitude, height = degrees.T
    if (np.abs(latitude[usable]) > 90.0).any():
        swapped = (np.abs(longitude[usable]) <= 90.0).all()
        cause = "latitude and longitude are swapped" if swapped else "it is not in degrees"
        raise RecordingError(
            f"{what}: the first latitude is {latitude[usable][0]:.6g} degrees, as if {cause}; say which "
            "column is which by `columns: [...]` in the rig file."
        )
    xyz = earth_centred(np.deg2rad(latitude), np.deg2rad(longitude), height)
    first = int(np.argmax(usable))
    position, axes = local_metres(xyz, xyz[first])
    away = float(np.linalg.norm(position[usable], axis=1).max())
    if away > MAX_DISTANCE_M:
        raise RecordingError(
            f"{what}: its fixes are up to {away / 1e3:.0f} km from the first one; the plane of east and north does not "
            "follow the Earth so far. Cut the recording with --from and --to, or leave out fixes without a solution."
        )
    note = (
        f"{what}: metres are east, north and up of the first fix, latitude {latitude[first]:.8f}, longitude "
        f"{longitude[first]:.8f}, height {height[first]:.3f} m."
    )
    return replace(readings, position=position, frame=LocalFrame(xyz[first], axes, True)).some(usable), (note,)


def _refuse_heights(what: str, degrees: np.ndarray, good: np.ndarray) -> None:
    height = degrees[good, 2]
    if len(height) and (~np.isfinite(height)).mean() > 0.5:
        raise RecordingError(f"{what}: heights are missing (NaN); write the height over the WGS84 ellipsoid in metres.")
    if len(height) > 2 and (height == 0.0).all():
        raise RecordingError(
            f"{what}: all heights are 0, as if they were missing; write the height over the WGS84 ellipsoid in metres."
        )


def about_first(what: str, readings: PositionReadings) -> tuple[PositionReadings, tuple[str, ...]]:
    """Readings in metres, and a note. If the first position is more than 100 m from the origin of the frame, the origin
    moves to the first position, rounded to whole metres. Raises RecordingError if no position is finite."""
    p = readings.position
    finite = np.isfinite(p).all(axis=1)
    if not finite.any():
        raise RecordingError(f"{what}: no position is finite; correct the program that writes them.")
    origin = np.round(p[int(np.argmax(finite))])
    if np.linalg.norm(origin) <= 100.0:
        return readings, ()
    x, y, z = origin
    note = f"{what}: positions are relative to ({x:.0f}, {y:.0f}, {z:.0f}) m of its frame, whose origin is far away."
    return replace(readings, position=p - origin, frame=readings.frame.moved(origin)), (note,)


def from_fixes(name: str, stamped: Sequence[tuple[int, RecordedFix]]) -> PositionReadings:
    """Readings of fixes with their stamps [ns], geodetic ones not yet in metres."""
    fixes = [fix for _, fix in stamped]
    position = np.array([fix.position for fix in fixes]).reshape(-1, 3)
    covariance = np.array([fix.covariance for fix in fixes]).reshape(-1, 3, 3)
    status = np.array([fix.status for fix in fixes], np.int64)
    usable = usable_covariances(covariance, (status >= 0) & np.isfinite(position).all(axis=1))
    return PositionReadings(name, np.array([stamp for stamp, _ in stamped], np.int64), position, usable, status)


def usable_covariances(covariance: np.ndarray, needed: np.ndarray) -> np.ndarray:
    """The covariances (N, 3, 3), or NO_COVARIANCE unless all that are `needed` (N,) are positive definite."""
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    finite = np.where(np.isfinite(covariance), covariance, 0.0)
    if not needed.any() or not (np.linalg.eigvalsh(finite[needed])[:, 0] > 0.0).all():
        return NO_COVARIANCE
    return np.where(needed[:, None, None], finite, np.eye(3))


FIX_RATES_HZ = (1e-2, 1000.0)  # lowest and highest: other rates show another unit of the stamps
_SIGMA = r"(s|sd|std|stddev|sigma|std_dev)"
METRIC = TableKind(
    ("t [ns]",),
    ("x [m]", "y [m]", "z [m]"),
    (
        STAMP,
        (r"(p|pos|position|point|p_rs_r)_?x|x|east(ing)?|e",),
        (r"(p|pos|position|point|p_rs_r)_?y|y|north(ing)?|n",),
        (r"(p|pos|position|point|p_rs_r)_?z|z|up|u|height|h|altitude|alt",),
    ),
    FIX_RATES_HZ,
)
GEODETIC = TableKind(
    ("t [ns]",),
    ("latitude [deg]", "longitude [deg]", "height [m]"),
    (
        STAMP,
        (r"lat(itude)?(_deg)?",),
        (r"lon(g|gitude)?(_deg)?",),
        (r"(ellipsoid(al)?_)?h(eight)?(_m)?|alt(itude)?(_m)?|hgt|hae",),
    ),
    FIX_RATES_HZ,
)
_DEVIATIONS = (
    (rf"{_SIGMA}_?(x|e|east)",),
    (rf"{_SIGMA}_?(y|n|north)",),
    (rf"{_SIGMA}_?(z|u|up|h)",),
)


def read_position_table(sensor: PositionSensor, path: Path, note: Note = ignore) -> tuple[PositionReadings, Recorded]:
    """The positions in a table, and their coordinates, geodetic or local, as the rig file or the names of the columns
    say. Standard deviations are those of east, north and up, or of x, y and z. Raises
    RecordingError naming file and line."""
    layout, geodetic = sensor.layout, sensor.coordinates == "geodetic"
    if sensor.coordinates is None:
        geodetic = named(path, GEODETIC) if not layout.columns else places_by_name(GEODETIC, layout.columns) is not None
    kind = GEODETIC if geodetic else METRIC
    stated = _with_deviations(kind)
    kind = stated if len(layout.columns) == len(stated.names) or (not layout.columns and named(path, stated)) else kind
    table = read_table(path, kind, layout, note)
    values = table.decimals
    covariance = NO_COVARIANCE
    if values.shape[1] == 6 and (values[:, 3:] > 0.0).all():
        covariance = values[:, 3:, None] ** 2 * np.eye(3)
    readings = PositionReadings(
        sensor.name, table.integers[:, 0].copy(), values[:, :3].copy(), covariance, np.zeros(0, np.int64)
    )
    return readings, "geodetic" if geodetic else "local"


def _with_deviations(kind: TableKind) -> TableKind:
    return replace(kind, decimals=(*kind.decimals, "sx [m]", "sy [m]", "sz [m]"), known=(*kind.known, *_DEVIATIONS))
