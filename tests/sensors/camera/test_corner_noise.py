"""The noise of corners: estimated from residuals, with the detector's standard deviation of each corner."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from tests.cases import each
from tests.typed import not_none

from icalib.estimate.estimate import Estimate
from icalib.estimate.inputs import Inputs
from icalib.geometry.cameras import camera_model
from icalib.model.sensor_model import Fit
from icalib.rig import Camera, Settings
from icalib.sensors.camera.assess import lenses
from icalib.sensors.camera.corner_factor import DELAY, CornerNoise
from icalib.sensors.camera.corner_noise import (
    NoiseModel,
    estimate_noise,
    from_middle,
    image_flow,
    image_speed,
    with_jitter,
)

BASE, EXPOSURE_S = 0.08, 4e-4


@each("blurred", [False, True])
@each("stated", [False, True])
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


@each("stated", [False, True])
@each(("size", "large"), [(1.0, True), (0.0, False)])
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
    monkeypatch.setattr(lenses, "compare_models", lambda *_: (fitted, fitted))
    outcome = SimpleNamespace(residuals={factor.key: out}, state=setup.state)
    found = SimpleNamespace(outcome=outcome, problem=SimpleNamespace(factors={factor.key: factor}))
    rig = SimpleNamespace(cameras=(camera,), settings=settings)
    inputs = SimpleNamespace(rig=rig, measurements=SimpleNamespace(cameras=(factor.stream,)))
    assert len(list(lenses.wrong_models(cast(Inputs, inputs), cast(Estimate, found)))) == large


def test_images_that_see_the_misfit_are_in_both_halves(unlike, setup_of, factor_of, monkeypatch):
    """Two images see it, and both are even; of each part of the recording one image is taken."""
    setup = setup_of(unlike)
    factor = factor_of(setup, 0)
    out = factor.output(np.float64)
    out.root[:] = 1.0
    images, seen = len(factor.stream.stamps_ns), np.isin(factor.stream.image, (2, 6))
    field = np.where(seen[:, None], 3.0, 0.01) * np.ones(2)
    for most in (40, 4):
        monkeypatch.setattr(lenses, "MOST_IMAGES", most)
        rows, fitted, tested = not_none(lenses._halves(factor, out, setup.state, field))
        halves = np.split(rows, [len(fitted.uv)])
        assert len(halves[1]) == len(tested.uv)
        assert [np.unique(factor.stream.image[half[seen[half]]]).tolist() for half in halves] == [[2], [6]]
        assert sum(len(np.unique(factor.stream.image[half])) for half in halves) == min(most, images)


@each(
    ("places", "words"),
    [
        ([(740, 10)], "top right corner"),
        ([(376, 240)], "centre"),
        ([(10, 240), (740, 240), (376, 479)], "left edge and right edge"),
    ],
)
def test_the_region_of_the_misfit_is_named(places, words):
    """By the mean: of the top edge there are many corners, each with a small misfit."""
    uv = np.array([*places, (800, 500), *[(376, 10)] * 1000], float)  # the second kind is outside the image
    field = np.full((len(uv), 2), 1.0)
    field[: len(places)] = np.linspace(4.0, 3.0, len(places))[:, None]
    assert lenses.worst_regions(uv, field, (752, 480)) == words


@each(("left", "fewer", "beaten"), [(0.266, 20, True), (0.266, 14, False), (0.26, 20, False)])
def test_models_are_compared_by_the_misfit_and_not_by_the_ratio_of_rms(monkeypatch, left, fewer, beaten):
    """The worse model has 0.091 px more of misfit than the other, or 0.071 px."""
    error = {"of": {}}
    monkeypatch.setattr(lenses._Trial, "rms", property(lambda trial: error["of"][id(trial)][0]))
    monkeypatch.setattr(lenses._Trial, "squared_error", property(lambda trial: error["of"][id(trial)][1]))
    no_fit: Any = None
    old, new = (lenses._Trial(camera_model(name), no_fit, no_fit) for name in ("pinhole-radtan", "eucm"))
    error["of"] = {id(old): (left, np.ones(20)), id(new): (0.25, np.where(np.arange(20) < fewer, 0.9, 1.1))}
    assert lenses._beats(new, old, 0.084**2) == beaten
    assert not lenses._beats(old, new, 0.084**2)


@pytest.mark.parametrize("jitter_s", [0.0, 2e-3])
def test_jitter_and_rate_of_a_clock_are_found_from_the_delays(unlike, setup_of, factor_of, jitter_s):
    """Delays estimated to 0.1 ms; without jitter they are noise alone."""
    setup = setup_of(unlike)
    factor, rng, start_s, error_s, rate = factor_of(setup, 0), np.random.default_rng(5), 1e-3, 1e-4, 2e-3
    n, count = len(factor.stream.uv), len(factor.views.image)
    flow = np.full((n, 2, 1), 300.0)
    factor = replace(factor, noise=CornerNoise(np.full(n, 0.2), np.array([start_s]), flow))
    out = factor.output(np.float64)
    out.root[:] = 5.0
    shrunk = start_s**2 / (start_s**2 + error_s**2)  # of an estimate with a prior of start_s
    true = rng.normal(0.0, np.hypot(jitter_s, error_s), count) if jitter_s else rng.normal(0.0, error_s, count)
    out.shared[:, 0] = shrunk * (true + rate * from_middle(factor.stream)[factor.views.image])
    fit = Fit("cam0", DELAY, count, shrunk * count, float((out.shared**2).sum() / start_s**2))
    present = NoiseModel(0.2, jitter=start_s, rate=1e-5)
    model = with_jitter(NoiseModel(0.2), present, factor, out, fit)
    spread = np.hypot(jitter_s, error_s) / (from_middle(factor.stream).std() * np.sqrt(count))
    assert model.rate == pytest.approx(1e-5 + shrunk * rate, abs=4.0 * spread)
    if jitter_s:
        assert model.jitter == pytest.approx(jitter_s, abs=4.0 * model.jitter_std)
        assert model.jitter_std == pytest.approx(model.jitter / np.sqrt(2.0 * count), rel=0.05)
    else:
        assert model.jitter == model.jitter_std == 0.0
