"""IMU noise in a relative pose by propagation from the keyframes, against sampled random walks."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from icalib.motion.factor import Extrinsics
from icalib.sensors.wheels.residual import propagation_noise

GYRO, ACCEL = 3e-3, 0.4  # rad/sqrt(s), m/s/sqrt(s): so large that both count
AWAY = np.array([[0.02, 0.005], [0.0, 0.015]])
DRAWS, STEPS = 4000, 20


def planar(R_first, p_first, R_last, p_last, R_imu_wheel, p_imu_wheel):
    """yaw, x, y of the wheels at the end, in their frame at the beginning."""
    R_a, R_b = R_first @ R_imu_wheel, R_last @ R_imu_wheel
    way = R_a.T @ ((p_last + R_last @ p_imu_wheel) - (p_first + R_first @ p_imu_wheel))
    return np.array([Rotation.from_matrix(R_a.T @ R_b).as_rotvec()[2], way[0], way[1]])


def walked(R, p, t, rng):
    """The pose after t seconds of noise."""
    dt = t / STEPS
    turn = GYRO * np.sqrt(dt) * rng.standard_normal((STEPS, 3)).sum(axis=0)
    speed = np.cumsum(ACCEL * np.sqrt(dt) * rng.standard_normal((STEPS, 3)), axis=0)
    return R @ Rotation.from_rotvec(turn).as_matrix(), p + dt * (speed.sum(axis=0) - 0.5 * speed[-1])


def test_against_walks_of_orientation_and_speed():
    rng = np.random.default_rng(0)
    R_iw, lever = Rotation.from_euler("zyx", [0.4, -0.1, 0.2]).as_matrix(), np.array([-0.25, 0.1, -0.6])
    R = Rotation.from_euler("zyx", rng.uniform(-1.0, 1.0, (4, 3))).as_matrix()
    R[2:] = R[:2] @ Rotation.from_rotvec(0.1 * rng.standard_normal((2, 3))).as_matrix()
    p = rng.standard_normal((4, 3))
    p[2:] = p[:2] + 0.3 * rng.standard_normal((2, 3))
    poses: list[Any] = [SimpleNamespace(rotation=R[k], position=p[k]) for k in (slice(0, 2), slice(2, 4))]
    imu: Any = SimpleNamespace(variance=np.tile([GYRO**2, ACCEL**2, 1e-4 * ACCEL**2], (10, 1)))
    found = propagation_noise(poses[0], poses[1], AWAY, Extrinsics(R_iw, lever), imu)
    for n in range(2):
        ends = [(R[n], p[n], AWAY[n, 0]), (R[2 + n], p[2 + n], AWAY[n, 1])]
        drawn = np.array([planar(*walked(*ends[0], rng), *walked(*ends[1], rng), R_iw, lever) for _ in range(DRAWS)])
        sampled = np.cov(drawn.T)
        scale = np.sqrt(np.diag(found[n]))
        np.testing.assert_allclose(sampled / np.outer(scale, scale), found[n] / np.outer(scale, scale), atol=0.08)
    assert found[1, 2, 2] > 1e-8  # of the second, whose first end lies on its keyframe, the other end alone counts


def test_at_the_keyframes_nothing_is_lost():
    eye: Any = SimpleNamespace(rotation=np.eye(3)[None], position=np.zeros((1, 3)))
    imu: Any = SimpleNamespace(variance=np.ones((3, 3)))
    np.testing.assert_array_equal(
        propagation_noise(eye, eye, np.zeros((1, 2)), Extrinsics(np.eye(3), np.ones(3)), imu), 0.0
    )
