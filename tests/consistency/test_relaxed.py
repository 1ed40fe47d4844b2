"""The solution in which fixed values are free, and some of them fixed again without solving anew."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.initialize.rig_guess import guess_of_rig
from icalib.observability.determination import classify_directions, determine
from icalib.observability.prior_sensitivity import freed_inputs, relaxed
from icalib.optim.arrowhead import solve
from icalib.rig import Parameter
from icalib.tools.simulation import handheld, rig_for, simulate

LENS, MOUNT = ("cam0", "distortion"), ("cam0", "translation")


@pytest.fixture(scope="module")
def estimated():
    made = handheld(10.0)
    simulation, rig = simulate(made, 3), rig_for(made)
    p = simulation.truth.T_imu_sensor["cam0"][:3, 3]
    own = replace(rig.cameras[0], translation=Parameter("prior", p + 1e-3, np.full(3, 1e-3)))
    inputs, state, guess = guess_of_rig(rig.with_(cameras=(own, *rig.cameras[1:])), [simulation.measurements])
    return inputs, determine(inputs, state, guess=guess).estimate


def test_some_groups_alone_are_free_as_in_a_problem_of_their_own(estimated):
    """LENS is fixed and MOUNT has a prior in the rig file; intrinsics stay fixed."""
    inputs, found = estimated
    stated = relaxed(inputs, found)
    assert stated is not None
    keys = [LENS, MOUNT]
    outcome, gradient = stated.without(keys)
    columns = np.setdiff1d(np.arange(stated.layout.size), stated.fixed_columns(keys))
    freed = freed_inputs(inputs, keys)
    problem = found.measurement_model.problem(freed, stated.state)
    pieces = problem.pieces()
    problem.linearise(stated.state, pieces, problem.residuals(), curved=True)
    own = solve(pieces, problem.n_keyframes, problem.tolerance)
    assert 0 < problem.layout.size == len(columns) < stated.layout.size
    t = problem.tolerance
    one, other = (t[:, None] * x * t for x in (outcome.information[np.ix_(columns, columns)], own.information))
    np.testing.assert_allclose(one, other, atol=1e-8 * np.abs(other).max())
    np.testing.assert_allclose(t * gradient[columns], t * own.gradient[:-1], atol=1e-6 * np.sqrt(np.diag(other)).max())
    # What noise adds is found by other draws.
    seen = classify_directions(stated.inputs, outcome, columns=columns)
    alone = classify_directions(
        freed, replace(outcome, problem=problem, information=own.information, draws=None, workspace=None)
    )
    assert seen.unobservable.shape[1] == alone.unobservable.shape[1] == 0
    np.testing.assert_allclose(seen.data, alone.data, atol=0.02 * np.abs(alone.data).max())
