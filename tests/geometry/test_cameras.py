"""Every camera model through the same tests: an obvious formula, Jacobians, unprojection and what it cannot see."""

from __future__ import annotations

import cmath
from collections.abc import Callable
from functools import cache
from math import cos, hypot, pi, sin, sqrt

import numpy as np
import pytest
from tests.cases import each

from icalib.errors import CalibrationError
from icalib.geometry.cameras import CAMERA_MODELS, camera_model, rational
from icalib.geometry.cameras.base import CameraModel
from icalib.geometry.cameras.radial import monotonic_limit

# model -> parameters whose image of `IMAGE` pixels lies inside the range of the model
SAMPLES = {
    "pinhole-radtan": {
        "euroc": [458.654, 457.296, 367.215, 248.375, -0.28340811, 0.07395907, 0.00019359, 1.76187114e-05],
        "none": [400.0, 410.0, 380.0, 230.0, 0.0, 0.0, 0.0, 0.0],
        "folds": [700.0, 690.0, 375.0, 241.0, -0.3, 0.0, 0.003, -0.002],
        "pincushion that folds": [600.0, 610.0, 370.0, 240.0, 0.2, -0.05, -0.001, 0.002],
    },
    "pinhole-radtan5": {
        "corners": [458.1, 456.9, 367.3, 248.5, -0.29, 0.1, 0.0002, -0.0001, -0.015],
        "none": [400.0, 410.0, 380.0, 230.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        "folds": [700.0, 690.0, 375.0, 241.0, -0.1, -0.1, 0.003, -0.002, -0.15],
        "pincushion that folds": [600.0, 610.0, 370.0, 240.0, 0.2, 0.05, -0.001, 0.002, -0.06],
    },
    "pinhole-rational": {
        "kinect": [605.0, 604.0, 372.0, 238.0, 0.53, -2.55, 4e-4, -2e-4, 1.52, 0.41, -2.37, 1.44],
        "none": [400.0, 410.0, 380.0, 230.0, *[0.0] * 8],
        "wide": [330.0, 331.0, 370.0, 240.0, 3.1, 0.9, 2e-4, 1e-4, 0.02, 3.4, 1.9, 0.15],
        "folds": [700.0, 690.0, 375.0, 241.0, -0.1, -0.1, 0.003, -0.002, 0.0, 0.05, 0.05, 0.0],
        "pole": [600.0, 610.0, 370.0, 240.0, 0.1, 0.0, -0.001, 0.002, 0.0, -0.2, 0.0, 0.0],
    },
    "pinhole-equidistant": {
        "tum-vi": [191.0, 190.9, 376.0, 239.0, 0.0034823894, 0.0007150348, -0.0020532361, 0.00020293674],
        "none": [150.0, 151.0, 370.0, 235.0, 0.0, 0.0, 0.0, 0.0],
        "narrow": [460.0, 458.0, 367.0, 248.0, -0.01, 0.02, -0.015, 0.004],
        "folds": [300.0, 310.0, 375.0, 240.0, -0.04, 0.0, 0.0, 0.0],
    },
    "eucm": {
        "wide, folds": [250.0, 249.0, 376.0, 239.0, 0.62, 1.09],
        "none": [400.0, 410.0, 380.0, 230.0, 0.0, 1.0],
        "narrow": [458.0, 457.0, 367.0, 248.0, 0.3, 0.9],
        "half": [190.0, 191.0, 367.0, 248.0, 0.5, 1.2],
        "alpha below 0": [458.0, 457.0, 367.0, 248.0, -0.2, 0.8],
        "alpha above 1, folds": [480.0, 481.0, 376.0, 239.0, 1.1, 0.7],
        "beta below 0": [300.0, 301.0, 376.0, 239.0, 0.4, -0.1],
    },
    "double-sphere": {
        "wide, folds": [313.0, 312.0, 376.0, 239.0, -0.18, 0.59],
        "none": [400.0, 410.0, 380.0, 230.0, 0.0, 0.0],
        "narrow": [458.0, 457.0, 367.0, 248.0, 0.2, 0.3],
        "alpha below 0": [300.0, 301.0, 376.0, 239.0, -0.2, -0.1],
        "xi above 1, folds": [900.0, 901.0, 376.0, 239.0, 1.2, 0.3],
    },
    "omni-radtan": {
        "mirror": [600.0, 598.0, 376.0, 239.0, 0.98, -0.1, 0.08, 0.0003, -0.0002],
        "none": [400.0, 410.0, 380.0, 230.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        "parabola": [500.0, 501.0, 376.0, 239.0, 1.0, 0.0, 0.0, 0.0, 0.0],
        "folds": [700.0, 690.0, 375.0, 241.0, 1.2, -0.3, 0.0, 0.003, -0.002],
        "xi far above 1, folds": [1000.0, 1001.0, 376.0, 239.0, 2.0, 0.02, 0.0, 0.0, 0.0],
    },
}
IMAGE = (752, 480)
CASES = [pytest.param(name, label, id=f"{name}-{label}") for name, sets in SAMPLES.items() for label in sets]


def sample(name: str, label: str) -> tuple[CameraModel, np.ndarray]:
    return camera_model(name), np.array(SAMPLES[name][label])


def obvious_radtan(params: np.ndarray, point: np.ndarray) -> complex:
    """In complex numbers: w d + 2 |w|^2 (p2 + i p1) + w^2 (p2 - i p1), w = a + i b."""
    k1, k2, p1, p2, *k3 = params[4:]
    w = complex(point[0], point[1]) / point[2]
    s = abs(w) ** 2
    return w * (1 + k1 * s + k2 * s**2 + sum(k3) * s**3) + 2 * s * complex(p2, p1) + w**2 * complex(p2, -p1)


def obvious_rational(params: np.ndarray, point: np.ndarray) -> complex:
    k1, k2, p1, p2, k3, k4, k5, k6 = params[4:]
    w = complex(point[0], point[1]) / point[2]
    s = abs(w) ** 2
    radial = (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)
    return w * radial + 2 * s * complex(p2, p1) + w**2 * complex(p2, -p1)


def obvious_equidistant(params: np.ndarray, point: np.ndarray) -> complex:
    theta = cmath.phase(complex(point[2], hypot(point[0], point[1])))
    theta_d = theta + sum(k * theta ** (2 * i + 3) for i, k in enumerate(params[4:]))
    return cmath.rect(theta_d, cmath.phase(complex(point[0], point[1])))


def obvious_eucm(params: np.ndarray, point: np.ndarray) -> complex:
    """Onto the ellipsoid, then seen from behind it: P / d lies on beta (x^2 + y^2) + z^2 = 1."""
    alpha, beta = params[4:]
    x, y, z = point / sqrt(beta * (point[0] ** 2 + point[1] ** 2) + point[2] ** 2)
    return complex(x, y) / (alpha + (1 - alpha) * z)


def obvious_double_sphere(params: np.ndarray, point: np.ndarray) -> complex:
    """Onto the first unit sphere, its centre moved by xi, onto the second, its centre moved by alpha / (1 - alpha)."""
    xi, alpha = params[4:]
    second = point / np.linalg.norm(point) + [0.0, 0.0, xi]
    second = second / np.linalg.norm(second) + [0.0, 0.0, alpha / (1 - alpha)]
    return complex(second[0], second[1]) / second[2] / (1 - alpha)


def obvious_omni(params: np.ndarray, point: np.ndarray) -> complex:
    shifted = point / np.linalg.norm(point) + [0.0, 0.0, params[4]]
    return obvious_radtan(np.delete(params, 4), shifted)


OBVIOUS = {
    "pinhole-radtan": obvious_radtan,
    "pinhole-radtan5": obvious_radtan,
    "pinhole-rational": obvious_rational,
    "pinhole-equidistant": obvious_equidistant,
    "eucm": obvious_eucm,
    "double-sphere": obvious_double_sphere,
    "omni-radtan": obvious_omni,
}


def radius_without_tangential_terms(name: str, params: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Of the image of rays at `angles` from the axis, before fx and fy; NaN where the formula has no positive depth."""
    s, c = np.sin(angles), np.cos(angles)
    below = np.ones_like(angles)
    if name == "eucm":
        alpha, beta = params[4:]
        depth, coefficients = alpha * np.sqrt(beta * s**2 + c**2) + (1 - alpha) * c, []
        depth[beta * s**2 + c**2 <= np.where(c > 0.0, 0.0, max(-beta, 0.0))] = np.nan
    elif name == "double-sphere":
        (xi, alpha), coefficients = params[4:], []
        depth = alpha * np.sqrt(s**2 + (c + xi) ** 2) + (1 - alpha) * (c + xi)
    elif name == "pinhole-rational":
        depth, coefficients = c, params[[4, 5, 8]]
        below = 1.0 + sum(k * (s / c) ** (2 * i + 2) for i, k in enumerate(params[9:]))
    elif name == "omni-radtan":
        depth, coefficients = c + params[4], params[5:7]
    else:
        depth, coefficients = c, [*params[4:6], *params[8:]]
    radii = s / np.where(depth > 0.0, depth, np.nan)
    if name == "pinhole-equidistant":
        radii, coefficients = angles, params[4:]
    above = radii * (1.0 + sum(k * radii ** (2 * i + 2) for i, k in enumerate(coefficients)))
    return above / np.where(below > 0.0, below, np.nan)


def angle_limit(name: str, params: np.ndarray) -> float:
    """Largest angle from the optical axis [rad] that the model projects; found by walking outwards."""
    return _angle_limit(name, tuple(params))


@cache
def _angle_limit(name: str, params: tuple[float, ...]) -> float:
    angles = np.linspace(0.0, pi, 400_001)[1:-1]
    with np.errstate(invalid="ignore"):
        stops = np.flatnonzero(~(np.diff(radius_without_tangential_terms(name, np.array(params), angles)) > 0.0))
    return float(angles[stops[0]]) if len(stops) else pi


def magnification(name: str, params: np.ndarray) -> float:
    """In the image's centre, over the focal length."""
    return 1.0 / (1.0 + params[4]) if name in ("double-sphere", "omni-radtan") else 1.0


def points_in_view(name: str, params: np.ndarray) -> np.ndarray:
    """Points on and next to the optical axis, over the field, and at its edge; at several distances."""
    limit = 0.98 * angle_limit(name, params)
    angles = [0.0, 1e-12, 1e-8, 1e-5, 1e-3, 0.1, 0.4, *np.linspace(0.5, 1.0, 6) * limit]
    angles += [a for a in (pi / 2 - 1e-9, pi / 2, pi / 2 + 1e-3) if a < limit]
    azimuths = [0.0, pi / 2, 0.3, 2.0, -2.5, -0.01]
    angles = [a for a in angles if a < limit / 0.98]
    unit = [[sin(a) * cos(t), sin(a) * sin(t), cos(a)] for a in angles for t in azimuths]
    return np.concatenate([distance * np.array(unit) for distance in (0.2, 1.0, 7.0)])


def differences(function: Callable[[np.ndarray], np.ndarray], at: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Central differences of fourth order; the derivative is the last axis. `step`: of each variable, or of each
    variable at each point."""
    columns = []
    for i, size in enumerate(step):
        h = np.zeros_like(at)
        h[..., i] = size
        near, far = function(at + h) - function(at - h), function(at + 2 * h) - function(at - 2 * h)
        columns.append((8.0 * near - far) / (12.0 * np.reshape(size, (-1, 1))))
    return np.stack(columns, axis=-1)


def test_every_model_has_samples_and_an_obvious_formula() -> None:
    assert set(SAMPLES) == set(OBVIOUS) == set(CAMERA_MODELS)
    for name, sets in SAMPLES.items():
        assert sets and all(len(p) == len(CAMERA_MODELS[name].parameter_names) for p in sets.values())


def test_unknown_model_lists_what_there_is() -> None:
    with pytest.raises(CalibrationError, match=f"'pinhole-radtam'.*{', '.join(CAMERA_MODELS)}"):
        camera_model("pinhole-radtam")


@each(("name", "label"), CASES)
def test_projection_is_the_obvious_formula(name: str, label: str) -> None:
    model, params = sample(name, label)
    points = points_in_view(name, params)
    uv, valid = model.project(params, points)
    assert valid.all()
    expected = np.array([OBVIOUS[name](params, p) for p in points], dtype=np.complex128)
    np.testing.assert_allclose(uv[:, 0], params[0] * expected.real + params[2], rtol=1e-13, atol=1e-10)
    np.testing.assert_allclose(uv[:, 1], params[1] * expected.imag + params[3], rtol=1e-13, atol=1e-10)
    uv_again, valid_again, _, _ = model.project_with_jacobians(params, points)
    np.testing.assert_allclose(uv_again, uv, rtol=1e-14)
    np.testing.assert_array_equal(valid_again, valid)


@each(("name", "label"), CASES)
def test_jacobian_of_the_point(name: str, label: str) -> None:
    model, params = sample(name, label)
    points = points_in_view(name, params)
    _, _, j_point, _ = model.project_with_jacobians(params, points)
    limit = angle_limit(name, params)
    # Close to the edge of the range uv changes on the scale of what is left to it.
    left = limit - np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    step = 5e-4 * np.linalg.norm(points, axis=1) * np.minimum(1.0, left)
    numeric = differences(lambda p: model.project(params, p)[0], points, np.tile(step, (3, 1)))
    rounding = 1e-8 * np.abs(j_point).max(axis=(1, 2), keepdims=True)
    assert (np.abs(j_point - numeric) <= 1e-7 * np.abs(numeric) + rounding).all()


@each(("name", "label"), CASES)
def test_jacobian_of_the_parameters(name: str, label: str) -> None:
    model, params = sample(name, label)
    points = points_in_view(name, params)
    points = points[np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]) < 0.9 * angle_limit(name, params)]
    _, _, _, j_params = model.project_with_jacobians(params, points)
    assert j_params.shape == (len(points), 2, len(params))
    # Small, as k4 moves the limit of the valid range; uv is linear in most, so that only rounding matters.
    step = np.where(np.arange(len(params)) < 4, 1.0, 1e-7)
    numeric = differences(lambda p: model.project(p, points)[0], params, step)
    rounding = 1e-15 / 1e-7 * (1e3 + np.abs(model.project(params, points)[0]).max(axis=1)[:, None, None])
    assert (np.abs(j_params - numeric) <= 1e-9 * np.abs(j_params) + rounding).all()
    moves = np.abs(j_params).max(axis=(0, 1)) > 0.0
    assert moves.all() or (name, label) == ("eucm", "none") and moves[:5].all()  # alpha = 0 leaves nothing to beta


@each("offset", [0.0, 1e-320, 1e-300, 1e-170, 1e-161, 1e-154, 1e-20, 1e-12])
@each(("name", "label"), CASES)
def test_on_the_optical_axis_it_is_a_pinhole(name: str, label: str, offset: float) -> None:
    model, params = sample(name, label)
    uv, valid, j_point, j_params = model.project_with_jacobians(params, np.array([[offset, -offset, 2.0]]))
    fx, fy, cx, cy = params[:4]
    assert valid[0]
    np.testing.assert_allclose(uv[0], [cx, cy], atol=fx * 2 * offset)
    scale = 0.5 * magnification(name, params)
    np.testing.assert_allclose(j_point[0], [[fx * scale, 0, 0], [0, fy * scale, 0]], atol=1e-11 * fx)
    np.testing.assert_allclose(j_params[0, :, 2:4], np.eye(2), atol=0)
    np.testing.assert_allclose(j_params[0, :, :2], 0.0, atol=offset)
    np.testing.assert_allclose(j_params[0, :, 4:], 0.0, atol=offset * (1.0 if "pinhole" in name else fx))


@each(("name", "label"), CASES)
def test_every_pixel_comes_back(name: str, label: str) -> None:
    model, params = sample(name, label)
    u, v = np.meshgrid(np.linspace(0, IMAGE[0] - 1, 41), np.linspace(0, IMAGE[1] - 1, 31))
    uv = np.vstack([np.stack([u.ravel(), v.ravel()], axis=1), params[2:4], params[2:4] + 1e-9])
    rays, valid = model.unproject(params, uv)
    assert valid.all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1.0, rtol=1e-15)
    back, seen = model.project(params, rays)
    assert seen.all()
    np.testing.assert_allclose(back, uv, rtol=0, atol=1e-9)


@each(("name", "label"), CASES)
def test_every_point_in_view_comes_back(name: str, label: str) -> None:
    """The other way round: of the several solutions that a polynomial may have, it is the right one."""
    model, params = sample(name, label)
    points = points_in_view(name, params)
    points = points[np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2]) < 0.95 * angle_limit(name, params)]
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    rays, valid = model.unproject(params, model.project(params, points)[0])
    assert valid.all()
    np.testing.assert_allclose(rays, points, rtol=0, atol=1e-12)


@each(("name", "label"), CASES)
def test_the_edge_of_the_valid_range(name: str, label: str) -> None:
    model, params = sample(name, label)
    limit = angle_limit(name, params)
    for angle, expected in ((limit - 1e-3, True), (limit + 1e-3, False)):
        if angle < pi:  # beyond, there is no direction to test
            points = np.array([[sin(angle), 0.0, cos(angle)], [0.0, -2 * sin(angle), 2 * cos(angle)]])
            np.testing.assert_array_equal(model.project(params, points)[1], expected)


@each("name", CAMERA_MODELS)
@each("point", [[0, 0, 0], [0, 0, -1], [1e-17, 0, -1], [np.nan, 0, 1], [0, 0, np.nan], [0, 0, 1e-9]])
def test_points_without_an_image_are_flagged_and_finite(name: str, point: list[float]) -> None:
    model, params = sample(name, next(iter(SAMPLES[name])))
    points = np.array([point, [0.1, 0.2, 1.0]], dtype=float)
    uv, valid, j_point, j_params = model.project_with_jacobians(params, points)
    np.testing.assert_array_equal(valid, [False, True])
    np.testing.assert_array_equal(model.project(params, points)[1], valid)
    assert all(np.isfinite(values).all() for values in (uv, j_point, j_params, model.project(params, points)[0]))


@each(("name", "label"), [case for case in CASES if "folds" in str(case.values[1])])
def test_pixels_beyond_the_fold_are_flagged(name: str, label: str) -> None:
    model, params = sample(name, label)
    uv = np.array([[1e4, 240.0], [370.0, -1e4], [np.nan, 1.0], [np.inf, 1.0], [370.0, 240.0]])
    rays, valid = model.unproject(params, uv)
    np.testing.assert_array_equal(valid, [False, False, False, False, True])
    assert np.isfinite(rays).all()


def test_a_fisheye_sees_behind_its_image_plane_and_a_pinhole_does_not() -> None:
    behind = np.array([[1.0, 0.2, -0.1], [0.3, -1.0, 0.0]])
    seeing = (
        ("pinhole-equidistant", "none"),
        ("eucm", "half"),
        ("double-sphere", "wide, folds"),
        ("omni-radtan", "mirror"),
    )
    blind = [(name, "none") for name in CAMERA_MODELS if name != "pinhole-equidistant"]
    for (name, label), expected in [(case, True) for case in seeing] + [(case, False) for case in blind]:
        model, params = sample(name, label)
        assert (model.project(params, behind)[1] == expected).all()


@each("name", CAMERA_MODELS)
def test_a_zero_focal_length_or_nan_parameter_is_invalid_and_no_crash(name: str) -> None:
    model, params = sample(name, "none")
    broken = params.copy()
    broken[4] = np.nan
    assert not model.project(broken, np.array([[0.1, 0.1, 1.0]]))[1].any()
    assert not model.unproject(broken, np.array([[300.0, 200.0]]))[1].any()
    params[0] = 0.0
    assert not model.unproject(params, np.array([[300.0, 200.0]]))[1].any()


@pytest.mark.parametrize("label", SAMPLES["pinhole-rational"])
def test_rational_distortion_is_opencvs(label: str) -> None:
    cv2 = pytest.importorskip("cv2")
    model, params = sample("pinhole-rational", label)
    points = points_in_view("pinhole-rational", params)
    K = np.array([[params[0], 0.0, params[2]], [0.0, params[1], params[3]], [0.0, 0.0, 1.0]])
    expected, jacobian = cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, params[4:])
    uv, _, _, j_params = model.project_with_jacobians(params, points)
    np.testing.assert_allclose(uv, expected[:, 0], rtol=1e-11)
    # OpenCV's columns: rotation, translation, fx, fy, cx, cy, distortion.
    by_lens = jacobian.reshape(len(points), 2, -1)[:, :, 6:]
    np.testing.assert_allclose(j_params, by_lens, rtol=1e-9, atol=1e-9 * np.abs(by_lens).max())


def test_rational_distortion_without_a_denominator_is_radtan5() -> None:
    model, params = sample("pinhole-radtan5", "corners")
    rational, extended = camera_model("pinhole-rational"), np.append(params, [0.0] * 3)
    points = points_in_view("pinhole-radtan5", params)
    for before, after in zip(
        model.project_with_jacobians(params, points), rational.project_with_jacobians(extended, points), strict=True
    ):
        np.testing.assert_allclose(
            after[..., :9] if after.ndim == 3 and after.shape[-1] > 9 else after, before, rtol=1e-12, atol=1e-9
        )


def test_the_fifth_coefficient_at_zero_changes_nothing() -> None:
    model, params = sample("pinhole-radtan", "euroc")
    five, extended = camera_model("pinhole-radtan5"), np.append(params, 0.0)
    points = points_in_view("pinhole-radtan", params)
    for before, after in zip(
        model.project_with_jacobians(params, points), five.project_with_jacobians(extended, points), strict=True
    ):
        np.testing.assert_array_equal(after[..., :8] if after.ndim == 3 else after, before)
    uv = model.project(params, points)[0]
    for before, after in zip(model.unproject(params, uv), five.unproject(extended, uv), strict=True):
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-14)


@each("name", CAMERA_MODELS)
def test_no_points_and_integer_or_strided_points(name: str) -> None:
    model, params = sample(name, next(iter(SAMPLES[name])))
    shapes = [a.shape for a in model.project_with_jacobians(params, np.empty((0, 3)))]
    assert shapes == [(0, 2), (0,), (0, 2, 3), (0, 2, len(params))]
    assert model.unproject(params, np.empty((0, 2)))[0].shape == (0, 3)
    uv, _ = model.project(params, np.array([[0, 0, 1], [0, 1, 2]]))
    strided = np.array([[0.0, 0, 1], [9, 9, 9], [0, 1, 2]])[::2]
    np.testing.assert_array_equal(model.project(params, strided)[0], uv)


@each(
    ("coefficients", "expected"),
    [
        ([0.0, 0.0], np.inf),
        ([0.1, 0.02], np.inf),
        ([-0.3, 0.0], (1 / 0.9) ** 0.5),
        ([-0.3, 1e-320], (1 / 0.9) ** 0.5),
        ([0.0, -0.2], 1.0),
        ([-3.0 / 3, 2.0 / 5], (1 / 2) ** 0.5),  # 1 - 3 s + 2 s^2: the first of two roots
        ([-6.0 / 3, 11.0 / 5, -6.0 / 7], (1 / 3) ** 0.5),  # (1 - s) (1 - 2 s) (1 - 3 s): the first of three
        ([-0.3, 0.0, 0.0], (1 / 0.9) ** 0.5),
        ([np.nan, 0.0], 0.0),
    ],
)
def test_monotonic_limit(coefficients: list[float], expected: float) -> None:
    assert monotonic_limit(np.array(coefficients)) == pytest.approx(expected, rel=1e-12)


@each("seed", range(20))
def test_monotonic_limit_of_a_rational_function(seed: int) -> None:
    """The first radius beyond which r N(r^2) / D(r^2) does not grow, or changes its sign at a pole."""
    numerator, denominator = np.random.default_rng(seed).normal(scale=0.5, size=(2, 3))
    r = np.linspace(0.0, 3.0, 300_001)[1:]
    s = r * r
    growing = np.diff(r * np.polyval([*numerator[::-1], 1.0], s) / np.polyval([*denominator[::-1], 1.0], s)) > 0.0
    found = rational.monotonic_limit(tuple(numerator), tuple(denominator))
    first = r[np.argmin(growing)] if not growing.all() else np.inf
    assert found == pytest.approx(first, abs=2e-5) or min(found, first) > 2.9
