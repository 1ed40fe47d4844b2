"""Positions on the Earth: latitude, longitude and height on the WGS84 ellipsoid, and metres about a point of it."""

from __future__ import annotations

import numpy as np

SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
_E2 = FLATTENING * (2.0 - FLATTENING)  # squared first eccentricity


def earth_centred(latitude: np.ndarray, longitude: np.ndarray, height: np.ndarray) -> np.ndarray:
    """(n, 3) m, Earth-centred and Earth-fixed, of latitude and longitude (n,) rad and height (n,) m over the ellipsoid.

    Source: Hofmann-Wellenhof et al., GNSS (2008), eq. 8.7.
    """
    sine = np.sin(latitude)
    N = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - _E2 * sine**2)  # radius of curvature in the prime vertical
    across = (N + height) * np.cos(latitude)
    return np.stack(
        [across * np.cos(longitude), across * np.sin(longitude), ((1.0 - _E2) * N + height) * sine], axis=-1
    )


def east_north_up(latitude: float, longitude: float) -> np.ndarray:
    """(3, 3) R_enu_earth: its rows are east, north and up at a point, in Earth-centred axes; rad."""
    (sf, cf), (sl, cl) = ((np.sin(x), np.cos(x)) for x in (latitude, longitude))
    return np.array([[-sl, cl, 0.0], [-sf * cl, -sf * sl, cf], [cf * cl, cf * sl, sf]])


def latitude_longitude(xyz: np.ndarray) -> tuple[float, float]:
    """Geodetic latitude and longitude [rad] of a point (3,) m, Earth-centred, by iteration of the latitude."""
    x, y, z = xyz
    across, latitude = float(np.hypot(x, y)), float(np.arctan2(z, np.hypot(x, y)))
    for _ in range(10):  # each round is nearer by a factor of 150 near the surface
        N = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
        latitude = float(np.arctan2(z + _E2 * N * np.sin(latitude), across))
    return latitude, float(np.arctan2(y, x))


def local_metres(xyz: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) m east, north and up of `origin` (3,), of Earth-centred points (n, 3) m; and R_enu_earth (3, 3)."""
    R = east_north_up(*latitude_longitude(origin))
    return (xyz - origin) @ R.T, R
