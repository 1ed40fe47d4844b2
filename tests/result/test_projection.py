"""The uncertainty of a camera's projection, against draws of its lens whose motion is fitted by another method."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from icalib.geometry.cameras import CAMERA_MODELS, camera_model
from icalib.result import Calibration, projection_uncertainty
from icalib.result.derived import projection_std, working_distance

pytestmark = pytest.mark.slow

DRAWS = 1200
LENSES = {
    "pinhole-radtan": [458.0, 457.0, 367.0, 248.0, -0.28, 0.074, 2e-4, 2e-5],
    "pinhole-radtan5": [458.0, 457.0, 367.0, 248.0, -0.28, 0.074, 2e-4, 2e-5, 0.01],
    "pinhole-equidistant": [380.0, 381.0, 367.0, 248.0, -0.02, 0.01, -0.004, 0.001],
    "eucm": [380.0, 381.0, 367.0, 248.0, 0.6, 1.1],
    "double-sphere": [300.0, 301.0, 367.0, 248.0, -0.2, 0.55],
    "pinhole-rational": [458.0, 457.0, 367.0, 248.0, 0.53, -2.55, 4e-4, -2e-4, 1.52, 0.41, -2.37, 1.44],
    "omni-radtan": [760.0, 761.0, 367.0, 248.0, 0.9, -0.1, 0.03, 2e-4, 2e-5],
}
U, V = np.meshgrid(np.linspace(20.0, 730.0, 7), np.linspace(20.0, 460.0, 5))
UV = np.stack([U.ravel(), V.ravel()], axis=1)
INNER = np.all(np.abs(UV - [375.0, 240.0]) < [260.0, 160.0], axis=1)  # 15 of 35, where corners would be


def lens(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Parameters, and a covariance of about a pixel with correlations."""
    params = np.array(LENSES[name])
    mixed = np.random.default_rng(5).normal(size=(len(params),) * 2) + 2.0 * np.eye(len(params))
    full = mixed @ mixed.T
    std = np.concatenate([[0.05, 0.05, 0.3, 0.3], np.full(len(params) - 4, 3e-4)])
    scale = std / np.sqrt(np.diag(full))
    return params, full * np.outer(scale, scale)


def sampled(name: str, distance: float, near: bool, fitted: np.ndarray) -> np.ndarray:
    """(N,) px: spread in the worst direction of what is left of drawn lenses once the camera was moved to fit."""
    model, (params, P) = camera_model(name), lens(name)
    points = distance * model.unproject(params, UV)[0]

    def off(motion: np.ndarray, drawn: np.ndarray, which: np.ndarray) -> np.ndarray:
        moved = Rotation.from_rotvec(motion[:3]).apply(points[which])
        return model.project(drawn, moved + distance * motion[3:] if near else moved)[0] - UV[which]

    left = []
    for drawn in np.random.default_rng(6).multivariate_normal(params, P, DRAWS):
        start = np.zeros(6 if near else 3)
        best = least_squares(lambda x, d=drawn: off(x, d, fitted).ravel(), start, method="lm", x_scale=1e-3)
        left.append(off(best.x, drawn, np.ones(len(UV), dtype=bool)))
    spread = np.einsum("kni,knj->nij", np.array(left), np.array(left)) / DRAWS
    return np.sqrt(np.linalg.eigvalsh(spread)[:, -1])


def test_every_model_is_tried():
    assert set(LENSES) == set(CAMERA_MODELS)


DRAWN = [("pinhole-radtan", True), ("double-sphere", False)]  # the others in `full`
ALL_DRAWN = [(n, False) for n in LENSES] + [("pinhole-radtan", True), ("pinhole-equidistant", True)]


@pytest.mark.parametrize(
    ("name", "near"), [pytest.param(*x, marks=() if x in DRAWN else pytest.mark.full) for x in ALL_DRAWN]
)
def test_it_is_that_of_drawn_lenses(name: str, near: bool):
    """1200 draws: 2 % at one pixel, the same side at all of them."""
    params, P = lens(name)
    found = projection_std(camera_model(name), params, P, UV, INNER, 1.7 if near else np.inf)
    expected = sampled(name, 1.7, near, INNER)
    assert found.max() > 1.5 * found.min() > 0.0
    np.testing.assert_allclose(found, expected, rtol=0.1)
    np.testing.assert_allclose(np.sqrt(np.mean(found**2)), np.sqrt(np.mean(expected**2)), rtol=0.05)


def test_what_a_turn_explains_counts_for_nothing():
    """A shift of the principal point of a long lens is a turn; a focal length is not, unless points are near: then the
    camera comes nearer, up to what points at one range differ in depth, (420 / 2e4)^2 / 2."""
    model, params = camera_model("pinhole-radtan"), np.array([2e4, 2e4, 375.0, 240.0, 0.0, 0.0, 0.0, 0.0])
    all_of_it, shift, zoom = np.ones(len(UV), dtype=bool), np.zeros((8, 8)), np.zeros((8, 8))
    shift[2, 2], zoom[:2, :2] = 1.0, 20.0**2
    assert projection_std(model, params, shift, UV, all_of_it).max() < 2e-3
    far = projection_std(model, params, zoom, UV, all_of_it)
    np.testing.assert_allclose(far, np.linalg.norm(UV - params[2:4], axis=1) * 1e-3, rtol=1e-3, atol=1e-3)
    assert projection_std(model, params, zoom, UV, all_of_it, 3.0).max() < 2.2e-4 * far.max()


def test_few_pixels_do_not_say_how_the_camera_moved():
    model, (params, P) = camera_model("pinhole-radtan"), lens("pinhole-radtan")
    few, everything = np.arange(len(UV)) < 11, np.ones(len(UV), dtype=bool)
    whole = projection_std(model, params, P, UV, everything)
    np.testing.assert_array_equal(projection_std(model, params, P, UV, few), whole)
    assert not np.allclose(projection_std(model, params, P, UV, INNER), whole, rtol=0.01)


def test_pixels_without_a_ray_have_none():
    model, params = camera_model("double-sphere"), np.array([260.0, 260.0, 367.0, 248.0, 0.5, 0.9])
    _, valid = model.unproject(params, UV)
    found = projection_std(model, params, 1e-6 * np.eye(6), UV, np.ones(len(UV), dtype=bool))
    assert 12 < valid.sum() < len(UV)
    np.testing.assert_array_equal(np.isfinite(found), valid)


def test_of_a_calibration_with_its_factors(calibration: Calibration):
    """Its distortion is fixed: what is left is that of four intrinsics, 2.7 times the formal one."""
    found = projection_uncertainty(calibration, "cam0")
    assert found is not None
    g = calibration.group("cam0", "intrinsics")
    assert g.columns is not None
    P = np.zeros((8, 8))
    P[:4, :4] = 2.7**2 * calibration.covariance[np.ix_(g.columns, g.columns)]
    params = np.concatenate([g.value, calibration.group("cam0", "distortion").value])
    uv = np.stack(np.meshgrid(found.u, found.v), axis=-1).reshape(-1, 2)
    expected = projection_std(camera_model("pinhole-radtan"), params, P, uv, found.seen.ravel())
    np.testing.assert_allclose(found.sigma.ravel(), expected, rtol=1e-12)
    assert found.u[0] == pytest.approx(752 / 36 / 2 - 0.5) and found.sigma.shape == (len(found.v), len(found.u))
    r = calibration.corner_residuals[0]
    for u, v in r.uv[~r.rejected][:50]:
        assert found.seen[np.abs(found.v - v).argmin(), np.abs(found.u - u).argmin()]
    size, u, v = found.worst
    assert size == np.nanmax(found.sigma) > found.median_seen > 0.0
    assert found.sigma[np.abs(found.v - v).argmin(), np.abs(found.u - u).argmin()] == size


def test_a_lens_that_is_fixed_is_certain(calibration: Calibration):
    zeros = np.zeros(4)
    changes: dict[str, Any] = {"columns": None, "factor": None, "std": zeros, "std_formal": zeros, "mode": "fixed"}
    groups = tuple(
        dataclasses.replace(g, **changes) if (g.sensor, g.name) == ("cam0", "intrinsics") else g
        for g in calibration.groups
    )
    found = projection_uncertainty(dataclasses.replace(calibration, groups=groups), "cam0", 2.0)
    assert found is not None and not found.sigma.any()


def test_without_corners_the_whole_image_counts(calibration: Calibration):
    bare = dataclasses.replace(calibration, residuals={})
    found, with_corners = (projection_uncertainty(c, "cam0") for c in (bare, calibration))
    assert found is not None and with_corners is not None
    assert not found.seen.any() and found.median_seen == np.median(found.sigma)
    assert not np.array_equal(found.sigma, with_corners.sigma)
    assert working_distance(bare, "cam0") is None


def test_working_distance_is_that_of_images_with_corners(calibration: Calibration, far_off: Callable[..., Calibration]):
    """The target's first point is the world's origin; when the camera did not see the target does not count."""
    path, g = calibration.trajectory, calibration.group("cam1", "translation")
    centre = [R @ g.value + p for R, p in zip(path.rotation, path.position, strict=True)]
    expected = float(np.median(np.linalg.norm(centre, axis=1)))
    assert working_distance(calibration, "cam1") == pytest.approx(expected, rel=0.02)
    assert working_distance(far_off(calibration), "cam1") == pytest.approx(expected, rel=0.1)


@pytest.fixture
def far_off() -> Callable[[Calibration], Calibration]:
    """Twice as long, and 50 m away in the second half, where nothing is seen."""

    def longer(c: Calibration) -> Calibration:
        path = c.trajectory
        seconds = np.concatenate([path.seconds, path.seconds + path.seconds[-1] + 0.05])
        both = {
            f.name: np.concatenate([getattr(path, f.name)] * 2) for f in dataclasses.fields(path) if f.name != "seconds"
        }
        both["position"][len(path.seconds) :] += 50.0
        return dataclasses.replace(c, trajectory=dataclasses.replace(path, seconds=seconds, **both))

    return longer
