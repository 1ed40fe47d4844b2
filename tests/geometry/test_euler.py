"""Roll, pitch and yaw against SciPy, and their standard deviations against differences and samples."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.geometry.so3 import LEAST_SIGMAS, rpy, rpy_jacobian, rpy_std

RNG = np.random.default_rng(3)
COVARIANCE = np.deg2rad(0.2) ** 2 * np.array([[1.0, 0.5, -0.3], [0.5, 2.0, 0.4], [-0.3, 0.4, 0.5]])


def of(roll: float, pitch: float, yaw: float) -> np.ndarray:
    return Rotation.from_euler("xyz", [roll, pitch, yaw], degrees=True).as_matrix()


def sampled(R: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """(3,) standard deviations of the angles over draws, of which none may cross gimbal lock or half a turn."""
    draws = Rotation.from_rotvec(RNG.multivariate_normal(np.zeros(3), covariance, 100_000))
    return (Rotation.from_matrix(R) * draws).as_euler("xyz").std(axis=0)


def test_angles_reproduce_the_rotation():
    """At half turns and a pitch of 90 deg, too, where roll and yaw are one; elsewhere they are those of SciPy."""
    special = [of(r, p, y) for p in (90.0, -90.0, 89.9999999) for r, y in ((30.0, 20.0), (5.0, -170.0))]
    special += [Rotation.from_rotvec(np.pi * axis).as_matrix() for axis in np.eye(3)]
    for R in special:
        np.testing.assert_allclose(of(*np.rad2deg(rpy(R))), R, atol=1e-12)
    for rotation in Rotation.random(50, rng=np.random.default_rng(1)):
        np.testing.assert_allclose(rpy(rotation.as_matrix()), rotation.as_euler("xyz"), atol=1e-12)


def test_the_jacobian_is_that_of_central_differences():
    h = 1e-6
    for rotation in Rotation.random(30, rng=np.random.default_rng(2)):
        ends = [rpy((rotation * Rotation.from_rotvec(s * h * e)).as_matrix()) for e in np.eye(3) for s in (1.0, -1.0)]
        numeric = np.array([(a - b) / (2.0 * h) for a, b in zip(ends[::2], ends[1::2], strict=True)]).T
        J = rpy_jacobian(rotation.as_matrix())
        np.testing.assert_allclose(J, numeric, atol=1e-7 * np.abs(J).max() ** 3)


@each("angles", [(10.0, 5.0, 100.0), (-80.0, 60.0, 20.0), (40.0, -75.0, -30.0)])
def test_standard_deviations_are_those_of_samples(angles: tuple[float, float, float]):
    np.testing.assert_allclose(rpy_std(of(*angles), COVARIANCE), sampled(of(*angles), COVARIANCE), rtol=0.01)


def test_beside_gimbal_lock_they_are_not_those_about_the_axes_of_the_sensor():
    """A camera on its side, 2.3 deg from gimbal lock: yaw is 25 times as uncertain as the rotation."""
    isotropic = np.deg2rad(0.02) ** 2 * np.eye(3)
    std, R = rpy_std(of(15.0, 87.7, 15.0), isotropic), of(15.0, 87.7, 15.0)
    np.testing.assert_allclose(std / np.deg2rad(0.02), [24.9, 1.0, 24.9], rtol=0.01)
    np.testing.assert_allclose(std, sampled(R, isotropic), rtol=0.01)


def test_within_five_standard_deviations_of_gimbal_lock_there_are_none():
    """At the limit those to first order are still those of samples to 7 %."""
    sigma = np.deg2rad(0.5)
    for side in (1.0, -1.0):
        near, far = (of(20.0, side * (90.0 - f * 0.5 * LEAST_SIGMAS), 30.0) for f in (0.99, 1.01))
        assert np.isnan(rpy_std(near, sigma**2 * np.eye(3))).all()
        found, drawn = rpy_std(far, sigma**2 * np.eye(3)), sampled(far, sigma**2 * np.eye(3))
        np.testing.assert_allclose(found[[0, 2]], drawn[[0, 2]], rtol=0.07)
    assert np.isnan(rpy_std(of(0.0, 90.0, 0.0), 1e-20 * np.eye(3))).all()
    assert np.isnan(rpy_std(np.eye(3), np.full((3, 3), np.nan))).all()
    np.testing.assert_array_equal(rpy_std(of(0.0, 90.0, 0.0), np.zeros((3, 3))), 0.0)  # a fixed rotation
