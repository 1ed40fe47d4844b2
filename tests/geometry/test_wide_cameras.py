"""Models that see all round: what they become in their limits, how far they see, and what parameters they stand."""

from __future__ import annotations

from math import sqrt

import numpy as np
from tests.cases import each

from icalib.geometry.cameras import CAMERA_MODELS, camera_model


def relative_to_pinhole(name: str, distortion: list[float], radtan: list[float]) -> None:
    """The model at this distortion is a pinhole with `radtan`, values and Jacobians."""
    pinhole, params = camera_model("pinhole-radtan"), np.array([400.0, 410.0, 380.0, 230.0, *radtan])
    model, both = camera_model(name), np.append(params[:4], distortion)
    points = np.random.default_rng(3).uniform([-2.0, -2.0, -0.1], [2.0, 2.0, 1.5], (2000, 3))
    expected, got = pinhole.project_with_jacobians(params, points), model.project_with_jacobians(both, points)
    np.testing.assert_array_equal(got[1], expected[1])
    np.testing.assert_allclose(got[0], expected[0], rtol=1e-12, atol=1e-10)
    np.testing.assert_allclose(got[2], expected[2], rtol=1e-12, atol=1e-11 * np.abs(expected[2]).max())
    np.testing.assert_allclose(got[3][:, :, :4], expected[3][:, :, :4], rtol=1e-12, atol=1e-12)


def test_limits_are_the_pinhole() -> None:
    relative_to_pinhole("eucm", [0.0, 1.7], [0.0] * 4)
    relative_to_pinhole("double-sphere", [0.0, 0.0], [0.0] * 4)
    for radtan in ([0.0] * 4, [-0.28, 0.07, 2e-4, 2e-5], [-0.3, 0.0, 0.003, -0.002]):
        relative_to_pinhole("omni-radtan", [0.0, *radtan], radtan)


@each("xi", [0.2, 1.0, 2.5])
def test_three_models_share_the_unified_one(xi: float) -> None:
    """Geyer's model: Mei without distortion, EUCM with beta = 1 and double sphere with xi = 0."""
    alpha = xi / (1.0 + xi)
    scaled = [400.0, 410.0, 380.0, 230.0]
    mei = np.array([scaled[0] * (1.0 + xi), scaled[1] * (1.0 + xi), *scaled[2:], xi, 0.0, 0.0, 0.0, 0.0])
    points = np.random.default_rng(0).normal(size=(500, 3))
    uv, valid = camera_model("omni-radtan").project(mei, points)
    assert valid.any()
    for name, distortion in (("eucm", [alpha, 1.0]), ("double-sphere", [0.0, alpha])):
        again, seen = camera_model(name).project(np.array(scaled + distortion), points)
        np.testing.assert_array_equal(seen, valid)
        np.testing.assert_allclose(again, uv, rtol=1e-10)


def test_the_ranges_are_those_of_the_papers() -> None:
    """Khomutenko et al. as Usenko et al. 2018 give it in section 2.3; Mei's with xi or 1 / xi.

    The double sphere's w2 is not the paper's (eq. 45), which takes the two shifts in the wrong order and is exact for
    xi = 0 only: at xi = -0.5, alpha = 1 / 11 it admits points whose depth is negative.
    """
    rng = np.random.default_rng(1)
    points = rng.normal(size=(400, 3))
    d = np.linalg.norm(points, axis=1)
    for xi, alpha in rng.uniform([-0.95, 0.0], [0.95, 1.0], (50, 2)):
        w1 = alpha / (1 - alpha) if alpha <= 0.5 else (1 - alpha) / alpha
        w2 = xi * (1.0 - w1**2) + w1 * sqrt(1.0 - xi**2 * (1.0 - w1**2))
        found = camera_model("double-sphere").project(np.array([1.0, 1.0, 0.0, 0.0, xi, alpha]), points)[1]
        np.testing.assert_array_equal(found, points[:, 2] > -w2 * d)
        beta = 0.5 + abs(xi)
        stretched = np.sqrt(beta * (d**2 - points[:, 2] ** 2) + points[:, 2] ** 2)
        found = camera_model("eucm").project(np.array([1.0, 1.0, 0.0, 0.0, alpha, beta]), points)[1]
        np.testing.assert_array_equal(found, points[:, 2] > -w1 * stretched)
        mirror = 3.0 * alpha
        found = camera_model("omni-radtan").project(np.array([1.0, 1.0, 0, 0, mirror, 0, 0, 0, 0]), points)[1]
        np.testing.assert_array_equal(found, points[:, 2] > -min(mirror, 1.0 / mirror) * d)


@each("name", CAMERA_MODELS)
def test_any_parameters_are_finite_and_no_crash(name: str) -> None:
    """Far outside the domain too: what an estimate may try on its way."""
    model, rng = camera_model(name), np.random.default_rng(2)
    points, uv = rng.normal(size=(50, 3)), rng.uniform(0.0, 700.0, (50, 2))
    points[0], uv[0] = [0.0, 0.0, 1.0], [370.0, 240.0]
    special = [-1.0, -0.5, 0.0, 0.5, 1.0, 2.0, 1e8, -1e8, np.inf, np.nan]
    for _ in range(300):
        rest = np.where(
            rng.random(len(model.parameter_names) - 4) < 0.5,
            rng.choice(special, len(model.parameter_names) - 4),
            rng.normal(scale=2.0, size=len(model.parameter_names) - 4),
        )
        params = np.array([400.0, 410.0, 370.0, 240.0, *rest])
        found = model.project_with_jacobians(params, points)
        for values in (*found, *model.unproject(params, uv)):
            if np.isfinite(rest).all():
                assert np.isfinite(values).all()
