"""Positions on the Earth: WGS84 latitude, longitude and height, and local east, north, up coordinates."""

from __future__ import annotations

import numpy as np

SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
_E2 = FLATTENING * (2.0 - FLATTENING)  # squared first eccentricity


def earth_centred(latitude: np.ndarray, longitude: np.ndarray, height: np.ndarray) -> np.ndarray:
    """(n, 3) Earth-centred, Earth-fixed positions [m], from latitude and longitude (n,) [rad] and ellipsoidal height
    (n,) [m].

    Source: Hofmann-Wellenhof et al., GNSS (2008), eq. 8.7.
    """
    sine = np.sin(latitude)
    N = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - _E2 * sine**2)  # radius of curvature in the prime vertical
    across = (N + height) * np.cos(latitude)
    return np.stack(
        [across * np.cos(longitude), across * np.sin(longitude), ((1.0 - _E2) * N + height) * sine], axis=-1
    )


def east_north_up(latitude: float, longitude: float) -> np.ndarray:
    """(3, 3) R_enu_earth at latitude and longitude [rad]. Its rows are east, north and up in Earth-centred axes."""
    (sf, cf), (sl, cl) = ((np.sin(x), np.cos(x)) for x in (latitude, longitude))
    return np.array([[-sl, cl, 0.0], [-sf * cl, -sf * sl, cf], [cf * cl, cf * sl, sf]])


def latitude_longitude(xyz: np.ndarray) -> tuple[float, float]:
    """Geodetic latitude and longitude [rad] of an Earth-centred point (3,) [m], by fixed-point iteration of the
    latitude."""
    x, y, z = xyz
    across, latitude = float(np.hypot(x, y)), float(np.arctan2(z, np.hypot(x, y)))
    for _ in range(10):  # each iteration reduces the error by a factor of 150 near the surface
        N = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - _E2 * np.sin(latitude) ** 2)
        latitude = float(np.arctan2(z + _E2 * N * np.sin(latitude), across))
    return latitude, float(np.arctan2(y, x))


def local_metres(xyz: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) east, north, up coordinates [m] relative to `origin` (3,) of Earth-centred points (n, 3) [m]; and
    R_enu_earth (3, 3) at the origin."""
    R = east_north_up(*latitude_longitude(origin))
    return (xyz - origin) @ R.T, R
