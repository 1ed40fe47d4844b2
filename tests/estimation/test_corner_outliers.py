"""Which corners are rejected: those that stand alone, wherever in the image they are."""

from __future__ import annotations

import numpy as np

from icalib.estimation.corner_outliers import isolated

SIZE = np.array([900.0, 600.0])
NOISE_PX = 0.15


def corners(rng: np.random.Generator, images: int = 40) -> tuple[np.ndarray, np.ndarray]:
    """uv (N, 2) of 60 corners an image, and the tag of each that it was found with, four corners of a tag."""
    centres = rng.uniform(0.0, SIZE, (images * 15, 2))
    uv = np.repeat(centres, 4, axis=0) + np.tile([[-8.0, -8.0], [8.0, -8.0], [8.0, 8.0], [-8.0, 8.0]], (images * 15, 1))
    return uv, np.repeat(np.arange(images * 15), 4)


def lens_error(uv: np.ndarray) -> np.ndarray:
    """Radial, none in the middle and 12 px in the corners of the image."""
    offset = (uv - 0.5 * SIZE) / np.linalg.norm(0.5 * SIZE)
    return 12.0 * offset * np.linalg.norm(offset, axis=1)[:, None] ** 5


def gross(rng: np.random.Generator, n: int, least: float, most: float) -> np.ndarray:
    angle, size = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(least, most, n)
    return size[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def test_an_error_of_the_lens_is_kept_and_gross_ones_are_not():
    kept, count = 0, 0
    for seed in range(4):
        rng = np.random.default_rng(seed)
        uv, tag = corners(rng)
        residual = lens_error(uv) + NOISE_PX * rng.normal(size=uv.shape)
        wrong = rng.random(len(uv)) < 0.02
        residual[wrong] += gross(rng, int(wrong.sum()), 4.0, 40.0)
        suspect = np.linalg.norm(residual, axis=1) > 1.0
        assert (suspect & ~wrong).sum() > 100  # without neighbours these would be rejected
        alone = isolated(uv, residual, suspect, tag)
        assert not (alone & ~suspect).any()
        assert (alone & ~wrong).sum() <= 0.02 * (suspect & ~wrong).sum()
        kept, count = kept + (wrong & ~alone).sum(), count + wrong.sum()
    assert kept <= 0.05 * count  # those of the size of the lens's error beside them


def test_corners_that_were_found_together_say_nothing_for_one_another():
    """A tag that was taken for another one is off by the same in all its corners."""
    rng = np.random.default_rng(5)
    uv, tag = corners(rng)
    residual = NOISE_PX * rng.normal(size=uv.shape)
    residual[tag == 7] += [3.0, 2.0]
    suspect = np.linalg.norm(residual, axis=1) > 1.0
    np.testing.assert_array_equal(isolated(uv, residual, suspect, tag), tag == 7)


def test_few_corners_or_none_suspect():
    uv, residual = np.array([[1.0, 2.0], [30.0, 4.0], [7.0, 90.0]]), np.array([[0.1, 0.0], [9.0, 0.0], [0.0, 0.1]])
    none = np.zeros(3, dtype=bool)
    assert not isolated(uv, residual, none, np.arange(3)).any()
    np.testing.assert_array_equal(isolated(uv, residual, residual[:, 0] > 1.0, np.arange(3)), [False, True, False])
