"""The arrowhead solver against dense linear algebra on random chains."""

import numpy as np
import pytest
from tests.cases import each

from icalib.optim import arrowhead
from icalib.optim.arrowhead import (
    UNOBSERVABLE_BELOW,
    NotDefiniteError,
    Piece,
    calib_draws,
    calib_step,
    make_pieces,
    marginalise,
    marginalise_in_segments,
    solve,
)
from icalib.optim.state import KEYFRAME_DIM


def random_pieces(n_keyframes, n_calib, seed=0, calib_rank=None, dim=KEYFRAME_DIM):
    """Pieces filled with the sums of random factors: each on two neighbouring keyframes and the calibration parameters,
    or on one keyframe."""
    rng = np.random.default_rng(seed)
    pieces = make_pieces(n_keyframes, n_calib, dim)
    mix = np.eye(n_calib)
    if calib_rank is not None:
        mix = rng.normal(size=(calib_rank, n_calib))
    for piece in pieces:
        for k in range(piece.last - piece.first + 1):
            pair = k < piece.last - piece.first
            own = (
                piece.first + k != piece.first or piece.first == 0
            )  # a shared keyframe's own factor belongs to one piece
            for rows, both in ((22, True), (30, False)):
                if (both and not pair) or (not both and not own):
                    continue
                A, B = rng.normal(size=(2, rows, dim))
                C, r = rng.normal(size=(rows, len(mix))) @ mix, rng.normal(size=rows)
                add_factor(piece, k, A, B if both else None, C, r)
    return pieces


def add_factor(piece, k, A, B, C, r):
    Cr = np.concatenate([C, r[:, None]], axis=1)
    piece.diagonal[k] += A.T @ A
    piece.side[k] += A.T @ Cr
    if B is not None:
        piece.upper[k] += A.T @ B
        piece.diagonal[k + 1] += B.T @ B
        piece.side[k + 1] += B.T @ Cr
    piece.calib += Cr.T @ Cr
    piece.calib[-1, -1] = 0.0


def schur(H, g, n_keyframes):
    """Border with the chain eliminated: information and gradient."""
    o = KEYFRAME_DIM * n_keyframes
    X = np.linalg.solve(H[:o, :o], np.concatenate([H[:o, o:], g[:o, None]], axis=1))
    return H[o:, o:] - H[o:, :o] @ X[:, :-1], g[o:] - H[o:, :o] @ X[:, -1]


def flat(solution):
    return np.concatenate([solution.chain.ravel(), solution.calib])


@each("n_calib", [0, 1, 3, 8])
@each("n_keyframes", range(1, 13))
def test_solution_is_the_dense_one(dense, n_keyframes, n_calib):
    pieces = random_pieces(n_keyframes, n_calib)
    H, g = dense(pieces, n_keyframes)
    information, _ = schur(H, g, n_keyframes)
    solution = solve(pieces, n_keyframes, np.ones(n_calib))
    step = np.linalg.solve(H, -g)
    np.testing.assert_allclose(flat(solution), step, rtol=0, atol=1e-10 * np.abs(step).max())
    np.testing.assert_allclose(solution.information, information, rtol=0, atol=1e-9)
    assert solution.decrease == pytest.approx(-(g @ step + 0.5 * step @ H @ step), rel=1e-10)


@each("n_keyframes", [1, 3, 4, 7])
@each("damping", [1e-9, 1e-2, 10.0])
def test_damping_scales_the_whole_diagonal(dense, n_keyframes, damping):
    pieces = random_pieces(n_keyframes, 4, seed=1)
    H, g = dense(pieces, n_keyframes)
    H = H + damping * np.diag(np.diag(H))
    step = np.linalg.solve(H, -g)
    solution = solve(pieces, n_keyframes, np.ones(4), damping)
    np.testing.assert_allclose(flat(solution), step, rtol=0, atol=1e-10 * np.abs(step).max())
    np.testing.assert_allclose(solution.information, schur(H, g, n_keyframes)[0], rtol=1e-9, atol=1e-9)
    assert solution.decrease == pytest.approx(-(g @ step + 0.5 * step @ H @ step), rel=1e-10)


def test_the_scale_of_the_tolerances_does_not_matter_where_all_is_determined():
    one = solve(random_pieces(6, 3), 6, np.ones(3))
    other = solve(random_pieces(6, 3), 6, np.array([0.3, 2.0, 7.0]))
    np.testing.assert_allclose(flat(one), flat(other), rtol=0, atol=1e-12)


def test_long_chain_is_cut_into_two_pieces_that_share_a_keyframe():
    assert [(p.first, p.last) for p in make_pieces(9, 2)] == [(0, 4), (4, 8)]
    assert [(p.first, p.last) for p in make_pieces(4, 2)] == [(0, 2), (2, 3)]
    assert [(p.first, p.last) for p in make_pieces(3, 2)] == [(0, 2)]


@each("n_keyframes", [1, 2, 3])
def test_marginalise_is_the_schur_complement(dense, n_keyframes):
    (piece,) = random_pieces(n_keyframes, 5, seed=2)
    H, g = dense((piece,), n_keyframes)
    information, gradient = schur(H, g, n_keyframes)
    calib = marginalise(piece)
    np.testing.assert_allclose(calib[:-1, :-1], information, rtol=0, atol=1e-10)
    np.testing.assert_allclose(calib[:-1, -1], gradient, rtol=0, atol=1e-10)
    np.testing.assert_allclose(calib[-1, :-1], gradient, rtol=0, atol=1e-10)


def whole_and_segments(n_keyframes, n_calib, seed):
    """A random chain whole, and a function that makes its part between two keyframes: factors on a keyframe and the
    next one belong to the part that holds both, those on a keyframe alone to the part that it begins (the last one:
    ends)."""
    rng = np.random.default_rng(seed)
    factors = []
    for k in range(n_keyframes):
        for both in (True, False) if k < n_keyframes - 1 else (False,):
            A, B = rng.normal(size=(2, 30, KEYFRAME_DIM))
            factors.append((k, A, B if both else None, rng.normal(size=(30, n_calib)), rng.normal(size=30)))

    def part(first, last):
        piece = Piece.zeros(first, last, n_calib)
        for k, A, B, C, r in factors:
            if first <= k < last or (k == last == n_keyframes - 1 and B is None):
                add_factor(piece, k - first, A, B, C, r)
        return piece

    return part(0, n_keyframes - 1), part


@each("segment", [1, 2, 3, 100])
@each("n_keyframes", [1, 2, 3, 4, 6, 7, 8])
def test_marginalising_in_segments_is_the_schur_complement(monkeypatch, dense, n_keyframes, segment):
    monkeypatch.setattr(arrowhead, "SEGMENT_KEYFRAMES", segment)
    whole, part = whole_and_segments(n_keyframes, 5, seed=4)
    H, g = dense((whole,), n_keyframes)
    information, gradient = schur(H, g, n_keyframes)
    calib = marginalise_in_segments(part, n_keyframes)
    np.testing.assert_allclose(calib[:-1, :-1], information, rtol=0, atol=1e-10)
    np.testing.assert_allclose(calib[:-1, -1], gradient, rtol=0, atol=1e-10)


@each("keyframe", [0, 2, 3, 6])
def test_marginalising_in_segments_raises_where_a_keyframe_is_not_determined(monkeypatch, keyframe):
    monkeypatch.setattr(arrowhead, "SEGMENT_KEYFRAMES", 3)
    _, part = whole_and_segments(7, 2, seed=4)

    def spoilt(first, last):
        piece = part(first, last)
        if first <= keyframe <= last:
            piece.diagonal[keyframe - first] -= 1e3 * np.eye(KEYFRAME_DIM)
        return piece

    with pytest.raises(NotDefiniteError):
        marginalise_in_segments(spoilt, 7)


@pytest.mark.parametrize("n_keyframes", [3, 8])
def test_unobservable_directions_stay_and_the_rest_is_solved(dense, n_keyframes):
    """Factors see three combinations of five calibration parameters: the two others are held."""
    pieces = random_pieces(n_keyframes, 5, seed=3, calib_rank=3)
    tolerance = np.array([1.0, 0.5, 2.0, 1.0, 0.3])
    H, g = dense(pieces, n_keyframes)
    information, gradient = schur(H, g, n_keyframes)
    values, vectors = np.linalg.eigh(information * np.outer(tolerance, tolerance))
    assert values[1] < 1e-8 < UNOBSERVABLE_BELOW < values[2]
    solution = solve(pieces, n_keyframes, tolerance)
    np.testing.assert_allclose(vectors[:, :2].T @ (solution.calib / tolerance), 0.0, atol=1e-12)
    free = tolerance[:, None] * vectors[:, 2:]
    expected = free @ np.linalg.solve(free.T @ information @ free, -free.T @ gradient)
    np.testing.assert_allclose(solution.calib, expected, rtol=0, atol=1e-10)
    o, step = KEYFRAME_DIM * n_keyframes, flat(solution)
    np.testing.assert_allclose((H @ step + g)[:o], 0.0, atol=1e-9)  # the chain follows the held parameters
    assert solution.decrease == pytest.approx(-(g @ step + 0.5 * step @ H @ step), rel=1e-8)


def test_draws_do_not_depend_on_the_basis_of_an_eigenspace():
    """All eigenvalues are equal but for rounding, which chooses the eigenvectors."""
    rng = np.random.default_rng(0)
    noise, white = rng.standard_normal((6, 6)), rng.standard_normal((6, 4))
    tolerance, fixed = np.ones(6), np.linalg.qr(rng.standard_normal((6, 2)))[0]
    turned = fixed @ np.array([[0.6, 0.8], [0.8, -0.6]])
    expected = calib_draws(4.0 * np.eye(6), tolerance, fixed, white)
    found = calib_draws(4.0 * np.eye(6) + 1e-13 * (noise + noise.T), tolerance, turned, white)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    np.testing.assert_allclose(expected, 0.5 * (white - fixed @ fixed.T @ white), atol=1e-12)


@pytest.mark.parametrize("factor", [0.99, 1.01])
def test_calibration_parameters_between_held_and_moved(factor):
    """One parameter with a tolerance of 0.1: information UNOBSERVABLE_BELOW / 0.1^2 is where it begins to move."""
    information, gradient = np.array([[factor * UNOBSERVABLE_BELOW / 0.1**2]]), np.array([3.0])
    step, decrease = calib_step(information, gradient, np.array([0.1]))
    expected = 0.0 if factor < 1.0 else -3.0 / information[0, 0]
    assert step[0] == pytest.approx(expected, rel=1e-12)
    assert decrease == pytest.approx(-0.5 * 3.0 * expected, rel=1e-12)


def test_a_direction_that_only_the_prior_of_a_nuisance_parameter_bounds_moves():
    """y = 30 (x + n) + noise with a prior on n: as observable as the prior says, and not fixed."""
    row, prior_sigma = np.array([30.0, 30.0]), 14.0
    information = np.outer(row, row) + np.diag([0.0, prior_sigma**-2.0])
    gradient = np.array([-60.0, -60.0 + 0.01])
    assert np.linalg.eigvalsh(information)[0] < UNOBSERVABLE_BELOW
    step, decrease = calib_step(information, gradient, np.ones(2), essential=np.array([0]))
    np.testing.assert_allclose(step, -np.linalg.solve(information, gradient), rtol=1e-6)
    assert decrease == pytest.approx(0.5 * gradient @ np.linalg.solve(information, gradient), rel=1e-6)
    fixed, _ = calib_step(information, gradient, np.ones(2), np.array([[1.0], [0.0]]), np.array([0]))
    assert fixed[0] == 0.0 and fixed[1] == pytest.approx(-gradient[1] / information[1, 1])


@each("keyframe", [0, 4, 8])
def test_a_keyframe_that_nothing_determines_is_an_error(keyframe):
    pieces = random_pieces(9, 2)
    for piece in pieces:
        if piece.first <= keyframe <= piece.last:
            k = keyframe - piece.first
            piece.diagonal[k], piece.upper[k], piece.side[k] = 0.0, 0.0, 0.0
            if k > 0:
                piece.upper[k - 1] = 0.0
    with pytest.raises(NotDefiniteError):
        solve(pieces, 9, np.ones(2))


def test_not_a_number_is_an_error():
    pieces = random_pieces(9, 2)
    pieces[1].diagonal[2, 3, 3] = np.nan
    with pytest.raises(NotDefiniteError):
        solve(pieces, 9, np.ones(2))


def test_marginalise_raises_too():
    (piece,) = random_pieces(2, 2)
    piece.diagonal[1] = -np.eye(KEYFRAME_DIM)
    with pytest.raises(NotDefiniteError):
        marginalise(piece)


def test_the_same_sums_give_the_same_bits():
    first = solve(random_pieces(12, 6), 12, np.ones(6), 1e-3)
    for _ in range(5):
        again = solve(random_pieces(12, 6), 12, np.ones(6), 1e-3)
        np.testing.assert_array_equal(flat(again), flat(first))
        np.testing.assert_array_equal(again.information, first.information)
