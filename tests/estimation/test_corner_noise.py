"""The noise of corners: estimated from residuals, with the detector's standard deviation of each corner."""

from dataclasses import replace

import numpy as np
import pytest

from icalib.estimation.corner_noise import NoiseModel, estimate_noise
from icalib.rig import Camera, Settings

BASE, EXPOSURE_S = 0.08, 4e-4


@pytest.mark.parametrize("blurred", [False, True])
@pytest.mark.parametrize("stated", [False, True])
def test_the_size_of_the_noise_is_found(unlike, setup_of, factor_of, stated, blurred):
    setup = setup_of(unlike)
    factor, rng = factor_of(setup, 0), np.random.default_rng(5)
    stream = factor.stream
    n, speed = len(stream.uv), rng.uniform(0.0, 500.0, len(stream.stamps_ns))
    # Up to a common factor: the median corner has `BASE`.
    sigma = rng.uniform(0.02, 0.1, n) if stated else np.zeros(0)
    relative = sigma / np.median(sigma) if stated else np.ones(n)
    true = np.hypot(BASE * relative, EXPOSURE_S * speed[stream.image] * blurred)
    out = factor.output(np.float64)
    out.residual[:] = true[:, None] * rng.standard_normal((n, 2))
    out.root[:] = 1.0
    factor = replace(factor, stream=replace(stream, sigma=sigma))
    camera, settings = Camera("cam0", "", "pinhole-radtan", (752, 480)), Settings(blur_noise=blurred)
    model = estimate_noise(camera, settings, factor, out, speed, ())
    assert model.base == pytest.approx(BASE, rel=0.05)
    assert model.exposure == pytest.approx(EXPOSURE_S * blurred, rel=0.1)
    noise = NoiseModel(BASE, EXPOSURE_S).noise(factor.stream, camera, settings, speed * blurred)
    np.testing.assert_allclose(noise.sigma, true, rtol=1e-12)
