"""Integrals of signals that are linear between stamps, against those of cubics."""

from __future__ import annotations

import numpy as np

from icalib.geometry.small import once_integrated, twice_integrated


def test_integrals_of_a_linear_signal_at_uneven_stamps():
    t = np.array([0.0, 0.1, 0.5, 0.6, 1.3])
    x = np.stack([3.0 - 2.0 * t, np.ones(5)], axis=1)
    once = once_integrated(x, np.diff(t))
    np.testing.assert_allclose(once, np.stack([3.0 * t - t**2, t], axis=1), atol=1e-15)
    twice = twice_integrated(x, once, np.diff(t))
    np.testing.assert_allclose(twice, np.stack([1.5 * t**2 - t**3 / 3.0, 0.5 * t**2], axis=1), atol=1e-15)
    np.testing.assert_array_equal(twice_integrated(x[:, 0], once[:, 0], np.diff(t)), twice[:, 0])
