"""The noise of corners: estimated from residuals, with the detector's standard deviation of each corner."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from icalib.estimate.estimate import Estimate
from icalib.estimate.problem.inputs import Inputs
from icalib.rig import Camera, Settings
from icalib.sensors.camera.assess import lens_models
from icalib.sensors.camera.corner_noise import NoiseModel, estimate_noise, image_flow, image_speed

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
    model, large = estimate_noise(camera, settings, factor, out, speed)
    assert not large
    assert model.base == pytest.approx(BASE, rel=0.05)
    assert model.exposure == pytest.approx(EXPOSURE_S * blurred, rel=0.1)
    noise = NoiseModel(BASE, EXPOSURE_S).noise(factor.stream, settings, speed * blurred)
    np.testing.assert_allclose(noise.sigma, true, rtol=1e-12)


@pytest.mark.parametrize("stated", [False, True])
@pytest.mark.parametrize(("size", "large"), [(1.0, True), (0.0, False)])
def test_a_large_misfit_is_large_for_the_loss_and_for_the_warning(
    unlike, setup_of, factor_of, monkeypatch, size, large, stated
):
    """Blurred images and corners with a large standard deviation of their own do not hide the misfit of the lens."""
    setup = setup_of(unlike)
    factor, rng = factor_of(setup, 0), np.random.default_rng(5)
    stream, n = factor.stream, len(factor.stream.uv)
    sigma = np.where(rng.random(n) < 0.6, 1.0, 4.0)
    factor = replace(factor, stream=replace(stream, sigma=sigma))
    speed = image_speed(factor, image_flow(factor, setup.state))
    exposure = 1.5 * BASE / np.median(speed)
    true = np.hypot(BASE * factor.stream.relative_sigma, exposure * speed[stream.image])
    across = stream.uv[:, 0] - stream.uv[:, 0].mean()
    out = factor.output(np.float64)
    out.residual[:] = true[:, None] * rng.standard_normal((n, 2))
    out.residual[:] += size * BASE * np.sign(across)[:, None]
    out.root[:] = 1.0
    camera = Camera("cam0", "", "pinhole-radtan", (752, 480), corner_noise_px=0.3 if stated else None)
    settings = Settings(blur_noise=True)
    assert estimate_noise(camera, settings, factor, out, speed)[1] == large
    fitted = SimpleNamespace(model=factor.model, rms=0.1)
    monkeypatch.setattr(lens_models, "compare_models", lambda *_: (fitted, fitted))
    outcome = SimpleNamespace(residuals={factor.key: out}, state=setup.state)
    found = SimpleNamespace(outcome=outcome, problem=SimpleNamespace(factors={factor.key: factor}))
    rig = SimpleNamespace(cameras=(camera,), settings=settings)
    inputs = SimpleNamespace(rig=rig, measurements=SimpleNamespace(cameras=(factor.stream,)))
    assert len(list(lens_models.wrong_models(cast(Inputs, inputs), cast(Estimate, found)))) == large
