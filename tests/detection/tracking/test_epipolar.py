"""Points that move by themselves against rays of a scene that stands still."""

from __future__ import annotations

import numpy as np
import pytest

from icalib.detection.tracking.epipolar import FEWEST, fits_one_motion
from icalib.geometry import so3

PX_PER_RAD = 450.0


def _rays(n: int, rng: np.random.Generator, noise_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Rays of n points from two places, 0.3 m and 8 deg apart."""
    points = np.column_stack([rng.uniform(-3, 3, n), rng.uniform(-2, 2, n), rng.uniform(2, 7, n)])
    R, p = so3.exp(np.array([0.03, 0.13, -0.05])), np.array([0.2, 0.1, 0.2])
    f, h = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (points, (points - p) @ R))
    f, h = (x + noise_px / PX_PER_RAD * rng.normal(size=x.shape) for x in (f, h))
    return tuple(x / np.linalg.norm(x, axis=1, keepdims=True) for x in (f, h))


@pytest.mark.parametrize("seed", range(4))
def test_a_third_that_moves_is_told_from_the_rest(seed):
    rng = np.random.default_rng(seed)
    f, h = _rays(90, rng, 0.2)
    h[:30] = h[:30] @ so3.exp(np.array([0.04, 0.0, 0.03]))  # as one body, 20 px away
    fits = fits_one_motion(f, h, PX_PER_RAD, seed)
    assert fits[30:].mean() > 0.95
    assert fits[:30].mean() < 0.35  # some move along their epipolar lines


def test_hardly_anything_is_rejected_where_all_stands_still():
    kept = [fits_one_motion(*_rays(90, np.random.default_rng(k), 0.2), PX_PER_RAD, k).mean() for k in range(20)]
    assert np.mean(kept) > 0.99


def test_too_few_points_tell_nothing():
    f, h = _rays(FEWEST - 1, np.random.default_rng(2), 0.2)
    h[0] = h[0] @ so3.exp(np.array([0.3, 0.0, 0.0]))
    assert fits_one_motion(f, h, PX_PER_RAD, 0).all()
