"""Chains whose keyframes are tied by features: the elimination against dense linear algebra on random sums."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.optim.arrowhead import NotDefiniteError, Piece, make_pieces, marginalise, solve
from icalib.optim.front import GROUP_SIZES, FeatureSums, PieceFeatures, plan
from icalib.optim.state import KEYFRAME_DIM


def random_images(n, per_keyframe, by_next, rng, dim):
    """Node (I,) of each image, and poses by keyframe and by the next one."""
    keyframe = np.repeat(np.arange(n - by_next), per_keyframe)
    pose = rng.normal(size=(len(keyframe), 6, dim))
    return keyframe, pose, rng.normal(size=pose.shape) if by_next else pose[:0]


def random_sums(piece, n_tracks, images, rng, whole):
    """Random IMU-like factors and features, each seen in images of the piece; returns pairs of feature and image.

    whole: rows (keyframe columns, their Jacobian, feature, image, Jacobians by feature and camera pose, by the
    calibration parameters, residual) are appended."""
    n, B = piece.last - piece.first + 1, piece.calib.shape[0] - 1
    for k in range(n - 1):
        A, C, r = rng.normal(size=(40, 2 * piece.dim)), rng.normal(size=(40, B)), rng.normal(size=40)
        whole.append((piece.dim * (piece.first + k), A, None, None, None, None, C, r))
    pairs, (keyframe, pose, next_pose) = [], images
    for f in range(n_tracks):
        begin, length = rng.integers(len(keyframe)), rng.integers(1, 1 + len(keyframe))
        life = np.arange(begin, min(begin + length, len(keyframe)))
        seen = rng.choice(life, size=min(len(life), rng.integers(1, 6)), replace=False)
        for i in np.sort(seen):
            pairs.append((f, int(i)))
            G, F = rng.normal(size=(3, 6)), rng.normal(size=(3, 3))
            C, r = rng.normal(size=(3, B)), rng.normal(size=3)
            A = np.concatenate([G @ pose[i], *([G @ next_pose[i]] if len(next_pose) else [])], axis=1)
            whole.append((piece.dim * (piece.first + keyframe[i]), A, f, i, F, G, C, r))
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def add(piece, sums, rows):
    """The same factors in the sums of the piece."""
    index = {pair: e for e, pair in enumerate(zip(sums.track.tolist(), sums.image.tolist(), strict=True))}
    for column, A, f, i, F, G, C, r in rows:
        k = column // piece.dim - piece.first
        Cr = np.concatenate([C, r[:, None]], axis=1)
        piece.diagonal[k] += A[:, : piece.dim].T @ A[:, : piece.dim]
        piece.side[k] += A[:, : piece.dim].T @ Cr
        piece.calib += Cr.T @ Cr
        if A.shape[1] > piece.dim:
            piece.upper[k] += A[:, : piece.dim].T @ A[:, piece.dim :]
            piece.diagonal[k + 1] += A[:, piece.dim :].T @ A[:, piece.dim :]
            piece.side[k + 1] += A[:, piece.dim :].T @ Cr
        if f is not None:
            sums.diagonal[f] += F.T @ F
            sums.side[f] += F.T @ Cr
            sums.block[index[f, i]] += F.T @ G
    piece.calib[-1, -1] = 0.0


def build(
    n_keyframes, n_tracks, n_calib, seed=0, pieces=None, per_keyframe=1, by_next=False, sizes=(2,), dim=KEYFRAME_DIM
):
    """Pieces with features, and the dense normal equations of chain and calibration parameters, features eliminated."""
    rng, J = np.random.default_rng(seed), []
    pieces = make_pieces(n_keyframes, n_calib, dim) if pieces is None else pieces
    o, width = dim * n_keyframes, dim * n_keyframes + n_calib + 1 + 3 * n_tracks * len(pieces)
    for i, piece in enumerate(pieces):
        rows, n, keep = [], piece.last - piece.first + 1, len(pieces) > 1
        images = random_images(n, per_keyframe, by_next, rng, dim)
        pairs = random_sums(piece, n_tracks, images, rng, rows)
        sums = FeatureSums.zeros(
            n_tracks, pairs[:, 0].copy(), pairs[:, 1].copy(), images[0], piece.side.shape[1:], by_next
        )
        sums.pose[:], sums.next_pose[:] = images[1:]
        add(piece, sums, rows)
        piece.features = PieceFeatures.of(sums, plan(sums, n, piece.first == 0 or not keep, keep, sizes=sizes))
        for column, A, f, _, F, _, C, r in rows:
            row = np.zeros((len(r), width))
            row[:, column : column + A.shape[1]], row[:, o : o + n_calib], row[:, o + n_calib] = A, C, r
            if f is not None:
                at = o + n_calib + 1 + 3 * (i * n_tracks + f)
                row[:, at : at + 3] = F
            J.append(row)
    H = np.concatenate(J).T @ np.concatenate(J)
    m = o + n_calib + 1
    H = H[:m, :m] - H[:m, m:] @ np.linalg.pinv(H[m:, m:]) @ H[m:, :m]
    return pieces, H[:-1, :-1], H[:-1, -1]


def check(pieces, H, g, n_keyframes):
    step, o = np.linalg.solve(H, -g), pieces[0].dim * n_keyframes
    information = H[o:, o:] - H[o:, :o] @ np.linalg.solve(H[:o, :o], H[:o, o:])
    solution = solve(pieces, n_keyframes, np.ones(len(H) - o))
    found = np.concatenate([solution.chain.ravel(), solution.calib])
    np.testing.assert_allclose(found, step, rtol=0, atol=1e-9 * np.abs(step).max())
    np.testing.assert_allclose(solution.information, information, rtol=0, atol=1e-8 * np.abs(information).max())


@each("n_tracks", [0, 1, 7, 40])
@each("n_keyframes", [3, 4, 5, 8, 11])
def test_solution_is_the_dense_one(n_keyframes, n_tracks):
    check(*build(n_keyframes, n_tracks, 3), n_keyframes)


@each("sizes", [(1,), (3,), GROUP_SIZES])
@each(("per_keyframe", "by_next"), [(1, False), (2, False), (3, False), (1, True), (2, True)])
def test_solution_is_the_dense_one_however_images_hang_on_keyframes(per_keyframe, by_next, sizes):
    check(*build(13, 30, 2, per_keyframe=per_keyframe, by_next=by_next, sizes=sizes), 13)


@each("by_next", [False, True])
def test_solution_is_the_dense_one_with_more_imus(by_next):
    """Keyframes of 33 dimensions, as those of three IMUs."""
    check(*build(9, 30, 3, by_next=by_next, dim=KEYFRAME_DIM + 18), 9)


def test_marginalise_takes_features_out():
    (piece,), H, g = build(6, 5, 4, pieces=(Piece.zeros(0, 5, 4),))
    o = KEYFRAME_DIM * 6
    X = np.linalg.solve(H[:o, :o], np.concatenate([H[:o, o:], g[:o, None]], axis=1))
    calib = marginalise(piece)
    expected = np.concatenate([H[o:, o:], g[o:, None]], axis=1) - H[o:, :o] @ X
    np.testing.assert_allclose(calib[:-1], expected, rtol=0, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(calib, calib.T, rtol=0, atol=0)


def by_step(lists, n):
    return [lists.values[lists.start[g] : lists.start[g + 1]].tolist() for g in range(n)]


def test_features_are_in_the_front_from_the_first_group_that_sees_them_to_the_last():
    track, keyframe = np.array([0, 0, 1, 1, 2, 3, 3]), np.array([1, 6, 2, 4, 7, 0, 2])
    for forwards in (True, False):
        order = plan(FeatureSums.zeros(4, track, keyframe, np.arange(8), (15, 3)), 8, forwards, False, sizes=(2,))
        assert by_step(order.keyframes, 4) == (
            [[0, 1], [2, 3], [4, 5], [6, 7]] if forwards else [[7, 6], [5, 4], [3, 2], [1, 0]]
        )
        assert by_step(order.local, 4) == ([[], [], [], [2]] if forwards else [[2], [], [], []])
        assert by_step(order.born, 4) == ([[0, 3], [1], [], []] if forwards else [[0], [1], [3], []])
        assert order.alive.tolist() == ([2, 3, 2, 1] if forwards else [1, 2, 3, 2])
    # Forwards, feature 3 leaves slot 1 in the second step, and 1 moves there from slot 2 in the third.
    order = plan(FeatureSums.zeros(4, track, keyframe, np.arange(8), (15, 3)), 8, True, False, sizes=(2,))
    assert by_step(order.dying, 4) == [[], [1], [1], [0]]
    assert by_step(order.leave, 4) == [[], [], [2], []]
    assert order.enter.tolist() == [1]


def test_the_size_of_groups_is_chosen_by_cost():
    """A group that holds all of its features' lives spares them the front; long lives make small groups best."""
    n, per_keyframe = 192, 200
    image = np.repeat(np.arange(n), per_keyframe)
    ends = np.arange(0, n, 24)
    sums = FeatureSums.zeros(
        len(image) // 24,
        image // 24 * per_keyframe + np.arange(len(image)) % per_keyframe,
        image,
        np.arange(n),
        (15, 41),
    )
    short = plan(sums, n, True, False, ends)
    assert np.diff(short.keyframes.start).tolist() == [24] * 8
    assert short.alive.max() == 0 and len(short.local.values) == len(sums.diagonal)
    lasting = FeatureSums.zeros(200, np.tile(np.arange(200), 2), np.repeat([0, n - 1], 200), np.arange(n), (15, 41))
    assert np.diff(plan(lasting, n, True, False).keyframes.start).max() < 24


def test_a_feature_that_nothing_determines_is_an_error():
    for f in range(4):
        pieces, _, _ = build(8, 4, 2)
        features = pieces[1].features
        assert features is not None
        sums = features.sums
        sums.diagonal[f], sums.side[f], sums.block[sums.track == f] = 0.0, 0.0, 0.0
        with pytest.raises(NotDefiniteError):
            solve(pieces, 8, np.ones(2))
