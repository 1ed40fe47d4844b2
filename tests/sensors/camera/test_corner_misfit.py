"""What residuals show of a lens that the model does not follow, beside noise and beside errors of single images."""

from __future__ import annotations

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import CornerStream
from icalib.sensors.camera.corner_noise import lens_misfit

SIZE = np.array([752.0, 480.0])


def stream_of(rng: np.random.Generator, images: int, corners: int = 80) -> CornerStream:
    uv = rng.uniform(0.0, SIZE, (images * corners, 2))
    start = corners * np.arange(images + 1)
    return CornerStream("cam0", np.arange(images) * 50_000_000, start, np.tile(np.arange(corners), images), uv)


def bent(uv: np.ndarray) -> np.ndarray:
    """0.3 px of either component (RMS) over the image, smooth in it."""
    x, y = (2.0 * uv / SIZE - 1.0).T
    return 0.3 * np.sqrt(2.0) * np.stack([np.sin(2.0 * np.pi * x), np.cos(2.0 * np.pi * y)], axis=1)


@each("images", [6, 40, 300])
def test_noise_and_what_single_images_share_are_no_misfit(images: int):
    for seed in range(10):
        rng = np.random.default_rng(seed)
        stream = stream_of(rng, images)
        shift = rng.normal(scale=0.3, size=(images, 2))[stream.image]
        residual = shift + rng.normal(scale=0.2, size=stream.uv.shape)
        found = lens_misfit(stream, residual, np.ones(len(residual), dtype=bool))
        assert found.rms == 0.0 and not found.field.any()


@pytest.mark.parametrize("images", [12, 100])
def test_an_error_that_stays_with_the_place_in_the_image_is_told_in_pixels(images: int):
    rng = np.random.default_rng(3)
    stream = stream_of(rng, images)
    error = bent(stream.uv)
    used = rng.random(len(error)) < 0.9
    residual = error + rng.normal(scale=0.2, size=error.shape)
    residual[~used] = 1e3
    found = lens_misfit(stream, residual, used)
    # A cell's mean is a little less than the error: that bends within the cell.
    assert found.rms == pytest.approx(0.3, rel=0.1)
    left = (residual - found.field)[used]
    assert np.sqrt(np.mean(left**2)) < 0.25


def test_no_corners_show_nothing():
    stream = stream_of(np.random.default_rng(0), 3)
    found = lens_misfit(stream, np.zeros((len(stream.uv), 2)), np.zeros(len(stream.uv), dtype=bool))
    assert found.rms == 0.0 and found.field.shape == (len(stream.uv), 2)
