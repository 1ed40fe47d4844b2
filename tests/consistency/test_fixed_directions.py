"""Where estimates begin in which unobservable directions are held."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.estimate.estimate import Callbacks
from icalib.estimate.solver import Step, minimise
from icalib.initialize.rig_guess import guess_of_rig
from icalib.observability import determination, prior_sensitivity
from icalib.observability.determination import determine
from icalib.tools.simulation import rig_for, simulate, with_drawn_guess


def test_of_an_estimate_that_failed_no_answers_are_looked_for(robot, monkeypatch):
    """Of a motion that was wrong each took 50 iterations to no end, half an hour all together."""
    estimate = determination.estimate

    def failing(*given, **named):
        found = estimate(*given, **named)
        return replace(found, outcome=replace(found.outcome, converged=False, stopped_early=False))

    monkeypatch.setattr(determination, "estimate", failing)
    monkeypatch.setattr(prior_sensitivity, "_factors", None)
    scenario = robot("planar", 4.0, "lw")
    rig = with_drawn_guess(rig_for(scenario), scenario, 0)
    found = determine(*guess_of_rig(rig, [simulate(scenario, 0).measurements])[:2])
    assert not found.estimate.outcome.converged
    assert found.fixed_directions.shape[1] == found.shifts.shape[0] > 0


def test_held_directions_are_moved_in_the_estimate_without_them(robot):
    """From the guess the way down is another with fewer directions free, and may end elsewhere: seed 1002 of the
    planar scenario of Table II did."""
    scenario = robot("planar", 6.0, "lw")
    simulation = simulate(scenario, 0)
    rig = with_drawn_guess(rig_for(scenario), scenario, 0)
    inputs, state, guess = guess_of_rig(rig, [simulation.measurements])
    fixed_directions, steps = [0], list[tuple[int, str, Step]]()
    found = determine(
        inputs,
        state,
        guess,
        Callbacks(
            lambda stage, step: steps.append((fixed_directions[-1], stage, step)),
            lambda stage, problem, visit: fixed_directions.append(problem.fixed_directions.size),
        ),
    )
    assert found.fixed_directions.shape[1] > 0
    again = next(k for k, (n, _, _) in enumerate(steps) if n > 0)
    ended, begun = steps[again - 1][2].cost, steps[again][2].cost
    assert steps[0][2].cost > 10.0 * ended
    assert begun < 1.01 * ended
    assert {stage for _, stage, _ in steps[again:]} == {"final"}  # what was judged of noise stands


def test_consider_covariance_has_the_responses_of_solved_estimates(robot):
    """On a plane the baseline of wheels changes with their roll, to first and to second order."""
    scenario = robot("planar", 8.0, "lw")
    rig = with_drawn_guess(rig_for(scenario), scenario, 0)
    found = determine(*guess_of_rig(rig, [simulate(scenario, 0).measurements])[:2])
    outcome, fixed = found.estimate.outcome, found.fixed_directions
    problem, m = outcome.problem, fixed.shape[1]
    baseline = problem.layout.block("wheel0", "baseline").columns[0]
    C = fixed.T @ (found.shifts[:m].T @ found.shifts[:m] / np.outer(problem.tolerance, problem.tolerance)) @ fixed
    errors = fixed @ np.linalg.cholesky(C)

    def solved(error: np.ndarray) -> float:
        """Baseline after the guess moved by `error`."""
        still = np.zeros((problem.n_keyframes, 15))
        end = minimise(problem, outcome.state.retract(problem.layout, still, problem.tolerance * error))
        assert end.converged
        return float(end.state.values["wheel0", "baseline"][0])

    moves = [[*(errors * sign).T, *(sign * (errors[:, i] + errors[:, j]) for i, j in pairs(m))] for sign in (0.3, -0.3)]
    up, down = (np.array([solved(e) for e in side]) for side in moves)
    middle = solved(np.zeros(len(errors)))
    odd, even = (up - down)[:m] / 0.6, (up + down - 2.0 * middle) / 0.3**2
    second = np.diag(even[:m])
    for k, (i, j) in enumerate(pairs(m)):
        second[i, j] = second[j, i] = 0.5 * (even[m + k] - even[i] - even[j])
    expected = odd @ odd + 0.25 * np.trace(second) ** 2 + 0.5 * (second**2).sum()
    assert 0.25 * np.trace(second) ** 2 > 0.05 * odd @ odd  # both matter
    assert (found.shifts[:, baseline] ** 2).sum() == pytest.approx(expected, rel=0.01)


def pairs(m: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(m) for j in range(i)]
