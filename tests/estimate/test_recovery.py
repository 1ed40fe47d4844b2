"""Noiseless recordings give the truth back, and the solver says how it ended."""

from dataclasses import replace

import numpy as np
import pytest
from tests.typed import not_none

from icalib.errors import EstimationError
from icalib.estimate import solver
from icalib.estimate.solver import CONVERGED_DECREASE, SolverOptions, minimise
from icalib.geometry import so3
from icalib.motion.factor import of_type
from icalib.optim.arrowhead import N_THREADS, solve
from icalib.pipeline import calibrate_measurements
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.tools.simulation import handheld, rig_for, simulate

pytestmark = pytest.mark.slow

EXACT = 1e-8  # rad, m, s; relative for intrinsics


def recover(setup, problem_of, start, passes=3):
    """Passes of the estimate: readings are preintegrated anew with the biases that the last one found."""
    outcome = None
    for _ in range(passes):
        outcome = minimise(problem_of(setup, start), start)
        assert outcome.converged, outcome.status
        start = outcome.state
    return outcome


def errors(setup, state):
    """Largest error of each lasting parameter; of the board's tilt what is no turn about gravity, which is free."""
    out = {}
    for b in setup.layout.free:
        got, true = state.values[b.key], setup.state.values[b.key]
        if b.kind == "tilt":
            out[b.key] = np.linalg.norm(got[2] - true[2])
        elif b.kind == "rotation":
            out[b.key] = np.abs(so3.log(np.ascontiguousarray(true.T @ got))).max()
        elif b.name == "intrinsics" and b.sensor != "imu0":
            out[b.key] = np.abs(got / true - 1.0).max()
        else:
            out[b.key] = np.abs(got - true).max() * (1e-6 if b.name == "clock_rate" else 1.0)  # ppm
    return out


def without_bias(scenario):
    """The broad prior on the biases of the first keyframe, about zero, then pulls nothing."""
    return replace(scenario, gyro_bias=(0.0,) * 3, accel_bias=(0.0,) * 3)


def too_large(setup, state, bound):
    return {k: e for k, e in errors(setup, state).items() if not e < bound}


@pytest.mark.parametrize("asynchronous", [True, pytest.param(False, marks=pytest.mark.full)])
def test_noiseless_recovery(setup_of, problem_of, asynchronous):
    scenario = without_bias(handheld(5.0, asynchronous=asynchronous, noiseless=True))
    setup = setup_of(simulate(scenario, seed=1))
    outcome = recover(setup, problem_of, setup.perturbed(np.random.default_rng(2), 5.0))
    assert too_large(setup, not_none(outcome).state, EXACT) == {}
    for name in ("position", "velocity"):
        in_board = [getattr(s, name) @ s.values["board0", "tilt"] for s in (not_none(outcome).state, setup.state)]
        assert np.abs(in_board[0] - in_board[1]).max() < EXACT, name
    assert np.abs(not_none(outcome).state.bias).max() < EXACT
    assert not_none(outcome).cost < 1e-9


@pytest.mark.parametrize("asynchronous", [True, pytest.param(False, marks=pytest.mark.full)])
def test_noiseless_recovery_with_biases(setup_of, problem_of, asynchronous):
    """The prior on the first biases takes a share that shrinks with the recording's length: 20 s are enough."""
    setup = setup_of(simulate(handheld(20.0, asynchronous=asynchronous, noiseless=True), seed=1))
    outcome = recover(setup, problem_of, setup.perturbed(np.random.default_rng(2), 5.0))
    found = errors(setup, not_none(outcome).state)
    tilt = found.pop(("board0", "tilt"))
    assert {k: e for k, e in found.items() if not e < EXACT} == {}
    assert tilt < 3e-8
    assert np.abs(not_none(outcome).state.bias - setup.state.bias).max() < 5e-7


def test_noiseless_recovery_of_another_camera_model_and_the_imu_intrinsics(setup_of, problem_of, unlike):
    scenario = without_bias(replace(unlike.scenario, duration_s=5.0, imu_rate_hz=2000.0))
    setup = setup_of(simulate(scenario, seed=1), imu_free=True)
    outcome = recover(setup, problem_of, setup.perturbed(np.random.default_rng(3)), passes=4)
    assert too_large(setup, not_none(outcome).state, EXACT) == {}


@pytest.fixture(scope="module")
def noisy_problem(setup_of, problem_of):
    setup = setup_of(simulate(handheld(3.0), seed=4))
    return problem_of(setup), setup.perturbed(np.random.default_rng(5), 3.0)


def test_costs_of_accepted_steps_fall(noisy_problem):
    problem, start = noisy_problem
    steps = []
    outcome = minimise(problem, start, SolverOptions(on_step=steps.append))
    assert outcome.converged and tuple(steps) == outcome.steps
    costs = [s.cost for s in steps if s.accepted] + [outcome.cost]
    assert all(b < a for a, b in zip(costs[:-2], costs[1:-1], strict=True))
    assert costs[-1] <= costs[-2] * (1.0 + 1e-9)
    assert outcome.status.startswith(f"converged in {len(steps)} iterations of the last pass")
    assert steps[-1].damping == 0.0 and steps[-1].predicted_decrease < CONVERGED_DECREASE


def test_information_is_that_of_the_end_and_without_damping(noisy_problem):
    problem, start = noisy_problem
    outcome = minimise(problem, start)
    pieces = problem.pieces()
    problem.linearise(outcome.state, pieces, problem.residuals())
    expected = solve(pieces, problem.n_keyframes, problem.tolerance).information
    np.testing.assert_allclose(outcome.information, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())


def test_the_answer_is_the_same_to_the_last_bit(noisy_problem):
    assert N_THREADS == 2
    problem, start = noisy_problem
    first, second = minimise(problem, start), minimise(problem, start)
    assert first.cost == second.cost
    np.testing.assert_array_equal(first.information, second.information)
    for key, value in first.state.values.items():
        np.testing.assert_array_equal(value, second.state.values[key])


def test_too_few_iterations_is_said(noisy_problem, monkeypatch):
    problem, start = noisy_problem
    monkeypatch.setattr(solver, "MAX_ITERATIONS", 2)
    outcome = minimise(problem, start)
    assert not outcome.converged
    assert outcome.status.startswith("not converged after 2 iterations")


def test_a_start_that_predicts_nothing_finite_is_an_error(noisy_problem):
    problem, start = noisy_problem
    bad = replace(start, position=start.position * np.nan)
    with pytest.raises(EstimationError, match="initial guess"):
        minimise(problem, bad)


@pytest.mark.full
def test_slow_motion_and_a_poor_imu_converge_although_gravity_is_hardly_known():
    """The tilt of the board then moves by degrees, and with it, in one step, accelerometer bias and lever arm."""
    scenario = handheld(20.0, imu="noisy")
    motion = replace(scenario.motion, rotation_scale=0.25, translation_scale=0.25)
    scenario = replace(scenario, motion=motion)
    result = calibrate_measurements(rig_for(scenario), simulate(scenario, seed=25).measurements)
    assert result.converged, result.status
    assert len(result.iterations) <= 15


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_the_information_has_the_true_curvature_of_the_loss(unlike, setup_of, problem_of, loss):
    setup = setup_of(unlike)
    problem = problem_of(setup, setup.state)
    rng = np.random.default_rng(4)
    cameras = tuple(
        replace(
            c,
            stream=replace(c.stream, uv=c.stream.uv + rng.normal(size=c.stream.uv.shape)),
            noise=replace(c.noise, sigma=np.ones_like(c.noise.sigma), loss=loss, loss_scale=1.5),
        )
        for c in of_type(problem.factors, CornerFactor)
    )
    problem = problem.replacing(cameras)
    outcome = minimise(problem, setup.state)

    def information(curved):
        pieces = problem.pieces()
        problem.linearise(outcome.state, pieces, problem.residuals(), curved=curved)
        return solve(pieces, problem.n_keyframes, problem.tolerance).information

    np.testing.assert_allclose(outcome.information, information(True), rtol=1e-9, atol=1e-3)
    assert np.diag(information(True)).sum() < 0.95 * np.diag(information(False)).sum()
