"""Accelerated steps are exact where steps change linearly with the state."""

from __future__ import annotations

import numpy as np
from tests.cases import each

from icalib.optim.anderson import Accelerator


@each("rates", [(0.2, 1.8), (0.3, 0.6), (1.5, 1.7)])
def test_two_modes_are_solved_by_the_third_step(rates):
    """Of the map x -> x + A (end - x), A with two eigenvalues `rates`, in a space of 16 numbers in several units."""
    rng = np.random.default_rng(0)
    units = np.exp(rng.normal(0.0, 3.0, 16))
    turn = np.linalg.qr(rng.normal(size=(16, 16)))[0]
    A = units[:, None] * (turn @ np.diag(np.resize(rates, 16)) @ turn.T) / units
    end, x, found = units * rng.normal(size=16), np.zeros(16), Accelerator()
    for k in range(3):
        plain = A @ (end - x)
        best = found.step(plain[:15][None], plain[15:], 1.0)
        taken = plain if best is None else np.concatenate([x.ravel() for x in best])
        assert (best is None) == (k == 0)
        found.note((plain[:15], plain[15:]), (taken[:15], taken[15:]), 1.0)
        x = x + taken
    np.testing.assert_allclose(x / units, end / units, atol=1e-9)


def test_steps_that_converge_well_stay_plain():
    found = Accelerator()
    found.note((np.ones((1, 15)), np.ones(1)), (np.ones((1, 15)), np.ones(1)), 1.0)
    assert found.step(np.ones((1, 15)), np.ones(1), 0.05) is None
    assert found.step(np.full((1, 15), 0.5), np.full(1, 0.5), 0.5) is not None
    found.forget()
    assert found.step(np.ones((1, 15)), np.ones(1), 0.5) is None
