"""Planes: their tangents, corrections, and the paper's closest-point form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each
from tests.typed import random_rotations

from icalib.geometry.planes import moved, plane_of, tangents

SPECIAL = [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, -1, 0], [0.6, 0.8, 0.0], [0.6, 0.8, -1e-17], [1e-9, 0, -1]]


def normals() -> np.ndarray:
    random = np.random.default_rng(0).normal(size=(50, 3))
    both = np.concatenate([np.array(SPECIAL, dtype=float), random])
    return both / np.linalg.norm(both, axis=1, keepdims=True)


@each("normal", normals())
def test_tangents_and_normal_are_a_right_handed_frame(normal: np.ndarray):
    frame = np.vstack([tangents(normal), normal])
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(frame) == pytest.approx(1.0)


@each("normal", normals())
@each("size", [0.0, 1e-12, 1e-6, 1e-2, 1.0, 3.0])
def test_a_correction_turns_the_normal_by_its_size_about_the_planes_point(normal: np.ndarray, size: float):
    point, direction = np.array([3.0, -2.0, 1.0]), np.array([0.6, -0.8])
    plane = moved(plane_of(normal, point), np.append(size * direction, 0.0))
    towards = direction @ tangents(normal)
    turned = Rotation.from_rotvec(size * np.cross(normal, towards)).apply(normal)
    np.testing.assert_allclose(plane[:3], turned, atol=1e-14)
    np.testing.assert_array_equal(plane[3:], point)


def test_a_correction_of_the_distance_moves_the_plane_along_its_normal():
    plane = plane_of(np.array([1.0, 2.0, -2.0]), np.array([0.3, 0.1, 7.0]))
    after = moved(plane, np.array([0.0, 0.0, 0.25]))
    assert after[:3] @ after[3:] - plane[:3] @ plane[3:] == pytest.approx(0.25)
    np.testing.assert_allclose(after[:3], plane[:3], atol=1e-15)


def closest_point(plane: np.ndarray) -> np.ndarray:
    """(3,) point of `plane` (6,) closest to the origin [m], p_pi = d n in the iCalib paper."""
    return (plane[:3] @ plane[3:]) * plane[:3]


def closest_point_residual(
    p_pi: np.ndarray, R_world_lidar: np.ndarray, p_world_lidar: np.ndarray, xyz: np.ndarray
) -> np.ndarray:
    """(N,) residuals (24) and (25) of the iCalib paper [m], of points xyz (N, 3) in the LiDAR frame. p_pi (3,): closest
    point of the plane in the world frame.

    The residual is n . p - d if sensor and origin are on the same side of the plane, and its negative otherwise. It is
    undefined for a plane through the origin or the sensor. The reason is that (24) uses p_pi / |p_pi| as n, which is -n
    if d_L < 0.
    """
    d = np.linalg.norm(p_pi)
    normal = p_pi / d
    d_lidar = d - normal @ p_world_lidar
    p_pi_lidar = d_lidar * (R_world_lidar.T @ normal)
    size = np.linalg.norm(p_pi_lidar)
    return xyz @ p_pi_lidar / size - size


@pytest.mark.parametrize("beyond", [False, True])
def test_the_papers_residual_is_ours_but_for_its_sign_beyond_the_plane(beyond: bool):
    rng = np.random.default_rng(1)
    R, plane = random_rotations(None, seed=2).as_matrix(), plane_of(rng.normal(size=3), np.array([0.2, 0.1, 0.3]))
    plane[3:] += 4.0 * plane[:3]
    sensor = (9.0 if beyond else -1.0) * plane[:3] + rng.normal(size=3) * 0.1
    xyz = rng.normal(size=(20, 3))
    ours = (sensor + xyz @ R.T) @ plane[:3] - plane[:3] @ plane[3:]
    theirs = closest_point_residual(closest_point(plane), R, sensor, xyz)
    np.testing.assert_allclose(theirs, -ours if beyond else ours, atol=1e-13)
    assert np.abs(ours).min() > 0.1
