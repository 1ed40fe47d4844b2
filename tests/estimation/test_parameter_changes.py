"""The test of changes over a recording: against one joint solve, and along a direction that nothing shows."""

from __future__ import annotations

import numpy as np

from icalib.estimate.residual_statistics.parameter_changes import _Form

G, B = 8, 6
COLUMNS, PATTERN = np.arange(3), np.arange(G) - 3.5


def form(J: np.ndarray, gradient: np.ndarray) -> tuple[_Form, np.ndarray]:
    """Form of segments with Jacobians J (G, n, B), tolerances 1, and their information (G, B, B)."""
    information = np.einsum("gni,gnj->gij", J, J)
    values, vectors = np.linalg.eigh(information.sum(axis=0))
    return _Form(np.ones(B), information, gradient, vectors / np.sqrt(np.maximum(values, 1e-6))), information


def test_the_change_is_that_of_a_joint_solve():
    rng = np.random.default_rng(0)
    gradient = 10.0 * rng.standard_normal((G, B))
    tested, information = form(10.0 * rng.standard_normal((G, 30, B)), gradient)
    change = tested.change(("cam0", "rotation"), COLUMNS, PATTERN, "drift", 0.0)
    cross = np.einsum("g,gij->ij", PATTERN, information)[:, COLUMNS]
    changed = np.einsum("g,gij->ij", PATTERN**2, information)[np.ix_(COLUMNS, COLUMNS)]
    inverse = np.linalg.inv(np.block([[information.sum(axis=0), cross], [cross.T, changed]]))
    pull = np.concatenate([gradient.sum(axis=0), (PATTERN[:, None] * gradient)[:, COLUMNS].sum(axis=0)])
    np.testing.assert_allclose(change.value, -(inverse @ pull)[B:], rtol=1e-6)
    np.testing.assert_allclose(change.sigma, np.sqrt(np.diag(inverse))[B:], rtol=1e-6)


def test_a_direction_that_nothing_shows_does_not_change():
    """Rounding errors of a singular direction are of either sign."""
    rng = np.random.default_rng(1)
    J, gradient = 10.0 * rng.standard_normal((G, 30, B)), 10.0 * rng.standard_normal((G, B))
    J[:, :, 2] = 0.0
    tested, information = form(J, gradient)
    information[:, 2, 2] = -1e-4
    change = tested.change(("cam0", "rotation"), COLUMNS, PATTERN, "drift", 0.0)
    assert np.isfinite(change.sigma).all() and np.abs(change.value).max() < 0.1 and change.gain >= 0.0
    assert np.abs(change.value[2]) < 1e-3 * change.sigma[2]
