"""Gradients of segments, with the joint trajectory eliminated, against dense matrices and difference quotients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.typed import not_none

from icalib.estimate.problem import Problem
from icalib.estimate.residual_statistics import Segments, noise_variance, split_covariance, split_expectation
from icalib.estimate.solver import Outcome, minimise
from icalib.motion.factor import keyed
from icalib.optim.arrowhead import KEYFRAME_DIM, Piece, Prior
from icalib.optim.state import make_layout
from icalib.sensors.imu.residual import ImuFactor
from icalib.tools.simulation import handheld, simulate

COUNT = 5


def parts_of(problem: Problem, outcome: Outcome) -> Segments:
    return not_none(Segments.of(problem, outcome, COUNT))


@pytest.fixture(scope="module")
def on_target(setup_of, problem_of) -> tuple[Problem, Outcome]:
    """Two cameras before a target, corners with noise; a prior on the intrinsics of the first."""
    setup = setup_of(simulate(handheld(10.0), seed=5))
    block = next(b for b in setup.layout.blocks if b.key == ("cam0", "intrinsics"))
    problem = problem_of(setup)
    problem = replace(problem, priors=(Prior(block, setup.state.values[block.key] + 0.2, np.full(4, 0.3)),))
    return problem, minimise(problem, setup.state)


@pytest.fixture(scope="module")
def on_tracks(setup_of, features_of) -> tuple[Problem, Outcome]:
    """The same corners as points of unknown position, with noise."""
    setup = setup_of(simulate(handheld(1.5), seed=6))
    imu = ImuFactor.build(setup.imu, setup.state, 9.81, setup.layout)
    factors = keyed((imu, features_of(setup, noise_px=0.3)))
    problem = Problem(setup.layout, factors, (), setup.columns_scale(), framed=False)
    return problem, minimise(problem, setup.state)


def sums(problem: Problem, outcome: Outcome, dense) -> tuple[np.ndarray, np.ndarray]:
    """Dense normal matrix without priors, and the steps (15 K, B) of the keyframes for unit calibration steps."""
    piece = problem.attach(Piece.zeros(0, problem.n_keyframes - 1, problem.layout.size))
    problem.add_measurements(outcome.state, piece, problem.residuals())
    problem.add_bias_prior(outcome.state, piece)
    problem.hold_frames(outcome.state, piece)
    H = dense((piece,), problem.n_keyframes)[0]
    o = KEYFRAME_DIM * problem.n_keyframes
    return H, -np.linalg.solve(H[:o, :o], H[:o, o:])


def test_gradients_are_those_of_dense_matrices(on_target, dense):
    problem, outcome = on_target
    parts, o = parts_of(problem, outcome), KEYFRAME_DIM * problem.n_keyframes
    free = replace(problem, priors=())
    H, steps = sums(free, outcome, dense)
    for g in range(parts.count):
        piece = parts.piece(g, free.residuals())
        gradient = np.zeros((problem.n_keyframes, KEYFRAME_DIM))
        gradient[piece.first : piece.last + 1] = piece.side[:, :, -1]
        expected = piece.calib[:-1, -1] + steps.T @ gradient.ravel()
        np.testing.assert_allclose(parts.gradients[g], expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(
        parts.information, H[o:, o:] + H[:o, o:].T @ steps, rtol=1e-6, atol=1e-6 * np.abs(H[o:, o:]).max()
    )


@pytest.mark.parametrize("case", ["on_target", "on_tracks"])
def test_parts_of_parameters_in_all_segments_are_the_parameters(case: str, request: pytest.FixtureRequest):
    """Their columns add up to those of the parameters, and gradients too, the trajectory eliminated."""
    problem, outcome = request.getfixturevalue(case)
    parts = parts_of(replace(problem, priors=()), outcome)
    columns, B, G = parts.problem.layout.columns("cam0", "rotation"), parts.problem.layout.size, parts.count
    information, gradient = parts.varying(columns)
    close = {"rtol": 1e-6, "atol": 1e-6 * np.abs(parts.information).max()}
    np.testing.assert_allclose(information[:B, :B], parts.information, **close)
    added = information[B:].reshape(G, 3, -1).sum(axis=0)
    np.testing.assert_allclose(added[:, :B], parts.information[columns], **close)
    np.testing.assert_allclose(
        added[:, B:].reshape(3, G, 3).sum(axis=1), parts.information[columns][:, columns], **close
    )
    of_all = parts.gradients.sum(axis=0)
    np.testing.assert_allclose(gradient[:B], of_all, rtol=1e-6, atol=1e-6 * np.abs(gradient).max())
    np.testing.assert_allclose(
        gradient[B:].reshape(G, 3).sum(axis=0), of_all[columns], atol=1e-6 * np.abs(gradient).max()
    )
    assert np.abs(information[B : B + 3, B + 3 : B + 6]).max() > 1e-4 * np.abs(information[B : B + 3, B : B + 3]).max()


def test_gradients_and_that_of_the_priors_cancel_at_the_optimum(on_target):
    problem, outcome = on_target
    (prior,) = problem.priors
    gradients = parts_of(problem, outcome).gradients
    total = gradients.sum(axis=0)
    total[prior.block.columns] += (outcome.state.values[prior.block.key] - prior.value) / prior.sigma**2
    assert (np.abs(total) < 1e-4 * np.abs(gradients).max(axis=0)).all()


@pytest.mark.parametrize("case", ["on_target", "on_tracks"])
def test_gradients_are_slopes_of_the_cost_of_each_segment(case, request, dense):
    """Along a step of the calibration parameters, which all keyframes and points follow."""
    problem, outcome = request.getfixturevalue(case)
    parts = parts_of(problem, outcome)
    cut = replace(parts.problem, priors=())
    steps, state, out = sums(cut, outcome, dense)[1], outcome.state, cut.residuals()
    direction = problem.tolerance * np.random.default_rng(3).normal(size=len(problem.tolerance))
    chain, h = (steps @ direction).reshape(-1, KEYFRAME_DIM), 1e-3
    for g in range(parts.count):
        costs = [
            parts.cost(g, state.retract(problem.layout, s * chain, s * direction), out) for s in (-2 * h, -h, h, 2 * h)
        ]
        slope = (costs[0] - 8.0 * costs[1] + 8.0 * costs[2] - costs[3]) / (12.0 * h)
        assert slope == pytest.approx(parts.gradients[g] @ direction, rel=1e-3, abs=1e-3)


def with_known_rates(setup):
    """Segments at both ends know most of the rates of clocks, so that these do not scatter alike."""
    entries = [
        (b.sensor, b.name, b.kind, b.size, b.start is not None and b.name != "clock_rate") for b in setup.layout.blocks
    ]
    return replace(setup, layout=make_layout(entries))


@pytest.mark.full
def test_gradients_scatter_as_expected_of_white_noise(setup_of, problem_of):
    """Over 20 recordings; the mean ratio has a standard error of 5 %. Trajectories that follow the noise at the ends of
    segments take about 5 % of the scatter."""
    ratios = []
    for seed in range(20):
        setup = with_known_rates(setup_of(simulate(handheld(12.0), seed=seed)))
        problem = problem_of(setup)
        outcome = minimise(problem, setup.state)
        parts = not_none(Segments.of(problem, outcome, 4))
        expected = split_expectation(outcome, parts)
        assert expected == pytest.approx(noise_variance(problem, outcome), rel=0.35)
        ratios.append(np.diag(split_covariance(outcome, parts)) / expected)
    assert 0.85 < np.mean(ratios) < 1.15
