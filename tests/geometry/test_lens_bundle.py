"""A lens fitted to corners that are about in place: derivatives, recovery, and what is held out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from icalib.geometry import so3
from icalib.geometry.cameras import camera_model
from icalib.geometry.cameras import convert as lens_bundle
from icalib.geometry.cameras.convert import ImagePoints, _linearised, adjust, initial_parameters

RADTAN = np.array([460.0, 458.0, 371.0, 245.0, -0.28, 0.07, 2e-4, -1e-4])
NEAR = (0.14, 0.2)
FISHEYE = np.array([310.0, 309.0, 371.0, 245.0, -0.01, 0.02, -0.01, 0.002])


def images_of(
    name: str,
    params: np.ndarray,
    count: int,
    noise: float = 0.0,
    seed: int = 0,
    distance: tuple[float, float] = (0.3, 0.45),
) -> ImagePoints:
    """A board of 8 x 6 points, 4 cm apart, seen from `count` sides by a lens; it may bow."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-0.16, 0.16, 8), np.linspace(-0.1, 0.1, 6))
    board = np.stack([x.ravel(), y.ravel(), np.zeros(48)], axis=1)
    bow = np.zeros((48, 3, 1))
    bow[:, 2, 0] = (board[:, 0] / 0.16) ** 2
    points, basis = [], []
    for _ in range(count):
        R = so3.exp(rng.normal(scale=0.35, size=3))
        points.append(board @ R.T + [*rng.uniform(-0.08, 0.08, 2), rng.uniform(*distance)])
        basis.append(R @ bow)
    points, basis = np.concatenate(points), np.concatenate(basis)
    uv, valid = camera_model(name).project(params, points)
    assert valid.all()
    return ImagePoints(
        points, uv + noise * rng.normal(size=uv.shape), 48 * np.arange(count + 1), basis, np.ones(len(uv), dtype=bool)
    )


def disturbed(seen: ImagePoints, seed: int) -> ImagePoints:
    """Each image's points a little turned and shifted, as by a pose that is not right."""
    rng = np.random.default_rng(seed)
    motion = rng.normal(scale=[3e-3] * 3 + [1e-3] * 3, size=(len(seen.start) - 1, 6))
    return seen.moved(motion, np.array([1e-3]))


def test_derivatives_are_those_of_differences():
    model, seen = camera_model("pinhole-radtan"), images_of("pinhole-radtan", RADTAN, 3)
    _, J = _linearised(model, RADTAN, seen, True)
    n, step = J.shape[2], 1e-6
    for k in range(n):
        ends = []
        for sign in (1.0, -1.0):
            d = np.zeros(n)
            d[k] = sign * step
            moved = seen.moved(np.tile(d[:6], (3, 1)), d[6 + len(RADTAN) :])
            ends.append(_linearised(model, RADTAN + d[6 : 6 + len(RADTAN)], moved, True)[0])
        np.testing.assert_allclose(J[:, :, k], (ends[0] - ends[1]) / (2.0 * step), atol=2e-5 * np.abs(J).max())


@pytest.mark.parametrize(("name", "params"), [("pinhole-radtan", RADTAN), ("pinhole-equidistant", FISHEYE)])
def test_a_lens_is_recovered_with_poses_and_shape(name: str, params: np.ndarray):
    model, seen = camera_model(name), disturbed(images_of(name, params, 8), 1)
    found, shape, residual, _ = adjust(model, params + 0.01 * np.abs(params), seen)
    np.testing.assert_allclose(found, params, rtol=1e-3, atol=1e-4)
    assert shape[0] == pytest.approx(-1e-3, abs=1e-5)
    assert np.abs(residual).max() < 1e-3


def test_what_is_held_back_is_left_with_the_noise_by_the_right_model_and_with_more_by_another():
    fitted = disturbed(images_of("pinhole-equidistant", FISHEYE, 12, 0.1, 2, NEAR), 3)
    held_back = disturbed(images_of("pinhole-equidistant", FISHEYE, 12, 0.1, 4, NEAR), 5)
    rms = {}
    for name in ("pinhole-equidistant", "pinhole-radtan"):
        model = camera_model(name)
        start = initial_parameters(model, camera_model("pinhole-equidistant"), FISHEYE, fitted)
        assert start is not None
        params, shape, *_ = adjust(model, start, fitted)
        again, same, residual, _ = adjust(model, params, held_back, shape)
        np.testing.assert_array_equal(again, params)
        np.testing.assert_array_equal(same, shape)
        rms[name] = np.sqrt((residual**2).mean())
    assert rms["pinhole-equidistant"] == pytest.approx(0.1, rel=0.1)
    assert rms["pinhole-radtan"] > 1.3 * rms["pinhole-equidistant"]


def test_of_several_starts_the_one_that_fits_best_is_taken(monkeypatch: pytest.MonkeyPatch):
    model, seen = camera_model("pinhole-equidistant"), images_of("pinhole-equidistant", FISHEYE, 8, 0.1, 2, NEAR)
    monkeypatch.setattr(lens_bundle, "fit_rays", lambda model, start, *_: start)  # each its own minimum
    poor, good = (0.1, 0.0, 0.0, 0.0), tuple(FISHEYE[4:])
    for starts in ((poor, good), (good, poor)):
        monkeypatch.setattr(type(model), "start_distortions", starts)
        np.testing.assert_array_equal(initial_parameters(model, model, FISHEYE, seen), FISHEYE)
    monkeypatch.setattr(type(model), "start_distortions", ())
    assert initial_parameters(model, model, FISHEYE, seen) is None


def test_an_adjustment_goes_on_where_the_last_one_ended(monkeypatch: pytest.MonkeyPatch):
    model, seen = camera_model("pinhole-radtan"), disturbed(images_of("pinhole-radtan", RADTAN, 8, 0.1), 1)
    first, steps = adjust(model, RADTAN + 0.01 * np.abs(RADTAN), seen), []
    step = lens_bundle._step
    monkeypatch.setattr(lens_bundle, "_step", lambda *args: steps.append(None) or step(*args))
    second = adjust(model, first.params, first.points)
    assert len(steps) <= 2
    assert np.abs(second.shape).max() < 1e-5
    np.testing.assert_allclose(second.residual, first.residual, atol=1e-3)
    there = model.project(first.params, first.points.points)[0] - seen.uv
    np.testing.assert_allclose(there, first.residual, atol=1e-9)


def test_points_that_are_not_used_have_residuals_and_no_influence():
    model, seen = camera_model("pinhole-radtan"), disturbed(images_of("pinhole-radtan", RADTAN, 8), 1)
    used = np.random.default_rng(0).random(len(seen.uv)) < 0.8
    uv = seen.uv + np.where(used, 0.0, 30.0)[:, None]
    found, _, residual, _ = adjust(model, RADTAN + 0.01 * np.abs(RADTAN), replace(seen, uv=uv, used=used))
    np.testing.assert_allclose(found, RADTAN, rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(residual[~used], -30.0, atol=1e-2)
