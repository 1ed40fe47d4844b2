"""Half a recording predicted by the other: the algebra against dense least squares and draws, keyframes against dense
elimination."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from tests.optim.test_arrowhead import random_pieces

from icalib.estimate.cross_validation import Half, excess, halves_of, predict, shifts
from icalib.estimate.residual_statistics import MIN_SEGMENT_KEYFRAMES, Segments, chi2_by_kind
from icalib.estimate.solver import minimise
from icalib.optim.arrowhead import KEYFRAME_DIM, Prior, chain_step_given_calib
from icalib.tools.simulation import handheld, simulate

NO_PRIOR = np.zeros((3, 3)), np.zeros(3)


@pytest.mark.parametrize("which", [0, 1])
def test_keyframes_follow_the_calibration_from_the_first_keyframe_and_from_another(dense, which):
    piece = random_pieces(9, 3)[which]
    first, n = piece.first, piece.last - piece.first + 1
    piece.first, piece.last = 0, n - 1
    H, g = dense((piece,), n)
    piece.first, piece.last = first, first + n - 1
    calib = np.random.default_rng(1).normal(size=(3, 2))
    o = KEYFRAME_DIM * n
    expected = -np.linalg.solve(H[:o, :o], g[:o, None] + H[:o, o:] @ calib)
    np.testing.assert_allclose(chain_step_given_calib(piece, calib).reshape(o, 2), expected, rtol=1e-8, atol=1e-10)


def rows_of(rng, n, columns):
    """A linear half: Jacobian (n, B), zero but in its own columns, and residuals of white noise at the truth."""
    J = np.zeros((n, 5))
    J[:, columns] = rng.normal(size=(n, len(columns))) @ rng.normal(size=(len(columns),) * 2)
    return J, rng.normal(size=n)


def sums_of(J, r):
    both = np.concatenate([J, r[:, None]], axis=1)
    return both.T @ both


def best(pairs, columns, prior=None):
    """(B,) the least squares over `columns` alone, the rest 0."""
    J, r = (np.concatenate(x) for x in zip(*pairs, *([prior] if prior else []), strict=True))
    out = np.zeros(J.shape[1])
    out[columns] = -np.linalg.lstsq(J[:, columns], r, rcond=None)[0]
    return out


def chi2(J, r, known):
    """Of a half at `known` of the columns that both halves know (0, 1, 2), its own ones at their best."""
    r = r + J[:, :3] @ known[:3]
    own = J[:, 3:]
    return float(((r - own @ np.linalg.lstsq(own, r, rcond=None)[0]) ** 2).sum())


@pytest.mark.parametrize("with_prior", [False, True])
def test_excess_is_that_of_dense_least_squares(with_prior):
    """The first half alone knows column 3, the second alone column 4: each finds its own."""
    rng = np.random.default_rng(3)
    A, B = rows_of(rng, 40, [0, 1, 2, 3]), rows_of(rng, 60, [0, 1, 2, 4])
    prior = (np.concatenate([np.diag([2.0, 0.0, 5.0]), np.zeros((3, 2))], axis=1), np.array([0.3, 0.0, -1.0]))
    given = prior if with_prior else (np.zeros((1, 5)), np.zeros(1))
    halves, shared, own = halves_of(np.array([sums_of(*A), sums_of(*B)]), np.eye(5))
    assert shared.shape == (5, 3) and own.shape == (5, 2)
    J, r = given[0] @ shared, given[1]
    found = excess(halves[0], halves[1], (J.T @ J, J.T @ r))
    a, b = (best([one], own, given) for one, own in ((A, [0, 1, 2, 3]), (B, [0, 1, 2, 4])))
    both = best([A, B], [0, 1, 2, 3, 4], given)
    expected = chi2(*A, b) + chi2(*B, a) - chi2(*A, both) - chi2(*B, both)
    # What is unknown is kept within some ten tolerances of the first half's 40 rows: 1e-4 of it.
    assert found.value == pytest.approx(expected, rel=1e-3)
    for step, dense_step in zip(found.steps, (a, b, both), strict=True):
        np.testing.assert_allclose((shared @ step)[:3], dense_step[:3], rtol=1e-3, atol=1e-5)


def information(rng, n):
    J = rng.normal(size=(n, 3))
    return J.T @ J


def test_what_noise_makes_of_it_is_that_of_draws():
    rng = np.random.default_rng(4)
    S, T = information(rng, 6), information(rng, 9)
    Pi = np.diag([1.0, 0.0, 4.0])
    roots = [np.linalg.cholesky(x + 1e-12 * np.eye(3)) for x in (S, T, Pi)]
    own, drawn = np.zeros((0, 4)), []
    found = excess(Half(S, np.zeros(3), own), Half(T, np.zeros(3), own), (Pi, np.zeros(3)))
    for _ in range(4000):
        b, c, d = (root @ rng.normal(size=3) for root in roots)
        drawn.append(excess(Half(S, b, own), Half(T, c, own), (Pi, d)).value)
    assert found.mean == pytest.approx(np.mean(drawn), rel=0.05)
    assert found.std == pytest.approx(np.std(drawn), rel=0.1)


def test_without_priors_the_mean_is_the_formula_and_three_for_each_parameter_of_equal_halves():
    rng = np.random.default_rng(5)
    S, T = information(rng, 6), information(rng, 9)
    both = np.linalg.inv(S + T)
    found = excess(Half(S, np.zeros(3), np.zeros(0)), Half(T, np.zeros(3), np.zeros(0)), NO_PRIOR)
    expected = np.trace(S @ (np.linalg.inv(T) + both)) + np.trace(T @ (np.linalg.inv(S) + both))
    assert found.mean == pytest.approx(expected, rel=1e-12)
    equal = excess(Half(S, np.zeros(3), np.zeros(0)), Half(S, np.zeros(3), np.zeros(0)), NO_PRIOR)
    assert equal.mean == pytest.approx(9.0, rel=1e-12)
    assert equal.std == pytest.approx(np.sqrt(2.0 * 3.0) * 3.0, rel=1e-12)


def test_halves_with_nothing_in_common_predict_nothing():
    rng = np.random.default_rng(6)
    sums = np.array([sums_of(*rows_of(rng, 40, [0, 1])), sums_of(*rows_of(rng, 40, [2, 3, 4]))])
    problem = SimpleNamespace(tolerance=np.ones(5), fixed_directions=np.zeros((0, 0)), layout=SimpleNamespace(size=5))
    assert predict(SimpleNamespace(problem=problem, sums=sums)) is None  # pyright: ignore


@pytest.fixture(scope="module")
def solved(setup_of, problem_of):
    """Two cameras and an IMU, corners with noise, at the optimum; a prior on the intrinsics of the first."""
    setup = setup_of(simulate(handheld(10.0), seed=5))
    block = setup.layout.block("cam0", "intrinsics")
    prior = Prior(block, setup.state.values[block.key] + 0.2, np.full(4, 0.3))
    problem = replace(problem_of(setup), priors=(prior,))
    outcome = minimise(problem, setup.state)
    parts = Segments.of(problem, outcome, 5)
    assert parts is not None
    return problem, outcome, parts


def test_residuals_rise_as_the_sums_say(solved):
    """The keyframes of all parts follow; what is evaluated is not linear, and hardly differs."""
    problem, outcome, parts = solved
    found = predict(parts)
    assert found is not None and found.directions == problem.layout.size
    t = problem.tolerance
    halves, shared, _ = halves_of(parts.sums, np.diag(t))
    prior = np.diag(np.zeros(len(t)))
    k = problem.layout.columns("cam0", "intrinsics")
    prior[k, k] = 1.0 / 0.3**2
    gradient = np.zeros(len(t))
    gradient[k] = (outcome.state.values["cam0", "intrinsics"] - problem.priors[0].value) / 0.3**2
    basis = np.diag(t) @ shared
    linear = excess(halves[0], halves[1], (basis.T @ prior @ basis, basis.T @ gradient))
    assert found.expected == pytest.approx(linear.mean, rel=1e-9)
    assert found.excess == pytest.approx(linear.value, rel=5e-3)
    inside, outside = (chi2_by_kind(parts.problem, x) for x in (found.inside, found.outside))
    rise = sum(outside[key][1] - inside[key][1] for key in inside)
    assert rise == pytest.approx(found.excess, rel=1e-2)  # of residuals in single precision
    assert sum(x for _, x in inside.values()) <= 2.0 * outcome.cost  # each part has its own keyframes at its ends


def test_shifts_are_those_of_solutions_without_a_part(solved):
    """Of the sums alone, by plain inverses; without a part the variance is larger by what is allowed."""
    problem, _, parts = solved
    found, B = shifts(parts), problem.layout.size
    Pi, k = np.zeros((B + 1, B + 1)), problem.layout.columns("cam0", "intrinsics")
    Pi[k, k] = 1.0 / 0.3**2
    Pi[k, -1] = (parts.state.values["cam0", "intrinsics"] - problem.priors[0].value) / 0.3**2
    together = parts.sums.sum(axis=0) + Pi
    step, inverse = solution(together)
    for g, own in enumerate(parts.sums):
        without, wider = solution(together - own)
        np.testing.assert_allclose(found.moved[g], without - step, rtol=1e-5, atol=1e-9)
        np.testing.assert_allclose(found.expected[g] ** 2, np.diag(wider - inverse), rtol=1e-5)


def solution(sums):
    inverse = np.linalg.inv(sums[:-1, :-1])
    return -inverse @ sums[:-1, -1], inverse


def test_parts_are_as_many_as_asked_for_and_long_enough(solved):
    problem, outcome, _ = solved
    assert Segments.of(problem, outcome, 0) is None
    assert Segments.of(problem, outcome, 1) is None
    two, many = Segments.of(problem, outcome, 2), Segments.of(problem, outcome, problem.n_keyframes // 2)
    assert two is not None and two.count == 2
    assert many is not None and many.count == (problem.n_keyframes - 1) // MIN_SEGMENT_KEYFRAMES
    assert np.diff(many.ends).min() >= MIN_SEGMENT_KEYFRAMES


@pytest.mark.parametrize(("duration", "keyframes", "parts"), [(0.35, 5, None), (0.45, 8, 2)])
def test_a_recording_too_short_for_two_parts_has_none(duration, keyframes, parts, setup_of, problem_of):
    """Three keyframes a part and one at the end: two parts need seven."""
    setup = setup_of(simulate(handheld(duration), seed=5))
    problem = problem_of(setup)
    found = Segments.of(problem, minimise(problem, setup.state), 8)
    assert problem.n_keyframes == keyframes
    assert (None if found is None else found.count) == parts
