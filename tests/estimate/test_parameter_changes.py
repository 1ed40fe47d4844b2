"""The test of changes over a recording: against one joint solve, and along a direction that nothing shows."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import block_diag
from tests.cases import each

from icalib.estimate.parameter_changes import Candidate, Change, Scatter, _Form

G, B = 8, 6
COLUMNS, PATTERN = np.arange(3), np.arange(G) - 3.5
CANDIDATE = Candidate(("cam0",), "rotation", np.eye(B)[:, :3], np.ones(3))


def form(J: np.ndarray, gradient: np.ndarray) -> tuple[_Form, np.ndarray]:
    """Form of segments with Jacobians J (G, n, B) that no trajectory links, tolerances 1, and their information (G, B,
    B)."""
    information = np.einsum("gni,gnj->gij", J, J)
    rows = information[:, COLUMNS].reshape(-1, B)
    whole = np.block([[information.sum(axis=0), rows.T], [rows, block_diag(*information[:, COLUMNS][:, :, COLUMNS])]])
    pull = np.concatenate([gradient.sum(axis=0), gradient[:, COLUMNS].ravel()])
    problem = SimpleNamespace(layout=SimpleNamespace(size=B), tolerance=np.ones(B), fixed_directions=np.zeros((0, 0)))
    parts: Any = SimpleNamespace(varying=lambda _: (whole, pull), problem=problem, count=G)
    return _Form.of(parts, COLUMNS).of_candidate(CANDIDATE), information


def test_the_change_is_that_of_a_joint_solve():
    rng = np.random.default_rng(0)
    gradient = 10.0 * rng.standard_normal((G, B))
    tested, information = form(10.0 * rng.standard_normal((G, 30, B)), gradient)
    change = tested.change(PATTERN)
    cross = np.einsum("g,gij->ij", PATTERN, information)[:, COLUMNS]
    changed = np.einsum("g,gij->ij", PATTERN**2, information)[np.ix_(COLUMNS, COLUMNS)]
    inverse = np.linalg.inv(np.block([[information.sum(axis=0), cross], [cross.T, changed]]))
    pull = np.concatenate([gradient.sum(axis=0), (PATTERN[:, None] * gradient)[:, COLUMNS].sum(axis=0)])
    np.testing.assert_allclose(change.step, -(inverse @ pull)[B:], rtol=1e-6)
    np.testing.assert_allclose(change.std, np.sqrt(np.diag(inverse))[B:], rtol=1e-6)
    gain = pull @ inverse @ pull - pull[:B] @ np.linalg.solve(information.sum(axis=0), pull[:B])
    assert change.gain == pytest.approx(gain, rel=1e-6) and change.gain < tested.scatter(1).gain


def test_a_direction_that_nothing_shows_does_not_change():
    """Rounding errors of a singular direction are of either sign."""
    rng = np.random.default_rng(1)
    J, gradient = 10.0 * rng.standard_normal((G, 30, B)), 10.0 * rng.standard_normal((G, B))
    J[:, :, 2] = 0.0
    tested, _ = form(J, gradient)
    tested.information[:, 2, :, 2] -= 1e-4
    change = tested.change(PATTERN)
    assert np.isfinite(change.std).all() and np.abs(change.step).max() < 0.1 and change.gain >= 0.0
    assert np.abs(change.step[2]) < 1e-3 * change.std[2]


def test_a_direction_that_the_data_hardly_determine_does_not_change():
    """Its sigma is more than ten tolerances: it would run away and gain what noise gives."""
    rng = np.random.default_rng(2)
    J, gradient = 10.0 * rng.standard_normal((G, 30, B)), 10.0 * rng.standard_normal((G, B))
    J[:, :, 1] *= 1e-4
    tested, _ = form(J, gradient)
    change = tested.change(PATTERN)
    assert change.dof == 2 and abs(change.step[1]) < 1e-2 and change.std[1] > 9.9


@each(
    ("gain", "rival", "expected"),
    [(900.0, 100.0, True), (900.0, 895.0, False), (90.0, 0.0, False)],
)
def test_a_change_is_judged_by_the_scatter_that_it_leaves(gain: float, rival: float, expected: bool):
    """Of 102 directions with a chi^2 of 1000, and of 10 each."""
    one = Change(("cam0",), "time_offset", "step", 5.0, np.ones(1), np.ones(1), gain, 1, rival)
    assert Scatter(1000.0, 101).exceeded_by(one) is expected
    assert not Scatter(10.0 * gain, 101).exceeded_by(one)
