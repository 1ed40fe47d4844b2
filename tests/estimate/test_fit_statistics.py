"""Draws from the posterior and the degrees of freedom that they show, against dense linear algebra."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each
from tests.optim.test_arrowhead import random_pieces
from tests.optim.test_front import build
from tests.typed import not_none

from icalib.estimate.jacobian_noise import spurious_information
from icalib.estimate.residual_statistics import fits
from icalib.estimate.solver import Draws, Outcome, SolverOptions, minimise, posterior
from icalib.motion.factor import of_type
from icalib.optim.arrowhead import Piece, solve
from icalib.sensors.camera.corner_factor import CornerFactor
from icalib.sensors.lidar.residual import LidarFactor
from icalib.tools.simulation import handheld, simulate

pytestmark = pytest.mark.slow

DRAWS = 40


def columns_of(solution):
    """(n, m) the columns of a factor X of the inverse, X X^T, chain first: what unit vectors give in place of noise."""
    factors, n_calib = solution.factors, len(solution.calib)
    rows = factors.rows()
    ends = np.cumsum([n_calib, *rows])
    white = [np.eye(ends[-1])[a:b] for a, b in zip(ends[:-1], ends[1:], strict=True)]
    calib = np.zeros((n_calib + 1, ends[-1]))
    calib[:n_calib, :n_calib] = np.linalg.cholesky(np.linalg.inv(solution.information))
    chain = factors.back(calib, white)
    return np.concatenate([chain.reshape(-1, ends[-1]), calib[:-1]])


@each("n_keyframes", [1, 3, 4, 9])
def test_draws_have_the_covariance_of_the_posterior(dense, n_keyframes):
    pieces = random_pieces(n_keyframes, 3)
    H, _ = dense(pieces, n_keyframes)
    X = columns_of(solve(pieces, n_keyframes, np.ones(3)))
    inverse = np.linalg.inv(H)
    np.testing.assert_allclose(X @ X.T, inverse, rtol=0, atol=1e-10 * np.abs(inverse).max())


@each(("per_keyframe", "by_next"), [(1, False), (2, False), (2, True)])
def test_draws_have_the_covariance_of_the_posterior_where_features_tie_keyframes(per_keyframe, by_next):
    pieces, H, _ = build(9, 12, 3, per_keyframe=per_keyframe, by_next=by_next)
    X = columns_of(solve(pieces, 9, np.ones(3)))
    inverse = np.linalg.inv(H)
    np.testing.assert_allclose(X @ X.T, inverse, rtol=0, atol=1e-9 * np.abs(inverse).max())


def test_still_draws_leave_the_calibration_and_free_ones_what_is_held():
    pieces, fixed_directions = random_pieces(6, 3), np.eye(3)[:, 1:2]
    drawn = solve(pieces, 6, np.array([1.0, 2.0, 3.0]), fixed_directions=fixed_directions).factors.draws(
        np.random.default_rng(1), 4, 2
    )
    assert [bool(d.calib.any()) for d in drawn] == [True] * 4 + [False] * 2
    assert all(d.calib[1] == 0.0 and d.calib[[0, 2]].all() and d.chain.all() for d in drawn[:4])
    assert all(d.chain.all() for d in drawn[4:])


@pytest.fixture(scope="module")
def setup(setup_of):
    return setup_of(simulate(handheld(1.5), seed=4))


@pytest.fixture(scope="module")
def cornered(setup, problem_of):
    """Corners of both cameras, of one with errors that are common to an image."""
    problem, rng = problem_of(setup), np.random.default_rng(2)
    second = problem.factors["cam1", "corners"]
    noise = replace(
        second.noise, tau=np.array([0.4, 0.4, 0.3]), field=0.05 * rng.normal(size=(len(second.stream.uv), 2, 3))
    )
    return problem.replacing([replace(second, noise=noise)])


@pytest.fixture(scope="module")
def followed(setup, problem_of, features_of):
    """Corners as features too, which leaves the world defined."""
    return problem_of(setup).replacing([features_of(setup, noise_px=0.5)])


@pytest.fixture(scope="module")
def scanned(room_of, sparse_room):
    room = room_of(sparse_room)
    return room.problem(room.state), room.state


FEATURES = "cameras", "features"


def outcome_of(problem, state):
    """As if the solver had ended here."""
    pieces, residuals = problem.pieces(), problem.residuals()
    problem.linearise(state, pieces, residuals, curved=True)
    solution = solve(pieces, problem.n_keyframes, problem.tolerance)
    draws = solution.factors.draws(np.random.default_rng(3), DRAWS, 1)
    return Outcome(problem, state, 0.0, residuals, solution.information, (), True, "", Draws(draws[:-1], draws[-1:]))


def paid(problem, state, dense, what):
    """What some factors pay for of chain and calib: tr(H_s H^-1), H_s their own sums."""
    pieces = problem.pieces()
    problem.linearise(state, pieces, problem.residuals(), curved=True)
    H, _ = dense(pieces, problem.n_keyframes)
    for piece in pieces:
        piece.clear()
        what(piece)
    own, _ = dense(pieces, problem.n_keyframes)
    return float(np.trace(np.linalg.solve(H, own)))


def spent(problem, outcome):
    return {(f.sensor, f.kind): f.count - f.dof for f in fits(problem, outcome)}


def of_imu(problem, state):
    return lambda p: problem.chain.accumulate(state, p, problem.chain.output())


def near(found, expected):
    """A mean of draws, each with a variance of twice its mean at most."""
    return abs(found - expected) < 4.0 * np.sqrt(2.0 * expected / DRAWS)


def test_degrees_of_freedom_of_corners_and_their_common_errors(cornered, setup, dense):
    state = setup.state
    found = spent(cornered, outcome_of(cornered, state))
    assert near(
        sum(v for (_, k), v in found.items() if k in cornered.chain.kinds),
        paid(cornered, state, dense, of_imu(cornered, state)),
    )
    cameras = of_type(cornered.factors, CornerFactor)
    for camera in cameras:
        # Each common error has a row of its own, its prior, and takes one degree of freedom of corners and prior.
        own = len(camera.noise.tau) * len(camera.times)
        own += paid(cornered, state, dense, lambda p, c=camera: c.accumulate(state, p, c.output(), curved=True))
        assert near(sum(v for (name, _), v in found.items() if name == camera.name), own)
    assert found["cam1", "common error"] > 0.1 * 2 * len(cameras[1].times)
    assert found["cam1", "stamp jitter"] > 0.1 * len(cameras[1].times)


def test_degrees_of_freedom_of_features(followed, setup, dense):
    factor, state = followed.factors[FEATURES], setup.state
    outcome = outcome_of(followed, state)
    found = spent(followed, outcome)
    own = paid(followed, state, dense, lambda p: factor.accumulate(state, p, factor.output(), curved=True))
    cameras = [found[c.name, "features"] for c in factor.cameras]
    assert near(sum(cameras) - 3 * factor.tracks.count, own)
    assert min(cameras) > 0.2 * sum(cameras)


def test_degrees_of_freedom_of_features_on_planes(setup, problem_of, features_on_planes, dense):
    """Their rows for that pay for a share of the points, and for what the calibration parameters have of them."""
    setup, factor = features_on_planes(setup, noise_px=0.5)
    problem, state = problem_of(setup).replacing([factor]), setup.state
    outcome = outcome_of(problem, state)
    found = spent(problem, outcome)
    own = paid(problem, state, dense, lambda p: factor.accumulate(state, p, factor.output(), curved=True))
    on = {c.name: found[c.name, "points on planes"] for c in factor.cameras}
    assert near(sum(found[c.name, "features"] + on[c.name] for c in factor.cameras) - 3 * factor.tracks.count, own)
    rows = int((factor.on.plane >= 0).sum())
    assert 0.1 * rows < sum(on.values()) < rows


def test_degrees_of_freedom_of_points_on_planes(scanned, dense):
    problem, state = scanned
    found = spent(problem, outcome_of(problem, state))
    (lidar,) = of_type(problem.factors, LidarFactor)
    own = paid(problem, state, dense, lambda p: lidar.accumulate(state, p, lidar.output()))
    assert near(found[lidar.name, "points"], own)


def test_an_early_outcome_has_no_draws_and_they_are_made_where_they_are_asked_for(followed, setup):
    start = setup.perturbed(np.random.default_rng(5), 1.0)
    early, late = minimise(followed, start, SolverOptions(0.5)), minimise(followed, start)
    assert early.draws is None and early.information.size == 0
    there = posterior(followed, late.state)
    for a, b in zip(
        (*there.free, *there.still), (*not_none(late.draws).free, *not_none(late.draws).still), strict=True
    ):
        np.testing.assert_allclose(a.chain, b.chain, atol=1e-6 * np.abs(b.chain).max())
        np.testing.assert_allclose(a.calib, b.calib, atol=1e-6 * np.abs(b.calib).max())
    without = replace(late, draws=None)
    np.testing.assert_allclose(
        spurious_information(followed, without).mean, spurious_information(followed, late).mean, rtol=1e-3, atol=1e-3
    )
    bare = Piece.bare(0, followed.n_keyframes - 1)
    features = followed.factors[FEATURES]
    out = features.output()
    features.accumulate(early.state, bare, out, sums=False)
    for a, b in zip(early.residuals[FEATURES].residual, out.residual, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)
