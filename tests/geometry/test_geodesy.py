"""WGS84 against published points and against arcs of the ellipse, integrated."""

from __future__ import annotations

import numpy as np
from scipy.integrate import quad
from tests.cases import each

from icalib.geometry.geodesy import FLATTENING, SEMI_MAJOR_AXIS_M, earth_centred, latitude_longitude, local_metres


def test_the_point_of_the_guidance_note():
    """IOGP publication 373-7-2 (EPSG guidance note 7-2), section 4.1.1: 53 48 33.820 N, 2 07 46.380 E, 73.0 m."""
    latitude, longitude = np.deg2rad(53 + 48 / 60 + 33.820 / 3600), np.deg2rad(2 + 7 / 60 + 46.380 / 3600)
    xyz = earth_centred(np.array([latitude]), np.array([longitude]), np.array([73.0]))
    np.testing.assert_allclose(xyz, [[3771793.968, 140253.342, 5124304.349]], atol=1e-3)
    np.testing.assert_allclose(latitude_longitude(xyz[0]), [latitude, longitude], atol=1e-12)


@each("degrees", [-70.0, 0.0, 40.0, 89.0])
def test_metres_to_the_north_are_the_arc_of_the_meridian(degrees):
    """Of an ellipse by its parametric form; 100 m along it are a chord of 100 m to 1e-8."""
    b = SEMI_MAJOR_AXIS_M * (1.0 - FLATTENING)

    def parametric(latitude):
        return np.arctan((1.0 - FLATTENING) * np.tan(latitude))

    start, end = np.deg2rad(degrees), np.deg2rad(degrees) + 1.5e-5
    arc, _ = quad(
        lambda u: np.hypot(SEMI_MAJOR_AXIS_M * np.sin(u), b * np.cos(u)),
        parametric(start),
        parametric(end),
        epsabs=1e-9,
    )
    points = earth_centred(np.array([start, end]), np.array([0.3, 0.3]), np.zeros(2))
    local, _ = local_metres(points, points[0])
    np.testing.assert_allclose(local[1, :2], [0.0, arc], atol=1e-5)
    assert abs(local[1, 2]) < 2e-3  # the surface falls away by arc^2 / 2 r


def test_up_is_height():
    points = earth_centred(np.full(2, 0.7), np.full(2, -1.8), np.array([1600.0, 1612.5]))
    local, R = local_metres(points, points[0])
    np.testing.assert_allclose(local[1], [0.0, 0.0, 12.5], atol=1e-8)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-15)
