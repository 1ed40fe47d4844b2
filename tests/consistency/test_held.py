"""Where estimates begin in which undetermined directions are held."""

from __future__ import annotations

from icalib.estimation.determination import determine
from icalib.estimation.solver import Step
from icalib.first_guess.start import start
from icalib.simulation import rig_for, simulate, with_drawn_guess


def test_held_directions_are_moved_in_the_estimate_without_them(robot):
    """From the guess the way down is another with fewer directions free, and may end elsewhere: seed 1002 of the
    planar scenario of Table II did."""
    scenario = robot("planar", 12.0, "lw")
    simulation = simulate(scenario, 0)
    rig = with_drawn_guess(rig_for(scenario), scenario, 0)
    inputs, state, guess = start(rig, [simulation.measurements])
    steps: list[tuple[str, Step]] = []
    found = determine(inputs, state, lambda stage, step: steps.append((stage, step)), guess=guess)
    assert found.held.shape[1] > 0
    again = next(k for k in range(1, len(steps)) if steps[k - 1][0] == "final" and steps[k][0] == "first")
    ended, begun = steps[again - 1][1].cost, steps[again][1].cost
    assert steps[0][1].cost > 10.0 * ended
    assert begun < 1.01 * ended
