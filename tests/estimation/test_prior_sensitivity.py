"""Where unobservable directions are held, and how far that may be from the truth, against draws of guesses."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from icalib.errors import EstimationError
from icalib.observability import prior_sensitivity as module
from icalib.observability.prior_sensitivity import (
    N_SIGN_DRAWS,
    directions_to_reset,
    linear_prior_sensitivity,
    prior_sensitivity,
    project_to_guess,
    project_to_prior,
)
from icalib.optim.state import Entry, State, make_layout

TOLERANCE = {"translation": 5e-3, "time_offset": 1e-3}
SIGMA = {"translation": np.array([0.1, 0.2, 0.06]), "time_offset": np.array([0.02])}
DRAWS = 2000


@pytest.fixture
def given(monkeypatch):
    """Two sensors; the data leave open a shift of both, and a mixture of height and time of one. What is left is
    determined exactly: the answer to a move is the move."""
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
    monkeypatch.setattr(module, "minimise", lambda problem, state, *_: SimpleNamespace(state=state))
    inputs = SimpleNamespace(is_sensor=lambda name: name in "ab", layout=layout)
    outcome = SimpleNamespace(problem=problem, state=state, workspace=None)
    return SimpleNamespace(inputs=inputs, problem=problem, state=state, sigma=sigma, priors=priors, outcome=outcome)


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


@pytest.mark.parametrize(("pull", "sigmas", "moves"), [(0.1, 1.0, True), (9.0, 1.9, False), (9.0, -2.1, True)])
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
    shifts = prior_sensitivity(given.inputs, given.outcome, np.zeros((8, 8)))
    assert 2 < len(shifts) <= 2 + N_SIGN_DRAWS  # two errors, and what both together make beyond their sum
    np.testing.assert_allclose(shifts[2:], 0.0, atol=1e-12)
    drawn = np.cov(landed(given, np.random.default_rng(0)).T)
    expected, scale = shifts.T @ shifts, given.problem.tolerance
    np.testing.assert_allclose(
        drawn / np.outer(scale, scale),
        expected / np.outer(scale, scale),
        atol=0.1 * (expected.diagonal() / scale**2).max(),
    )
    assert expected[0, 0] == pytest.approx(0.5 * 0.1**2, rel=1e-9)  # the mean of two guesses
    assert expected[0, 4] == pytest.approx(expected[0, 0], rel=1e-9)


def test_what_comes_of_two_errors_together_is_owed_too(given, monkeypatch):
    def bent(problem, state, options, workspace):
        values = {k: v.copy() for k, v in state.values.items()}
        values["a", "translation"][1] += 7.0 * values["a", "translation"][0] * values["a", "translation"][2]
        return SimpleNamespace(state=replace(state, values=values))

    monkeypatch.setattr(module, "minimise", bent)
    shifts = prior_sensitivity(given.inputs, given.outcome, np.zeros((8, 8)))
    assert np.abs(shifts[:2, 1]).max() < 1e-12  # neither alone moves it
    drawn = landed(given, np.random.default_rng(0))
    product = 7.0 * drawn[:, 0] * drawn[:, 2]
    assert (shifts[2:, 1] ** 2).sum() == pytest.approx(np.mean(product**2), rel=0.2)


def test_nothing_is_tried_out_where_the_guess_alone_leaves_all_open(given, monkeypatch):
    given.problem.fixed_directions = np.eye(8)
    monkeypatch.setattr(module, "minimise", None)
    shifts = prior_sensitivity(given.inputs, given.outcome, np.zeros((8, 8)))
    np.testing.assert_allclose(np.sqrt((shifts**2).sum(axis=0)), given.sigma)


def test_in_proportion_only_what_is_held_moves(given, monkeypatch):
    nothing = np.zeros((8, 8))
    expected = prior_sensitivity(given.inputs, given.outcome, nothing)[:2]
    monkeypatch.setattr(module, "minimise", None)
    np.testing.assert_allclose(linear_prior_sensitivity(given.inputs, given.outcome, nothing), expected, atol=1e-12)


def test_a_way_along_which_nothing_can_be_solved_is_made_shorter(given, monkeypatch):
    def short_only(problem, state, options, workspace):
        if np.abs(state.values["b", "translation"]).max() > 0.02:
            raise EstimationError("too far")
        return SimpleNamespace(state=state)

    expected = prior_sensitivity(given.inputs, given.outcome, np.zeros((8, 8)))
    monkeypatch.setattr(module, "minimise", short_only)
    found = prior_sensitivity(given.inputs, given.outcome, np.zeros((8, 8)))
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_what_nobody_guessed_moves_no_further_than_the_data_leave_open(given):
    given.inputs.is_sensor = lambda name: name == "b"
    data = np.diag(np.full(8, 5e-3))
    data[0, 0] = 0.0
    given.problem.fixed_directions = np.eye(8)[:, [0, 1]]  # of a, which is no sensor now
    shifts = prior_sensitivity(given.inputs, given.outcome, data)
    width = np.sqrt((shifts**2).sum(axis=0)) / given.problem.tolerance
    assert width[0] == pytest.approx(module.UNGUESSED_SIGMA / 5e-3)
    assert width[1] == pytest.approx(min(module.UNGUESSED_SIGMA / 5e-3, 1.0 / np.sqrt(5e-3)))
