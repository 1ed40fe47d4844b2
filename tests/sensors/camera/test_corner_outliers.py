"""Which corners are rejected: those that stand alone, wherever in the image they are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from icalib.geometry.targets import AprilGrid, Checkerboard, Scene
from icalib.model.bodies import Bodies
from icalib.rig import Settings
from icalib.sensors.camera.corner_noise import inliers, isolated

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
        assert (alone & ~wrong).sum() <= 0.02 * (suspect & ~wrong).sum()
        kept, count = kept + (wrong & ~alone).sum(), count + wrong.sum()
    assert kept <= 0.05 * count  # those of the size of the lens's error beside them


def test_corners_that_were_found_together_say_nothing_for_one_another():
    """A tag that was taken for another is off by about the same in all its corners. Those just below the limit do not
    speak for those above it."""
    rng = np.random.default_rng(5)
    uv, tag = corners(rng)
    residual = NOISE_PX * rng.normal(size=uv.shape)
    own = np.flatnonzero(tag == 7)
    residual[own] = np.array([3.3, 2.9, 2.9, 3.3])[:, None] * [0.8, 0.6]
    suspect = np.linalg.norm(residual, axis=1) > 3.1
    assert np.flatnonzero(isolated(uv, residual, suspect, tag)).tolist() == own[[0, 3]].tolist()
    assert not isolated(uv, residual, suspect, np.arange(len(uv))).any()  # as corners of different tags they would


def test_tags_are_told_apart_in_a_scene_whose_boards_have_any_number_of_corners(unlike, setup_of, factor_of):
    """All of a tag's corners are off by about the same, and only one corner is above the limit."""
    board, grid = Checkerboard(5, 7, 0.03), AprilGrid(6, 6, 0.088, 0.3)
    factor = factor_of(setup_of(unlike), 0)
    scene = Scene(("board", "grid"), (board, grid))
    apart = 1e4 * factor.stream.image[:, None]  # px: only corners of the same image are neighbours
    stream = replace(factor.stream, point=factor.stream.point + len(board.points), uv=factor.stream.uv + apart)
    factor = replace(factor, stream=stream, bodies=Bodies(scene, (1,), (), False))
    out = factor.output(np.float64)
    out.root[:] = 1.0
    out.residual[:] = 0.1 * np.random.default_rng(2).standard_normal((len(stream.uv), 2))
    first, point = stream.start[3], factor.stream.point
    tags = (point - len(board.points)) // 4
    own = first + np.flatnonzero(tags[first:] == tags[first + 9])[:4]
    assert (stream.image[own] == 3).all()
    for k in range(4):
        out.residual[own] = [1.2, 1.2]
        out.residual[own[k]] = [1.6, 1.6]  # 2.26 px
        kept = inliers(factor, out, Settings(outlier_min_px=2.0))
        assert np.flatnonzero(~kept).tolist() == [own[k]]


def test_few_corners_or_none_suspect():
    uv, residual = np.array([[1.0, 2.0], [30.0, 4.0], [7.0, 90.0]]), np.array([[0.1, 0.0], [9.0, 0.0], [0.0, 0.1]])
    none = np.zeros(3, dtype=bool)
    assert not isolated(uv, residual, none, np.arange(3)).any()
    np.testing.assert_array_equal(isolated(uv, residual, residual[:, 0] > 1.0, np.arange(3)), [False, True, False])
