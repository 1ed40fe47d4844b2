"""Windows of mean rates follow the noise of poses, and so does the smoothing of a path."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.initialize.smooth_trajectory import (
    MIN_HALF_WINDOW_S,
    rate_window,
    rotation_noise,
    smooth_trajectory,
    window_rates,
)


def turning(hz: float, noise: float, seconds: float = 20.0, seed: int = 0):
    """Stamps, rotations with noise [rad], and the true rates [rad/s] of a motion about three axes."""
    t = np.arange(0.0, seconds, 1.0 / hz)
    rng = np.random.default_rng(seed)
    w = np.stack([0.6 * np.sin(1.9 * t), 0.5 * np.cos(1.3 * t), 0.4 * np.sin(2.7 * t + 1.0)], axis=1)
    R = [Rotation.identity()]
    for rate in 0.5 * (w[1:] + w[:-1]):
        R.append(R[-1] * Rotation.from_rotvec(rate / hz))
    noisy = Rotation.concatenate(R) * Rotation.from_rotvec(noise * rng.standard_normal((len(t), 3)))
    return t, noisy.as_matrix(), w


@each(("hz", "noise"), [(100.0, 1e-3), (30.0, 9e-3), (10.0, 2e-2)])
def test_the_noise_of_rotations_is_found(hz, noise):
    _, R, _ = turning(hz, noise)
    assert rotation_noise(R) == pytest.approx(noise, rel=0.15)


def test_good_poses_have_the_shortest_window():
    t, R, _ = turning(100.0, 1e-3)
    assert rate_window(t, R, 0.1, 0.25) == 0.1


def test_half_a_degree_needs_a_third_of_a_second():
    t, R, _ = turning(30.0, np.deg2rad(0.5))
    window = rate_window(t, R, 0.1, 0.25)
    assert 0.2 <= window <= 0.5
    a, b, rate = window_rates(t, R, window, 0.25)
    assert (t[b] - t[a] >= window - 1e-9).all() and len(rate) > 500


@pytest.mark.parametrize("noise", [0.0, 1e-4])
def test_a_path_through_good_poses_is_smoothed_as_little_as_before(noise):
    t, R, _ = turning(100.0, noise)
    at = np.array([5.003, 10.001])
    path = smooth_trajectory(t, R, np.zeros((len(t), 3)), at)
    near = [np.flatnonzero(np.abs(t - s) <= MIN_HALF_WINDOW_S) for s in at]
    for s, k, rate in zip(at, near, path.rate, strict=True):
        vectors = (Rotation.from_matrix(R[k[len(k) // 2]]).inv() * Rotation.from_matrix(R[k])).as_rotvec()
        slope = np.polyfit(t[k] - s, vectors, 2)[1]
        assert np.abs(slope - rate).max() < 5e-3


def test_a_path_through_noisy_poses_is_smoothed_more():
    t, R, w = turning(30.0, np.deg2rad(0.5))
    path = smooth_trajectory(t, R, np.zeros((len(t), 3)), t)
    inner = (t > 1.0) & (t < 19.0)
    assert np.sqrt(np.mean((path.rate - w)[inner] ** 2)) < 0.05  # 0.1 where +-0.1 s are taken
