"""Products of many vectors."""

from __future__ import annotations

import numpy as np

from icalib.geometry.small import cross


def test_cross_product_is_numpys_and_broadcasts():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(7, 1, 3)), rng.normal(size=(7, 2, 3))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b), rtol=1e-14, atol=1e-14)
    np.testing.assert_allclose(cross(b, a), -np.cross(a, b), rtol=1e-14, atol=1e-14)
