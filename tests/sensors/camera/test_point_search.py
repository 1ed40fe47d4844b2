"""Points of the scene on their way to where they cost least, from wherever they are first looked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.optim.arrowhead import make_pieces
from icalib.optim.state import KEYFRAME_DIM
from icalib.sensors.camera.track_factor import FeatureFactor
from icalib.sensors.camera.track_surfaces import MAX_DISTANCE_M
from icalib.sensors.camera.tracks import FeatureOutput
from icalib.tools.simulation import handheld, simulate


@pytest.fixture(scope="module")
def setup(setup_of):
    return setup_of(simulate(handheld(1.5), seed=4))


@pytest.fixture(scope="module")
def factor(setup, features_of) -> FeatureFactor:
    return features_of(setup, noise_px=0.5)


def outcome(factor: FeatureFactor, state) -> tuple[float, FeatureOutput]:
    out = factor.output()
    cost = sum(factor.accumulate(state, p, out, sums=False) for p in make_pieces(factor.n_keyframes, None))
    return cost, out


def looked_for(factor: FeatureFactor, start: np.ndarray) -> FeatureFactor:
    return replace(factor, tracks=replace(factor.tracks, start=start))


@each("times", [0.5, 10.0, 1e4])
def test_points_come_back_from_near_and_far(factor, setup, times: float):
    """Once a step had thrown one to 1e13 m it stayed there, a hundred of them costing as much as all else."""
    cost, out = outcome(factor, setup.state)
    away, there = outcome(looked_for(factor, times * factor.tracks.start), setup.state)
    assert away == pytest.approx(cost, rel=1e-9)
    np.testing.assert_allclose(there.points, out.points, atol=1e-5)


@pytest.fixture(scope="module")
def starry(factor, setup) -> tuple[FeatureFactor, int]:
    """The features, of which one is seen from everywhere in one direction, as a star is; and its track."""
    views = factor._views(setup.state, 0, factor.n_keyframes)
    track = next(t for t in range(factor.tracks.count) if factor.tracks.camera[t] == 0)
    star = views[0].poses.rotation[factor.tracks.image[track]] @ [0.05, 0.02, 1.0]
    streams = list(factor.streams)
    for view in views:
        stream, own = streams[view.index], np.flatnonzero(factor.tracks.track[view.index] == track)
        seen, _ = view.camera.model.project(
            view.params, np.einsum("nij,j->ni", view.poses.rotation.transpose(0, 2, 1), star)
        )
        uv = stream.uv.copy()
        uv[own] = seen[stream.image[own]]
        streams[view.index] = replace(stream, uv=uv)
    return replace(factor, streams=tuple(streams)), track


def test_a_point_at_infinity_stays_in_its_direction(starry, setup):
    """It goes as far as points may, and its cost is that of the star."""
    distant, track = starry
    _, out = outcome(distant, setup.state)
    for view in distant._views(setup.state, 0, distant.n_keyframes):
        own = np.flatnonzero((distant.tracks.track[view.index] == track) & distant.keep[view.index])
        assert np.abs(out.residual[view.index][own]).max(initial=0.0) < 0.02
    assert np.linalg.norm(out.points[track]) == pytest.approx(MAX_DISTANCE_M, rel=1e-6)


def test_a_point_at_infinity_says_nothing_about_the_axes_of_the_world(starry, setup, dense):
    """A world that is turned about gravity, with all that is in it, looks the same. A prior on the place of a point at
    100 km would show its heading to 10 mrad."""
    distant, state = starry[0], setup.state
    n = distant.n_keyframes
    pieces = [distant.attach(p, True) for p in make_pieces(n, setup.layout.size)]
    for piece in pieces:
        distant.accumulate(state, piece, distant.output())
    H, _ = dense(pieces, n)
    turn, up = np.zeros(len(H)), np.array([0.0, 0.0, 1.0])
    moved = up @ state.rotation, np.cross(up, state.position), np.cross(up, state.velocity)
    turn[: KEYFRAME_DIM * n].reshape(n, KEYFRAME_DIM)[:, :9] = np.hstack(moved)
    assert abs(turn @ H @ turn) < 1e-3


def test_coarse_noise_is_as_large_as_most_errors_and_no_less_than_stated(factor, setup):
    """Of one camera errors are drawn; of the others all that is seen fits to rounding."""
    noisy, sigma = 1, 7.0
    stream = factor.streams[noisy]
    errors = np.random.default_rng(0).normal(0.0, sigma, stream.uv.shape)
    streams = list(factor.streams)
    streams[noisy] = replace(stream, uv=stream.uv + errors)
    _, out = outcome(factor, setup.state)
    found = replace(factor.warm_started(out), streams=tuple(streams)).coarse(setup.state).noise
    n = int((factor.tracks.track[noisy] >= 0).sum())
    assert found[noisy].sigma == pytest.approx(sigma, rel=3.0 / np.sqrt(n))
    assert [s for i, s in enumerate(found) if i != noisy] == [s for i, s in enumerate(factor.noise) if i != noisy]


def test_none_is_followed_where_every_other_image_looks_away(factor, setup):
    """As where a first motion is wrong: no point is seen by all images of its track, and there is no usual misfit."""
    rotation = setup.state.rotation.copy()
    rotation[::2] = rotation[::2] @ np.diag([-1.0, 1.0, -1.0])
    assert factor.n_used > 0
    assert factor.cut(replace(setup.state, rotation=rotation), ()).n_used == 0


def test_settled_features_are_where_they_were(factor, setup):
    cost, out = outcome(looked_for(factor, 3.0 * factor.tracks.start), setup.state)
    again, there = outcome(factor.warm_started(out), setup.state)
    assert again == pytest.approx(cost, rel=1e-12)
    np.testing.assert_allclose(there.points, out.points, atol=1e-9)
