"""Laws of SO(3) at every angle, branch boundaries included, against power series in extended precision and scipy."""

from __future__ import annotations

from collections.abc import Callable
from math import pi, sqrt

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from tests.cases import each
from tests.typed import random_rotations

from icalib.geometry import so3

BORDER = sqrt(so3.SERIES_BELOW)
SMALL = [0.0, 1e-300, 1e-160, 1e-20, 1e-12, 1e-9, 1e-7, 1e-5, 1e-4, 1e-3, 1e-2, BORDER * (1 - 1e-12), BORDER, 0.1, 0.11]
ANGLES = [*SMALL, 1.0, pi / 2, 2.0, 2 * pi / 3, 3.0, pi - 1e-3, pi - 1e-6, pi - 1e-9, pi]
BELOW_PI = [angle for angle in ANGLES if angle < pi]
AXES = np.array(
    [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [1, 1, 1], [1, -1, 1e-9], [0.3, -0.8, 0.5], [-2, 1e-5, 1]], float
)
AXES /= np.linalg.norm(AXES, axis=1, keepdims=True)

at_every_angle = each("angle", ANGLES)
below_pi = each("angle", BELOW_PI)


def vectors(angle: float) -> np.ndarray:
    return angle * AXES


def hat(v: np.ndarray) -> np.ndarray:
    return np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])


def series(phi: np.ndarray, shift: int) -> np.ndarray:
    """Sum of hat(phi)^n / (n + shift)! times shift!: the exponential (0), or the left Jacobian (1)."""
    term = total = np.eye(3, dtype=np.longdouble)
    for n in range(1, 60):
        term = term @ hat(phi).astype(np.longdouble) / (n + shift)
        total = total + term
    return total


def differences(function: Callable[[np.ndarray], np.ndarray], step: float = 2e-4) -> np.ndarray:
    """Central differences of fourth order about zero, one column per tangent direction."""
    columns = []
    for d in step * np.eye(3):
        columns.append((8 * (function(d) - function(-d)) - (function(2 * d) - function(-2 * d))) / (12 * step))
    return np.stack(columns, axis=1)


def test_hat_is_the_cross_product() -> None:
    v, w = np.array([0.3, -1.2, 2.0]), np.array([-0.7, 0.4, 1.1])
    np.testing.assert_allclose(so3.hat(v) @ w, np.cross(v, w), rtol=1e-15)
    many = np.array([[v, w], [w, 2.0 * v]])
    np.testing.assert_allclose(so3.hat_many(many) @ w, np.cross(many, w), rtol=1e-15, atol=1e-15)


@each("angle", [*ANGLES, 4.0, 2 * pi, 10.0])
def test_exp(angle: float) -> None:
    for phi in vectors(angle):
        R = so3.exp(phi)
        np.testing.assert_allclose(R, series(phi, 0).astype(float), atol=4e-15)
        np.testing.assert_allclose(R, expm(hat(phi)), atol=1e-14)
        np.testing.assert_allclose(R, Rotation.from_rotvec(phi).as_matrix(), atol=2e-15)
        np.testing.assert_allclose(R.T @ R, np.eye(3), atol=2e-15)
        np.testing.assert_allclose(so3.exp(-phi), R.T, atol=0)


@below_pi
def test_log_inverts_exp(angle: float) -> None:
    for phi in vectors(angle):
        # Relative where the angle is small: a rotation by 1e-12 rad has its digits, too.
        np.testing.assert_allclose(so3.log(so3.exp(phi)), phi, rtol=1e-14, atol=2e-15 * min(1.0, angle))


def test_log_of_half_a_turn_is_the_axis_up_to_sign() -> None:
    for phi in vectors(pi):
        found = so3.log(so3.exp(phi))
        np.testing.assert_allclose(np.sign(found @ phi) * found, phi, atol=2e-15)
    for i in range(3):
        half_turn = -np.eye(3)
        half_turn[i, i] = 1.0
        np.testing.assert_allclose(np.abs(so3.log(half_turn)), pi * np.eye(3)[i], atol=1e-15)


@each("angle", [4.0, 2 * pi - 1e-6, 2 * pi + 1e-3, 10.0])
def test_log_gives_the_short_way_round(angle: float) -> None:
    for phi in vectors(angle):
        np.testing.assert_allclose(so3.log(so3.exp(phi)), Rotation.from_rotvec(phi).as_rotvec(), atol=1e-14)


def test_log_of_random_rotations() -> None:
    rotations = Rotation.from_quat(np.random.default_rng(1).normal(size=(500, 4)))
    expected = rotations.as_rotvec()
    np.testing.assert_allclose(so3.log_many(rotations.as_matrix()), expected, atol=1e-14)
    np.testing.assert_allclose(so3.exp_many(expected), rotations.as_matrix(), atol=4e-15)


def test_log_tolerates_rounding_in_the_matrix() -> None:
    noise = np.random.default_rng(2).normal(size=(len(AXES), 3, 3))
    for angle in (0.0, 1e-9, 1.0, pi - 1e-3):
        for phi, n in zip(vectors(angle), noise, strict=True):
            np.testing.assert_allclose(so3.log(so3.exp(phi) + 1e-12 * n), phi, atol=1e-11)


@at_every_angle
def test_right_jacobian(angle: float) -> None:
    for phi in vectors(angle):
        J = so3.right_jacobian(phi)
        np.testing.assert_allclose(J, series(-phi, 1).astype(float), atol=2e-15)
        np.testing.assert_allclose(J, differences(lambda d, p=phi: so3.log(so3.exp(p).T @ so3.exp(p + d))), atol=2e-11)
        # The part odd in phi is -phi / 2 to first order, and would be lost in a sum with 1.
        odd = (series(-phi, 1) - series(phi, 1)).astype(float)
        np.testing.assert_allclose(
            J - so3.right_jacobian(-phi), odd, rtol=1e-13, atol=2e-15 * min(1.0, angle) + 2.3e-16
        )


@each("angle", [angle for angle in ANGLES if angle <= pi - 1e-3])
def test_inverse_jacobians_are_derivatives_of_the_log(angle: float) -> None:
    for phi in vectors(angle):
        R = so3.exp(phi)
        right = differences(lambda d, R=R: so3.log(R @ so3.exp(d)))
        left = differences(lambda d, R=R: so3.log(so3.exp(d) @ R))
        np.testing.assert_allclose(so3.right_jacobian_inverse(phi), right, atol=4e-11)
        np.testing.assert_allclose(so3.left_jacobian_inverse(phi), left, atol=4e-11)


@at_every_angle
def test_inverse_jacobians_invert(angle: float) -> None:
    for phi in vectors(angle):
        np.testing.assert_allclose(so3.left_jacobian_inverse(phi) @ series(phi, 1), np.eye(3), atol=5e-15)
        np.testing.assert_allclose(so3.right_jacobian_inverse(phi) @ series(-phi, 1), np.eye(3), atol=5e-15)


@at_every_angle
def test_laws(angle: float) -> None:
    v = np.array([0.4, -0.7, 0.59])
    for phi in vectors(angle):
        R, left, right = so3.exp(phi), series(phi, 1).astype(float), so3.right_jacobian(phi)
        np.testing.assert_allclose(R @ right, left, atol=4e-15)
        np.testing.assert_allclose(R @ so3.hat(v) @ R.T, so3.hat(R @ v), atol=4e-15)
        np.testing.assert_allclose(R @ phi, phi, atol=4e-15)
        np.testing.assert_allclose(left @ phi, phi, atol=4e-15)
        np.testing.assert_allclose(R, np.eye(3) + so3.hat(phi) @ left, atol=4e-15)


@each("x", [0.0, 1e-300, 1e-12, 1e-6, 1e-3, np.nextafter(0.01, 0), 0.01, np.nextafter(0.01, 1), 1.0, pi**2])
def test_coefficients_keep_their_digits(x: float) -> None:
    for k, found in enumerate(so3.jacobian_coefficients(x)):
        expected = term = 1 / np.prod(np.arange(1, k + 2, dtype=np.longdouble))
        for n in range(1, 40):
            term = -term * np.longdouble(x) / ((2 * n + k) * (2 * n + k + 1))
            expected = expected + term
        # In closed form each is a difference of the one two before and its limit: x * coefficient of order 1 is lost.
        assert found == pytest.approx(float(expected), rel=1e-15 * (3 if k < 2 else 3 / min(max(x, 0.01), 1.0)))


@each("seed", range(5))
def test_closest_rotation_is_that_of_the_wahba_problem(seed: int):
    rng = np.random.default_rng(seed)
    b = rng.normal(size=(6, 3))
    a = b @ random_rotations(None, seed).as_matrix().T + 0.1 * rng.normal(size=(6, 3))
    found = so3.closest_rotation(a.T @ b)
    np.testing.assert_allclose(found, Rotation.align_vectors(a, b)[0].as_matrix(), atol=1e-12)
    mirrored = so3.closest_rotation(-np.eye(3) - np.diag([0.1, 0.2, 0.3]))  # no reflection
    assert np.linalg.det(mirrored) == pytest.approx(1.0)
