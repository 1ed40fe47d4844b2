"""The image of a patch's mean ray against the mean over many points of the patch."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.data.measurements import TrackStream
from icalib.geometry.cameras import camera_model
from icalib.sensors.camera.track_surfaces import with_curved_patches

LENSES = {
    "pinhole-radtan": [458.7, 457.3, 367.2, 248.4, -0.283, 0.074, 2e-4, 2e-5],
    "pinhole-equidistant": [230.0, 229.5, 372.2, 241.4, -0.012, 0.006, -0.004, 0.001],
}


def a_stream(uv: np.ndarray, spread: np.ndarray) -> TrackStream:
    n = len(uv)
    numbers = np.arange(n)
    return TrackStream("cam0", np.zeros(1, np.int64), np.array([0, n]), numbers, uv, views=numbers, spread=spread)


@pytest.mark.parametrize("name", list(LENSES))
def test_observations_move_to_the_mean_ray(name):
    model, params = camera_model(name), np.array(LENSES[name])
    rng = np.random.default_rng(0)
    uv = rng.uniform([40.0, 40.0], [712.0, 440.0], (30, 2))
    spread = rng.uniform(5.0, 15.0, 30)
    found = with_curved_patches(a_stream(uv, spread), model, params).uv
    moved = []
    for centre, square in zip(uv, spread, strict=True):
        # A square patch of that second moment, sampled densely.
        side = np.sqrt(3.0 * square) * (np.arange(41) - 20) / 20.5
        around = centre + np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
        ray = model.unproject(params, around)[0].mean(axis=0)
        moved.append(model.project(params, ray[None])[0][0])
    change = np.array(moved) - uv
    assert np.linalg.norm(change, axis=1).max() > 0.01
    np.testing.assert_allclose(found - uv, change, atol=0.01 * np.abs(change).max())


def test_nothing_changes_without_a_spread_or_outside_of_the_model():
    """Beyond some radius this lens with barrel distortion has no ray."""
    model, params = camera_model("pinhole-radtan"), np.array([458.7, 457.3, 367.2, 248.4, -0.283, 0.0, 0.0, 0.0])
    uv = np.array([[367.0, 248.0], [1200.0, 248.0]])
    assert with_curved_patches(a_stream(uv, np.zeros(0)), model, params).uv is uv
    found = with_curved_patches(a_stream(uv, np.full(2, 9.0)), model, params).uv
    np.testing.assert_array_equal(found[1], uv[1])
    assert np.abs(found[0] - uv[0]).max() < 1e-3
