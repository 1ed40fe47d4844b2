"""Parabolas through poses, against motions whose derivatives are known."""

import numpy as np
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.initialize.smooth_trajectory import smooth_trajectory

TURN = np.array([0.3, -1.2, 2.0])  # rad/s


def moving(t):
    """Turning at a constant rate about a fixed axis, accelerating along a line."""
    R = (Rotation.from_rotvec([0.5, 0.1, -2.0]) * Rotation.from_rotvec(np.outer(t, TURN))).as_matrix()
    return R, np.outer(t, [1.0, -2.0, 0.3]) + 0.5 * np.outer(t**2, [0.4, 0.2, -1.0])


def test_what_is_a_parabola_is_met():
    t = np.sort(np.random.default_rng(0).uniform(0.0, 4.0, 300))
    at = np.linspace(t[0], t[-1], 57)
    path = smooth_trajectory(t, *moving(t), at)
    R, p = moving(at)
    np.testing.assert_allclose(path.rotation, R, atol=1e-11)
    np.testing.assert_allclose(path.position, p, atol=1e-11)
    np.testing.assert_allclose(path.rate, np.tile(TURN, (len(at), 1)), atol=1e-10)
    np.testing.assert_allclose(path.velocity, [1.0, -2.0, 0.3] + np.outer(at, [0.4, 0.2, -1.0]), atol=1e-10)
    felt = np.einsum("mji,j->mi", R, [0.4, 0.2, -1.0])
    np.testing.assert_allclose(path.acceleration, felt, atol=1e-9)
    assert path.near[2:-2].all()


def test_rates_are_those_of_the_body_where_the_axis_turns():
    def rotation(s):
        return Rotation.from_euler("zyx", np.stack([np.sin(s), 0.5 * np.cos(1.3 * s), 0.4 * np.sin(0.7 * s)], axis=1))

    t, at, h = np.arange(0.0, 5.0, 0.01), np.linspace(0.5, 4.5, 41), 1e-5
    path = smooth_trajectory(t, rotation(t).as_matrix(), np.zeros((len(t), 3)), at)
    rate = (rotation(at - h).inv() * rotation(at + h)).as_rotvec() / (2.0 * h)
    np.testing.assert_allclose(path.rate, rate, atol=0.01)


@each("step", [0.01, 0.05, 0.2])
def test_noise_is_smoothed_and_gaps_are_known(step):
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 30.0, step)
    t = t[(t < 10.0) | (t > 14.0)]
    R, p = moving(t)
    at = np.linspace(0.5, 29.5, 200)
    path = smooth_trajectory(t, R, p + 1e-3 * rng.standard_normal(p.shape), at)
    inside = (at > 10.0) & (at < 14.0)
    far = (at > 4.0 * step) & (np.abs(at - 12.0) > 2.0 + 4.0 * step) & (at < 30.0 - 5.0 * step)
    assert not path.near[inside].any() and path.near[far].all()
    off = (path.position - moving(at)[1])[path.near]
    assert np.sqrt(np.mean(off**2)) < 1e-3


def test_the_variance_of_the_acceleration_is_its_scatter():
    rng, t, at = np.random.default_rng(2), np.arange(0.0, 2.0, 0.05), np.array([0.4, 1.0, 1.33])
    sigma = np.where(np.abs(t - 1.2) < 0.2, 0.02, 1e-3)
    R, p = moving(t)
    noisy = (p + sigma[:, None] * rng.standard_normal(p.shape) for _ in range(400))
    paths = [smooth_trajectory(t, R, x, at, True, sigma**2) for x in noisy]
    scatter = np.std([path.acceleration for path in paths], axis=0)
    np.testing.assert_allclose(np.sqrt((scatter**2).mean(axis=1)), np.sqrt(paths[0].acceleration_variance), rtol=0.1)
    assert not smooth_trajectory(t, R, p, at).acceleration_variance.any()
