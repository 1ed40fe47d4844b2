"""Corners on edges that the lens bends: the predicted curvature against lines that are projected point by point."""

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.sensors.camera.corner_bias import with_bent_edges
from icalib.tools.simulation.projection import project


@pytest.fixture(scope="module")
def setup(unlike, setup_of):
    return setup_of(unlike)


def body_lines(setup, factor):
    """(N, 3), (N, 3): each corner in the camera's frame, and a direction on the board that no axis has."""
    stream, state = factor.stream, setup.state
    R, p, _ = setup.truth_at(stream.seconds + state.values[factor.name, "time_offset"][0])
    R_ic, p_ic = state.values[factor.name, "rotation"], state.values[factor.name, "translation"]
    tilt = state.values["board0", "tilt"]
    world = setup.bodies.target.points[stream.point] @ tilt.T
    X = np.einsum("nji,nj->ni", R[stream.image], world - p[stream.image]) - p_ic
    angle = np.random.default_rng(3).uniform(0.0, 2.0 * np.pi, len(X))
    on_board = np.stack([np.cos(angle), np.sin(angle), np.zeros(len(X))], axis=1) @ tilt.T
    return X @ R_ic, np.einsum("nji,nj->ni", R[stream.image], on_board) @ R_ic


@each("middle", [0.0, 1.0])
@each("camera", [0, 1])
def test_corners_move_by_the_curvature_of_projected_lines(setup, factor_of, camera, middle):
    factor, rng = factor_of(setup, camera), np.random.default_rng(1)
    sim_camera = setup.sim.scenario.cameras[camera]
    X, along = body_lines(setup, factor)
    n, half = len(X), 0.004
    s = half * (np.linspace(-1.0, 1.0, 21) + middle)
    lines = np.stack([project(sim_camera, X + step * along) for step in s])  # (21, N, 2)
    corner = project(sim_camera, X)
    # The curvature of a curve by its first and second derivatives, positive where it turns to the left on its way.
    by_s = np.polynomial.polynomial.polyfit(s / half - middle, lines.reshape(21, -1), 4).reshape(5, n, 2)
    (du, dv), (ddu, ddv) = by_s[1].T, 2.0 * by_s[2].T
    expected = (dv * ddu - du * ddv) / np.hypot(du, dv) ** 3
    edges = np.zeros((n, 2, 7), dtype=np.float32)
    edges[:, 1, 0:2], edges[:, 1, 2:4] = lines[0] - corner, lines[-1] - corner
    edges[:, 1, 4:6] = rng.normal(size=(n, 2))
    edges[:, 1, 6] = rng.normal(size=n) * 1e-3
    moved = with_bent_edges(replace(factor, stream=replace(factor.stream, edges=edges)), setup.state).stream.uv
    by = (expected - edges[:, 1, 6])[:, None] * edges[:, 1, 4:6]
    assert np.abs(expected).max() > 2e-4
    np.testing.assert_allclose(moved - factor.stream.uv, by, atol=2e-6 + 0.02 * np.abs(by).max())
    typical = np.abs(moved - factor.stream.uv - by)
    assert np.median(typical) < 0.01 * np.median(np.abs(by))


def test_corners_without_edges_stay(setup, factor_of):
    factor = factor_of(setup, 0)
    assert with_bent_edges(factor, setup.state) is factor
    none = replace(factor, stream=replace(factor.stream, edges=np.zeros((len(factor.stream.uv), 2, 7), np.float32)))
    np.testing.assert_array_equal(with_bent_edges(none, setup.state).stream.uv, factor.stream.uv)
