"""A lens in another camera model: exact where the target can be, as close as can be and honest elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from tests.cases import each

from icalib.errors import CalibrationError
from icalib.geometry.cameras import camera_model
from icalib.geometry.cameras.convert import fit_model

IMAGE = (752, 480)
RADTAN = camera_model("pinhole-radtan")
RADTAN5 = camera_model("pinhole-radtan5")
EQUIDISTANT = camera_model("pinhole-equidistant")
EUROC = np.array([458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05])
EUROC5 = np.array([458.1, 456.9, 367.3, 248.5, -0.29, 0.1, 0.0002, -0.0001, -0.015])
NARROW_FISHEYE = np.array([460.0, 458.0, 367.0, 248.0, -0.01, 0.02, -0.015, 0.004])


def fisheye(f: float) -> np.ndarray:
    return np.array([f, f + 1.0, 376.0, 239.0, 0.0035, 0.0007, -0.002, 0.0002])


def rays_over_the_image(model, params):
    """Pixels on another grid than the fit's, and their rays."""
    u, v = np.meshgrid(np.linspace(0.0, IMAGE[0] - 1.0, 67), np.linspace(0.0, IMAGE[1] - 1.0, 43))
    uv = np.stack([u.ravel(), v.ravel()], axis=1)
    rays, valid = model.unproject(params, uv)
    assert valid.all()
    return uv, rays


@pytest.mark.parametrize("params", [EUROC, np.array([700.0, 690.0, 375.0, 241.0, -0.3, 0.0, 0.003, -0.002])])
def test_a_model_that_contains_the_other_is_exact(params: np.ndarray) -> None:
    fitted, rms, largest = fit_model(RADTAN, params, RADTAN5, IMAGE)
    np.testing.assert_allclose(fitted, np.append(params, 0.0), rtol=1e-11, atol=1e-11)
    assert rms <= largest < 1e-9


def test_a_lens_that_needs_no_third_coefficient_comes_back_without_it() -> None:
    fitted, _, largest = fit_model(RADTAN5, np.append(EUROC, 0.0), RADTAN, IMAGE)
    np.testing.assert_allclose(fitted, EUROC, rtol=1e-11, atol=1e-11)
    assert largest < 1e-9


@each(
    ("source", "params", "target", "rms_range"),
    [
        (RADTAN5, EUROC5, RADTAN, (0.3, 1.0)),
        (RADTAN, EUROC, EQUIDISTANT, (0.05, 0.2)),
        (EQUIDISTANT, NARROW_FISHEYE, RADTAN5, (0.1, 0.4)),
        (EQUIDISTANT, NARROW_FISHEYE, RADTAN, (0.5, 1.5)),
    ],
)
def test_what_remains_is_the_least_and_is_reported(source, params, target, rms_range) -> None:
    fitted, rms, largest = fit_model(source, params, target, IMAGE)
    uv, rays = rays_over_the_image(source, params)

    def residual(candidate: np.ndarray) -> np.ndarray:
        return (target.project(candidate, rays)[0] - uv).ravel()

    distance = np.linalg.norm(residual(fitted).reshape(-1, 2), axis=1)
    assert rms_range[0] < rms < rms_range[1]
    # The outermost pixels weigh more on the coarser grid.
    assert rms == pytest.approx(np.sqrt(np.mean(distance**2)), rel=0.15)
    assert largest == pytest.approx(distance.max(), rel=1e-6)  # in the corner of the image, which both grids hold
    best = least_squares(residual, fitted, x_scale="jac", xtol=1e-14, ftol=1e-14)
    assert np.sqrt(2.0 * best.cost / len(uv)) > 0.95 * np.sqrt(np.mean(distance**2))


def test_the_third_coefficient_is_worth_having() -> None:
    _, with_it, _ = fit_model(EQUIDISTANT, NARROW_FISHEYE, RADTAN5, IMAGE)
    _, without, _ = fit_model(EQUIDISTANT, NARROW_FISHEYE, RADTAN, IMAGE)
    assert with_it < 0.5 * without


@pytest.mark.parametrize("f", [350.0, pytest.param(330.0, marks=pytest.mark.full)])
def test_a_best_fit_beyond_the_monotonic_range_is_replaced_by_one_inside(f: float) -> None:
    """73 and 78 degrees: with k3 the best fit folds back inside the image, and one without k3 is always allowed."""
    fitted, with_it, _ = fit_model(EQUIDISTANT, fisheye(f), RADTAN5, IMAGE)
    _, without, _ = fit_model(EQUIDISTANT, fisheye(f), RADTAN, IMAGE)
    assert RADTAN5.project(fitted, rays_over_the_image(EQUIDISTANT, fisheye(f))[1])[1].all()
    assert with_it < without


def test_pixels_that_the_source_cannot_see_are_left_out() -> None:
    folds = np.array([300.0, 300.0, 375.0, 241.0, -0.9, 0.0, 0.003, -0.002])
    assert not RADTAN.unproject(folds, np.array([[0.0, 0.0]]))[1].any()
    fitted, _, largest = fit_model(RADTAN, folds, RADTAN5, IMAGE)
    np.testing.assert_allclose(fitted, np.append(folds, 0.0), rtol=1e-10, atol=1e-10)
    assert largest < 1e-9


def test_a_pinhole_cannot_show_a_fisheye_of_more_than_180_degrees() -> None:
    with pytest.raises(CalibrationError, match=r"pinhole-radtan cannot see \d+ of the 1536 directions.*fisheye model"):
        fit_model(EQUIDISTANT, fisheye(191.0), RADTAN, IMAGE)


def test_parameters_that_see_nothing_are_named() -> None:
    with pytest.raises(CalibrationError, match="pinhole-radtan with these parameters can see 0 of 1536 pixels"):
        fit_model(RADTAN, np.full(8, np.nan), EQUIDISTANT, IMAGE)
