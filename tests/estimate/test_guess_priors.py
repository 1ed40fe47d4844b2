"""What guesses are worth while it is not clear yet what the data leave open; afterwards nothing."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from icalib.estimate import estimate as estimates
from icalib.estimate import solver
from icalib.estimate.estimate import Estimate, EstimateOptions, MeasurementModel, estimate
from icalib.estimate.inputs import UNGUESSED_TRANSLATION_SIGMA_M, Inputs
from icalib.estimate.problem import given_priors, guess_priors, guess_sigma
from icalib.estimate.solver import Descent, SolverOptions
from icalib.initialize.rig_guess import guess_of_rig
from icalib.optim.arrowhead import solve
from icalib.optim.state import State
from icalib.rig import Parameter
from icalib.sensors.camera.spec import DISTORTION, INTRINSICS
from icalib.sensors.sensor import ROTATION, TIME_OFFSET
from icalib.tools.simulation import handheld, rig_for, simulate

TURNED = {("cam0", "translation"): np.array([0.05, -0.02, 0.03]), ("cam1", "time_offset"): np.array([2e-3])}


@pytest.fixture(scope="module")
def begun() -> tuple[Inputs, State]:
    """A camera pair of which the rig file gives one time offset as a prior, and nothing else."""
    scenario = handheld(4.0)
    rig = rig_for(scenario)
    given = Parameter("prior", np.array([0.01]), np.array([0.003]))
    rig = rig.with_(cameras=(replace(rig.cameras[0], time_offset=given), *rig.cameras[1:]))
    inputs, state, _ = guess_of_rig(rig, [simulate(scenario, 0).measurements])
    return inputs, state


def test_they_are_as_wide_as_a_guess_is_off_and_never_beside_a_given_one(begun):
    inputs, state = begun
    found = {p.block.key: p for p in guess_priors(inputs, state, times=2.0)}
    camera, other = (c.name for c in inputs.rig.cameras)
    assert (camera, "time_offset") not in found
    np.testing.assert_array_equal(found[other, "time_offset"].sigma, 2.0 * TIME_OFFSET.prior_sigma)
    np.testing.assert_array_equal(found[other, "rotation"].sigma, 2.0 * ROTATION.prior_sigma)
    np.testing.assert_array_equal(found[other, "translation"].sigma, 2.0 * UNGUESSED_TRANSLATION_SIGMA_M)
    assert all(inputs.is_sensor(sensor) for sensor, _ in found)
    for key, prior in found.items():
        residual, _ = prior.residual(state)
        np.testing.assert_allclose(residual, 0.0, atol=1e-12, err_msg=str(key))


def test_the_focal_length_of_a_sphere_model_is_as_uncertain_as_its_xi():
    """Of omni-radtan fx / (1 + xi) is the scale in the image's centre: with it known, fx follows xi."""
    scenario = handheld(4.0)
    lens = {
        "model": "omni-radtan",
        "intrinsics": (450.0, 451.0, 325.0, 238.0),
        "distortion": (1.0, -0.1, 0.02, 0.0, 0.0),
    }
    scenario = replace(scenario, cameras=(replace(scenario.cameras[0], **lens),))
    rig = rig_for(scenario, intrinsics="free", distortion="free")
    inputs, state, _ = guess_of_rig(rig, [simulate(scenario, 0).measurements])
    fx, xi = state.values["cam0", "intrinsics"][0], state.values["cam0", "distortion"][0]
    sigma = guess_sigma(inputs, state)[inputs.layout.columns("cam0", "intrinsics", "distortion")]
    expected = np.hypot(INTRINSICS.prior_sigma, fx / (1.0 + xi) * DISTORTION.prior_sigma)
    np.testing.assert_allclose(sigma[:2], expected, rtol=1e-3)
    np.testing.assert_allclose(sigma[2:4], INTRINSICS.prior_sigma)


def information_of(found: Estimate) -> np.ndarray:
    """Of the calibration parameters where `found` ended, of the problem that it says it is of."""
    problem = found.problem
    pieces = problem.pieces()
    problem.linearise(found.outcome.state, pieces, problem.residuals(), curved=True)
    return solve(pieces, problem.n_keyframes, problem.tolerance, fixed_directions=problem.fixed_directions).information


def same_information(found: Estimate) -> None:
    expected = information_of(found)
    scale = np.outer(*2 * [np.sqrt(np.diag(expected))])
    np.testing.assert_allclose(found.outcome.information / scale, expected / scale, atol=1e-9)


@pytest.mark.parametrize("doubtful", [False, True])
def test_where_they_counted_to_the_end_the_estimate_is_half_way_and_without_them(begun, monkeypatch, doubtful: bool):
    """Guesses are taken to be good to a hundredth, so that they would be missed. To the last digit: by steps until
    nothing is left."""
    monkeypatch.setattr(solver, "SMALL_DECREASE", 0.0)
    monkeypatch.setattr(estimates, "guess_priors", partial(guess_priors, times=1e-2))
    inputs, state = begun
    asked: list[int] = []

    def seems_open(problem, information) -> bool:
        asked.append(len(problem.priors))
        return doubtful

    found = estimate(inputs, state, EstimateOptions(maybe_rank_deficient=seems_open, guess=state))
    given = {p.block.key for p in given_priors(inputs)}
    guessed = {p.block.key for p in guess_priors(inputs, state)}
    left = {p.block.key for p in found.problem.priors}
    assert given <= left
    assert not left & guessed
    assert asked[0] == len(found.problem.priors) + len(guessed)  # in the first pass they count
    assert (asked[-1] == asked[0]) == doubtful
    assert found.outcome.stopped_early == doubtful
    same_information(found)


def test_priors_that_are_let_go_leave_the_step_of_the_problem_without_them(begun):
    """What is taken off the calibration parameters' sums is what a solve without the priors does not have."""
    inputs, state = begun
    problem = MeasurementModel.first(inputs).problem(inputs, state)
    more = guess_priors(inputs, replace(state, values=state.values | TURNED))
    led = replace(problem, priors=(*problem.priors, *more))
    assert led.without(more).priors == problem.priors
    options = SolverOptions(1e-3, 0.0)
    at = Descent.begin(led, state, options)
    freed = at.drop_priors(more, at.solution())
    alone = Descent.begin(problem, state, options)
    expected = alone.solution()
    assert at.cost == pytest.approx(alone.cost, rel=1e-12)
    assert freed.decrease == pytest.approx(expected.decrease, rel=1e-9)
    np.testing.assert_allclose(freed.calib, expected.calib, rtol=1e-7, atol=1e-12)
    np.testing.assert_allclose(freed.chain, expected.chain, rtol=1e-6, atol=1e-10)
    scale = np.sqrt(np.diag(expected.information))
    np.testing.assert_allclose(
        freed.information / np.outer(scale, scale), expected.information / np.outer(scale, scale), atol=1e-9
    )


def test_the_last_step_is_taken_with_the_sums_at_hand(begun, monkeypatch):
    """Letting go of guesses leaves a small step. It ends where more steps would, with one linearisation less, and the
    information is that of the end."""
    monkeypatch.setattr(estimates, "guess_priors", partial(guess_priors, times=1e-2))
    inputs, state = begun
    short = estimate(inputs, state, EstimateOptions(guess=state))
    monkeypatch.setattr(solver, "SMALL_DECREASE", 0.0)
    long = estimate(inputs, state, EstimateOptions(guess=state))
    assert len(short.steps) < len(long.steps)
    assert short.outcome.converged and short.outcome.cost == pytest.approx(long.outcome.cost, abs=1e-4)
    sigma = np.sqrt(np.diag(np.linalg.inv(long.outcome.information)))
    for block in inputs.layout.free:
        if inputs.is_sensor(block.sensor) and block.kind != "rotation":
            apart = short.outcome.state.values[block.key] - long.outcome.state.values[block.key]
            assert np.abs(apart / sigma[block.columns]).max() < 0.01, block.key
    ratio = np.sqrt(np.diag(np.linalg.inv(short.outcome.information))) / sigma
    np.testing.assert_allclose(ratio, 1.0, atol=1e-3)


def test_while_something_is_held_they_count_and_the_estimate_is_half_way(begun, monkeypatch):
    """What is half-way is judged anew; with no guess given it goes to the end."""
    monkeypatch.setattr(estimates, "guess_priors", partial(guess_priors, times=1e-3))
    inputs, state = begun
    fixed_directions = np.zeros((inputs.layout.size, 1))
    fixed_directions[inputs.layout.columns(inputs.rig.cameras[1].name, "translation")[0]] = 1.0
    free = estimate(inputs, state, EstimateOptions(fixed_directions))
    key = inputs.rig.cameras[1].name, "time_offset"
    elsewhere = replace(state, values=state.values | {key: free.outcome.state.values[key] + 5e-3})
    led = estimate(inputs, state, EstimateOptions(fixed_directions, guess=elsewhere))
    assert led.outcome.stopped_early
    assert not free.outcome.stopped_early
    assert len(led.problem.priors) == len(free.problem.priors) == len(given_priors(inputs))
    same_information(led)
    assert led.outcome.state.values[key] - free.outcome.state.values[key] > 0.2 * 5e-3
