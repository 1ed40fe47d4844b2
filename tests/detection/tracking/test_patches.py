"""Alignment with the first view against images that are made from the same function, moved by a known map."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.detection.tracker import RADIUS, align, cut_templates

SIZE = 96


def _grey(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth pattern of four waves with texture in all directions."""
    waves = ((0.35, 0.1, 0.2), (-0.12, 0.4, 1.0), (0.3, 0.33, 2.0), (0.22, -0.28, 0.7))
    return 120.0 + 25.0 * np.sum([np.sin(a * x + b * y + c) for a, b, c in waves], axis=0)


def _image(A: np.ndarray, shift: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """The pattern mapped so that what was at centre + d is at centre + shift + A d."""
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    d = np.linalg.inv(A) @ np.stack([u - centre[0] - shift[0], v - centre[1] - shift[1]]).reshape(2, -1)
    return _grey(*(centre[:, None] + d)).reshape(SIZE, SIZE).astype(np.float32)


@each(
    ("A", "shift"),
    [
        (np.eye(2), (0.4, -0.3)),
        (np.array([[1.1, 0.05], [-0.08, 0.95]]), (0.6, 0.7)),
        (np.array([[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]]), (-0.5, 0.2)),
    ],
)
@each(("gain", "offset"), [(1.0, 0.0), (0.6, 40.0)])
def test_a_known_map_is_found_whatever_the_exposure(A, shift, gain, offset):
    centre = np.array([48.0, 48.0])
    first, good = cut_templates(_image(np.eye(2), np.zeros(2), centre), centre[None])
    assert good.all()
    seen = (gain * _image(A, np.array(shift), centre) + offset).astype(np.float32)
    uv, found, ncc = centre[None].copy(), np.eye(2)[None].copy(), np.empty(1)
    align(seen, first, uv, found, ncc)
    assert ncc[0] > 0.995
    np.testing.assert_allclose(uv[0] - centre, shift, atol=0.035)  # linear interpolation of waves of 15 px
    np.testing.assert_allclose(found[0], A, atol=0.02)


def test_the_spread_is_what_moves_the_alignment_where_the_map_is_curved():
    """Displacements of curvature x^2 / 2 along both axes and in both directions."""
    centre, curvature = np.array([48.0, 48.0]), 2e-3
    first, _ = cut_templates(_image(np.eye(2), np.zeros(2), centre), centre[None])
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float64)
    shifts = []
    for along in (u, v):
        for component in range(2):
            moved = 0.5 * curvature * (along - 48.0) ** 2
            at = [u - moved, v] if component == 0 else [u, v - moved]
            seen = _grey(*at).astype(np.float32)
            uv, ncc = centre[None].copy(), np.empty(1)
            for _ in range(3):
                align(seen, first, uv, np.eye(2)[None].copy(), ncc)
            shifts.append(uv[0, component] - 48.0)
    assert np.mean(shifts) == pytest.approx(0.5 * curvature * first.spread[0], rel=0.1)
    assert 0.2 * 56.0 / 3.0 < first.spread[0] < 56.0 / 3.0  # of an even patch of 15 px


def test_another_pattern_is_not_alike():
    centre = np.array([48.0, 48.0])
    first, _ = cut_templates(_image(np.eye(2), np.zeros(2), centre), centre[None])
    noise = np.random.default_rng(0).normal(120.0, 25.0, (SIZE, SIZE)).astype(np.float32)
    ncc = np.empty(1)
    align(noise, first, centre[None].copy(), np.eye(2)[None].copy(), ncc)
    assert ncc[0] < 0.5


def test_a_patch_that_leaves_the_image_is_not_alike():
    centre = np.array([48.0, 48.0])
    image = _image(np.eye(2), np.zeros(2), centre)
    first, _ = cut_templates(image, centre[None])
    ncc = np.empty(1)
    align(image, first, np.array([[RADIUS - 1.0, 48.0]]), np.eye(2)[None].copy(), ncc)
    assert ncc[0] == -1.0


def test_an_even_patch_and_an_edge_have_no_template():
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    edge = np.where(u < 48, 50.0, 150.0).astype(np.float32)
    assert not cut_templates(np.full_like(u, 90.0), np.array([[48, 48]]))[1].any()
    assert not cut_templates(edge, np.array([[48, 48]]))[1].any()
