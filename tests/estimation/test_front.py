"""Chains whose nodes are tied by features: the elimination against dense linear algebra on random sums."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.estimation.arrowhead import NotDefiniteError, Piece, make_pieces, marginalise, solve
from icalib.estimation.front import Features, FeatureSums, plan
from icalib.estimation.state import NODE


def random_sums(piece, n_tracks, rng, whole):
    """Adds random IMU-like factors and features, each seen from nodes of the piece; returns rows of the whole system.

    whole: rows (m, columns + 1) are appended of [chain, features of all pieces, border, residual].
    """
    n, B = piece.last - piece.first + 1, piece.border.shape[0] - 1
    for k in range(n - 1):
        A, C, r = rng.normal(size=(40, 2 * NODE)), rng.normal(size=(40, B)), rng.normal(size=40)
        whole.append((np.arange(NODE * k, NODE * k + 2 * NODE) + NODE * piece.first, A, None, None, C, r))
    pairs = []
    for f in range(n_tracks):
        seen = rng.choice(n, size=min(n, rng.integers(1, 6)), replace=False)
        for k in np.sort(seen):
            pairs.append((f, int(k)))
            A, F = rng.normal(size=(3, NODE)), rng.normal(size=(3, 3))
            C, r = rng.normal(size=(3, B)), rng.normal(size=3)
            whole.append((np.arange(NODE) + NODE * (piece.first + k), A, f, F, C, r))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def add(piece, sums, pairs, rows):
    """The same factors in the sums of the piece."""
    index = {(f, k): e for e, (f, k) in enumerate(map(tuple, pairs))}
    for columns, A, f, F, C, r in rows:
        k = columns[0] // NODE - piece.first
        Cr = np.concatenate([C, r[:, None]], axis=1)
        piece.diagonal[k] += A[:, :NODE].T @ A[:, :NODE]
        piece.side[k] += A[:, :NODE].T @ Cr
        piece.border += Cr.T @ Cr
        if f is None:
            piece.upper[k] += A[:, :NODE].T @ A[:, NODE:]
            piece.diagonal[k + 1] += A[:, NODE:].T @ A[:, NODE:]
            piece.side[k + 1] += A[:, NODE:].T @ Cr
        else:
            sums.own[f] += F.T @ F
            sums.side[f] += F.T @ Cr
            sums.block[index[f, k]] += F.T @ A
    piece.border[-1, -1] = 0.0


def build(n_nodes, n_tracks, n_border, seed=0, pieces=None):
    """Pieces with features, and the dense normal equations of chain and border with the features taken out."""
    rng, J = np.random.default_rng(seed), []
    pieces = make_pieces(n_nodes, n_border) if pieces is None else pieces
    o, width = NODE * n_nodes, NODE * n_nodes + n_border + 1 + 3 * n_tracks * len(pieces)
    for i, piece in enumerate(pieces):
        rows = []
        pairs = random_sums(piece, n_tracks, rng, rows)
        sums = FeatureSums.zeros(n_tracks, pairs[:, 0].copy(), pairs[:, 1].copy(), n_border)
        add(piece, sums, pairs, rows)
        keep = len(pieces) > 1
        n = piece.last - piece.first + 1
        piece.features = Features(sums, plan(sums, n, piece.first == 0 or not keep, keep, 2))
        for columns, A, f, F, C, r in rows:
            row = np.zeros((len(r), width))
            row[:, columns], row[:, o : o + n_border], row[:, o + n_border] = A, C, r
            if f is not None:
                at = o + n_border + 1 + 3 * (i * n_tracks + f)
                row[:, at : at + 3] = F
            J.append(row)
    H = np.concatenate(J).T @ np.concatenate(J)
    m = o + n_border + 1
    H = H[:m, :m] - H[:m, m:] @ np.linalg.pinv(H[m:, m:]) @ H[m:, :m]
    return pieces, H[:-1, :-1], H[:-1, -1]


@pytest.mark.parametrize("n_tracks", [0, 1, 7])
@pytest.mark.parametrize("n_nodes", [3, 4, 5, 8, 11])
def test_solution_is_the_dense_one(n_nodes, n_tracks):
    pieces, H, g = build(n_nodes, n_tracks, 3)
    step, o = np.linalg.solve(H, -g), NODE * n_nodes
    information = H[o:, o:] - H[o:, :o] @ np.linalg.solve(H[:o, :o], H[:o, o:])
    solution = solve(pieces, n_nodes, np.ones(3))
    found = np.concatenate([solution.chain.ravel(), solution.border])
    np.testing.assert_allclose(found, step, rtol=0, atol=1e-9 * np.abs(step).max())
    np.testing.assert_allclose(solution.information, information, rtol=0, atol=1e-8 * np.abs(information).max())


def test_marginalise_takes_features_out():
    (piece,), H, g = build(6, 5, 4, pieces=(Piece.zeros(0, 5, 4),))
    o = NODE * 6
    X = np.linalg.solve(H[:o, :o], np.concatenate([H[:o, o:], g[:o, None]], axis=1))
    border = marginalise(piece)
    expected = np.concatenate([H[o:, o:], g[o:, None]], axis=1) - H[o:, :o] @ X
    np.testing.assert_allclose(border[:-1], expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(border, border.T, rtol=0, atol=0)


def test_features_are_alive_from_the_first_node_that_sees_them_to_the_last():
    track, node = np.array([0, 0, 1, 1, 2]), np.array([1, 6, 2, 3, 7])
    steps = plan(FeatureSums.zeros(3, track, node, 2), 8, True, False, 2)
    assert [s.surviving.tolist() for s in steps] == [[0], [0], [0], []]
    assert [s.dying.tolist() for s in steps] == [[], [1], [], [0, 2]]
    backwards = plan(FeatureSums.zeros(3, track, node, 2), 8, False, False, 2)
    assert [s.surviving.tolist() for s in backwards] == [[0], [0], [0], []]


def test_a_feature_that_nothing_determines_is_an_error():
    pieces, _, _ = build(8, 4, 2)
    sums = pieces[1].features.sums
    sums.own[2], sums.side[2], sums.block[sums.track == 2] = 0.0, 0.0, 0.0
    with pytest.raises(NotDefiniteError):
        solve(pieces, 8, np.ones(2))
