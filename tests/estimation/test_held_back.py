"""What points that an image's edge stops would still gain."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.estimation.feature_factor import held_back
from icalib.estimation.front_plan import FeatureSums

NONE = np.zeros(0, dtype=np.int64)


def test_it_is_that_of_a_newton_step_and_nothing_where_there_is_no_inverse():
    rng = np.random.default_rng(0)
    sums, J = FeatureSums.zeros(2, NONE, NONE, NONE, 4), rng.normal(size=(5, 3))
    sums.own[0], sums.side[:, :, -1] = J.T @ J, rng.normal(size=(2, 3))
    sums.own[1, 0, 0], sums.side[1, :, -1] = 4.0, [2.0, 0.0, 0.0]
    gradient = sums.side[0, :, -1]
    assert held_back(sums) == pytest.approx(gradient @ np.linalg.solve(J.T @ J, gradient) + 1.0, rel=1e-12)


def test_no_points_hold_nothing_back():
    assert held_back(FeatureSums.zeros(0, NONE, NONE, NONE, 4)) == 0.0
