"""Fixes as recorded, and as positions in metres relative to the first good one."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from icalib.errors import RecordingError
from icalib.geometry.geodesy import earth_centred, local_metres
from icalib.sensors.position.spec import STATUSES, Status
from icalib.sensors.stream import RawReadings

NO_COVARIANCE = np.zeros((0, 3, 3))
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


def from_geodetic(
    what: str, readings: PositionReadings, degrees: np.ndarray, good: np.ndarray
) -> tuple[PositionReadings, tuple[str, ...]]:
    """Those of `readings` that are `good` (N,) bool, in metres east, north and up of the first, and a note. Covariances
    are in these axes already. degrees (N, 3): latitude and longitude [deg], height over the WGS84 ellipsoid [m].

    Raises RecordingError where latitudes, longitudes or heights cannot be right.
    """
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
