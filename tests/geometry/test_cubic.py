"""Cubics, against the polynomial itself."""

from __future__ import annotations

import numpy as np

from icalib.geometry.small import hermite


def test_a_cubic_is_followed_from_its_values_and_slopes_at_both_ends():
    path = np.polynomial.Polynomial([0.7, -1.2, 0.4, 2.5])
    h, slope = 0.3, path.deriv()
    s = np.linspace(0.0, 1.0, 11)
    along = hermite(s, *(np.asarray(x) for x in (path(h) - path(0.0), h * slope(0.0), h * slope(h))))
    np.testing.assert_allclose(path(0.0) + along, path(h * s), atol=1e-15)
