"""What points that an image's edge stops would still gain."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.sensors.camera.features.kernels import held_back


def test_it_is_that_of_a_newton_step_and_nothing_where_there_is_no_inverse():
    rng = np.random.default_rng(0)
    own, J, gradient = np.zeros((2, 3, 3)), rng.normal(size=(5, 3)), rng.normal(size=(2, 3))
    own[0], own[1, 0, 0], gradient[1] = J.T @ J, 4.0, [2.0, 0.0, 0.0]
    expected = gradient[0] @ np.linalg.solve(J.T @ J, gradient[0]) + 1.0
    assert held_back(own, gradient) == pytest.approx(expected, rel=1e-12)


def test_no_points_hold_nothing_back():
    assert held_back(np.zeros((0, 3, 3)), np.zeros((0, 3))) == 0.0
