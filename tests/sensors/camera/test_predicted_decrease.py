"""The cost decrease that Gauss-Newton steps of tracked points predict."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.sensors.camera.track_kernels import predicted_decrease


def test_it_is_that_of_a_newton_step_and_nothing_where_there_is_no_inverse():
    rng = np.random.default_rng(0)
    A_points, J, gradient = np.zeros((2, 3, 3)), rng.normal(size=(5, 3)), rng.normal(size=(2, 3))
    A_points[0], A_points[1, 0, 0], gradient[1] = J.T @ J, 4.0, [2.0, 0.0, 0.0]
    expected = gradient[0] @ np.linalg.solve(J.T @ J, gradient[0]) + 1.0
    assert predicted_decrease(A_points, gradient) == pytest.approx(expected, rel=1e-12)


def test_no_points_predict_no_decrease():
    assert predicted_decrease(np.zeros((0, 3, 3)), np.zeros((0, 3))) == 0.0
