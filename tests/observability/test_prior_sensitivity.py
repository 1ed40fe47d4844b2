"""Where unobservable directions are held, and how far that may be from the truth, against draws of guesses."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.cases import each

from icalib.observability import prior_sensitivity as module
from icalib.observability.prior_sensitivity import (
    directions_to_reset,
    prior_sensitivity,
    project_to_guess,
    project_to_prior,
)
from icalib.optim.arrowhead import Factors, NotDefiniteError
from icalib.optim.state import Entry, State, make_layout

TOLERANCE = {"translation": 5e-3, "time_offset": 1e-3}
SIGMA = {"translation": np.array([0.1, 0.2, 0.06]), "time_offset": np.array([0.02])}
DRAWS = 2000


@pytest.fixture
def given(monkeypatch):
    """Two sensors; the data leave open a shift of both, and a mixture of height and time of one. What is left is
    determined: the answer to a move is the move, and what `bend` makes of it."""
    entries: list[Entry] = [
        (s, n, "vector", size, True) for s in "ab" for n, size in (("translation", 3), ("time_offset", 1))
    ]
    layout = make_layout(entries)
    values = {b.key: np.zeros(b.size) for b in layout.free}
    zeros = np.zeros((2, 3))
    state = State(np.arange(2.0), np.stack([np.eye(3)] * 2), zeros, zeros, np.zeros((2, 6)), values)
    fixed_directions = np.zeros((8, 2))
    fixed_directions[[0, 4], 0] = np.sqrt(0.5)
    fixed_directions[[2, 3], 1] = 0.6, 0.8
    problem = SimpleNamespace(
        layout=layout,
        fixed_directions=fixed_directions,
        tolerance=np.concatenate([np.full(b.size, TOLERANCE[b.name]) for b in layout.free]),
    )
    priors: list = []
    sigma = np.concatenate([SIGMA[b.name] for b in layout.free])
    monkeypatch.setattr(module, "given_priors", lambda _: priors)
    monkeypatch.setattr(module, "guess_sigma", lambda *_: sigma.copy())
    bend = np.zeros((8, 8))  # of the second coordinate of a by the others, quadratic, in tolerance units

    def factors(outcome, at: State) -> Factors:
        """The data show all that is at right angles to the fixed directions, but for the second coordinate of a less
        a quadratic form of the others."""
        x = np.concatenate([at.values[b.key] for b in layout.free]) / problem.tolerance
        held = problem.fixed_directions
        J = np.eye(8) - held @ held.T
        J[1] = np.eye(8)[1] - 2.0 * bend @ x
        pieces, nothing = (), np.zeros((0, 0))
        information = J.T @ J / np.outer(problem.tolerance, problem.tolerance)
        return Factors(pieces, [], 2, nothing, np.zeros((0, 9)), information, problem.tolerance, held)

    monkeypatch.setattr(module, "_factors", factors)
    inputs = SimpleNamespace(is_sensor=lambda name: name in "ab", layout=layout)
    outcome = SimpleNamespace(problem=problem, state=state, workspace=None, converged=True, stopped_early=False)
    return SimpleNamespace(
        inputs=inputs, problem=problem, state=state, sigma=sigma, priors=priors, outcome=outcome, bend=bend
    )


def landed(given, rng) -> np.ndarray:
    """(DRAWS, 8) where what is held stands, for guesses drawn about the truth, which is 0."""
    out = []
    for errors in given.sigma * rng.standard_normal((DRAWS, 8)):
        guess = given.state.retract(given.problem.layout, np.zeros((2, 15)), errors)
        moved = (
            project_to_prior(given.inputs, given.problem, given.state, guess, given.problem.fixed_directions)
            if given.priors
            else project_to_guess(given.problem, given.state, guess, given.problem.fixed_directions)
        )
        moved = given.state if moved is None else moved
        out.append(np.concatenate([moved.values[b.key] for b in given.problem.layout.free]))
    return np.array(out)


def sensitivity(given, data: np.ndarray | None = None) -> np.ndarray:
    """(n, 8) `prior_sensitivity` with no noise in the Jacobian."""
    nothing = np.zeros((8, 8))
    return prior_sensitivity(given.inputs, given.outcome, nothing if data is None else data, nothing)


@each(("pull", "sigmas", "moves"), [(0.1, 1.0, True), (9.0, 1.9, False), (9.0, -2.1, True)])
def test_only_where_noise_pulls_to_near_the_guess_a_direction_stays(given, pull: float, sigmas: float, moves: bool):
    """The mixture of height and time, pulled to some standard deviations from the guess; nothing pulls at the shift of
    both. Which axes the span is given in does not matter."""
    fixed_directions, tolerance = given.problem.fixed_directions, given.problem.tolerance
    mixture = fixed_directions[:, 1]
    worth = np.sqrt(np.square(mixture * given.sigma / tolerance).sum())
    asked = np.diag(np.full(8, 1e-3)) + pull * np.outer(mixture, mixture)
    to = given.state.retract(given.problem.layout, np.zeros((2, 15)), sigmas * worth * mixture * tolerance)
    turned = fixed_directions @ np.array([[0.6, -0.8], [0.8, 0.6]])
    found = directions_to_reset(given.inputs, given.problem, given.state, to, turned, asked)
    expected = fixed_directions if moves else fixed_directions[:, :1]
    np.testing.assert_allclose(found @ found.T, expected @ expected.T, atol=1e-9)


@pytest.mark.parametrize("weighed", [False, True])
def test_the_shifts_have_the_covariance_of_where_guesses_land(given, weighed: bool):
    if weighed:
        given.priors.append(SimpleNamespace(block=given.problem.layout.free[0], sigma=np.array([0.1, 0.2, 0.05])))
    shifts = sensitivity(given)
    np.testing.assert_allclose(shifts[2:], 0.0, atol=1e-9)
    drawn = np.cov(landed(given, np.random.default_rng(0)).T)
    expected, scale = shifts.T @ shifts, given.problem.tolerance
    np.testing.assert_allclose(
        drawn / np.outer(scale, scale),
        expected / np.outer(scale, scale),
        atol=0.1 * (expected.diagonal() / scale**2).max(),
    )
    assert expected[0, 0] == pytest.approx(0.5 * 0.1**2, rel=1e-9)  # the mean of two guesses
    assert expected[0, 4] == pytest.approx(expected[0, 0], rel=1e-9)


@pytest.mark.parametrize("a_third", [0.0, 4e-3])
def test_what_is_of_second_order_is_owed_too(given, a_third: float):
    """A product of two errors, and a square."""
    given.bend[0, 2], given.bend[0, 0] = 8e-3, a_third
    given.bend[:] = 0.5 * (given.bend + given.bend.T)
    shifts = sensitivity(given)
    assert np.abs(shifts[:2, 1]).max() < 1e-9  # neither alone moves it, to first order
    drawn = landed(given, np.random.default_rng(0)) / given.problem.tolerance
    bent = np.einsum("ni,ij,nj->n", drawn, given.bend, drawn) * given.problem.tolerance[1]
    assert (shifts[2:, 1] ** 2).sum() == pytest.approx(np.mean(bent**2), rel=0.2)


def test_signs_and_basis_of_the_fixed_directions_do_not_matter(given):
    given.bend[0, 2] = given.bend[2, 0] = 4e-3
    given.bend[3, 3] = 2e-3
    data = np.diag(np.arange(8.0)) * 1e-3
    given.inputs.is_sensor = lambda name: name == "b"
    expected = sensitivity(given, data)
    turn = np.array([[0.6, 0.8], [0.8, -0.6]])
    given.problem.fixed_directions = given.problem.fixed_directions @ turn
    found = sensitivity(given, data)
    np.testing.assert_allclose(found.T @ found, expected.T @ expected, rtol=1e-7, atol=1e-12)


def test_noise_in_the_jacobian_is_no_response(given, monkeypatch):
    expected = sensitivity(given)
    noise, before = np.full((8, 8), 0.01), module._factors

    def noisy(outcome, at: State) -> Factors:
        factors, t = before(outcome, at), given.problem.tolerance
        return replace(factors, information=factors.information + noise / np.outer(t, t))

    monkeypatch.setattr(module, "_factors", noisy)
    assert not np.allclose(sensitivity(given), expected)
    found = prior_sensitivity(given.inputs, given.outcome, np.zeros((8, 8)), noise)
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_a_step_along_which_nothing_can_be_solved_leaves_the_linear_response(given, monkeypatch):
    given.bend[0, 2] = given.bend[2, 0] = 4e-3
    expected, before = sensitivity(given), module._factors

    def at_the_solution(outcome, at: State) -> Factors:
        if at is not outcome.state:
            raise NotDefiniteError("too far")
        return before(outcome, at)

    monkeypatch.setattr(module, "_factors", at_the_solution)
    found = sensitivity(given)
    np.testing.assert_allclose(found[:2], expected[:2], atol=1e-12)
    assert not found[2:].any()


def test_what_the_data_do_not_show_away_from_the_solution_does_not_respond(given):
    """More noise is taken off there than is left. A floor of the information made the coupling 1e4 times as large."""
    factors, noise = module._factors(given.outcome, given.state), np.zeros((8, 8))
    errors = given.problem.fixed_directions
    noise[5, 5] = 1.5
    noise[5, [0, 4]] = noise[[0, 4], 5] = 0.3
    shifts = module._response(factors, noise, errors) / given.problem.tolerance[:, None]
    np.testing.assert_allclose(shifts, errors, atol=1e-12)


@pytest.mark.parametrize("why", ["all are fixed", "the estimate failed"])
def test_without_a_response_only_the_fixed_directions_move(given, monkeypatch, why: str):
    if why == "all are fixed":
        given.problem.fixed_directions = np.eye(8)
    given.outcome.converged = why == "all are fixed"
    monkeypatch.setattr(module, "_factors", None)
    shifts, held = sensitivity(given), given.problem.fixed_directions * given.problem.tolerance[:, None]
    in_tolerances = given.problem.fixed_directions.T * (given.sigma / given.problem.tolerance)
    np.testing.assert_allclose(shifts.T @ shifts, held @ in_tolerances @ in_tolerances.T @ held.T, atol=1e-12)


def test_what_nobody_guessed_moves_no_further_than_the_data_leave_open(given):
    given.inputs.is_sensor = lambda name: name == "b"
    data = np.diag(np.full(8, 5e-3))
    data[0, 0] = 0.0
    given.problem.fixed_directions = np.eye(8)[:, [0, 1]]  # of a, which is no sensor now
    shifts = sensitivity(given, data)
    width = np.sqrt((shifts**2).sum(axis=0)) / given.problem.tolerance
    assert width[0] == pytest.approx(module.UNGUESSED_SIGMA / 5e-3)
    assert width[1] == pytest.approx(1.0 / np.sqrt((5e-3 / module.UNGUESSED_SIGMA) ** 2 + 5e-3))
