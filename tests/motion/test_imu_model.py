"""The scale-misalignment model: undone exactly, and its derivatives."""

import numpy as np
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.motion.imu_data import correction_matrices
from icalib.motion.integration_step import AT_INTRINSICS, J_STRIDE, RUN_SIZE, correction, fill_intrinsics
from icalib.sensors.imu.spec import INTRINSICS_LABELS as LABELS
from icalib.sensors.imu.spec import N_INTRINSICS

LOWER = ([0, 1, 1, 2, 2, 2], [0, 0, 1, 0, 1, 2])
RATE, FORCE = np.array([0.7, -1.1, 0.4]), np.array([2.0, -3.0, 9.0])


def model(intrinsics, rate, force):
    """Readings without bias and noise."""
    M_a, M_g = np.eye(3), np.eye(3)
    M_a[LOWER] += intrinsics[:6]
    M_g[LOWER] += intrinsics[6:12]
    C, A = Rotation.from_rotvec(intrinsics[12:15]).as_matrix(), intrinsics[15:].reshape(3, 3)
    return M_g @ rate + A @ force, M_a @ C @ force


def corrected(intrinsics, gyro, accel):
    F, G, H, _ = correction_matrices(intrinsics)
    return G @ gyro + H @ accel, F @ accel


def random_intrinsics(seed, size):
    return size * np.random.default_rng(seed).normal(size=N_INTRINSICS)


@each("size", [0.0, 1e-9, 1e-2, 0.1])
def test_correction_undoes_the_model(size):
    intrinsics = random_intrinsics(1, size)
    rate, force = corrected(intrinsics, *model(intrinsics, RATE, FORCE))
    np.testing.assert_allclose(rate, RATE, rtol=0, atol=1e-12)
    np.testing.assert_allclose(force, FORCE, rtol=0, atol=1e-12)


@each("size", [0.0, 1e-9, 1e-2, 0.1])
def test_derivatives_by_central_differences(size):
    intrinsics = random_intrinsics(2, size)
    gyro, accel = np.array([0.5, 1.0, -0.8]), np.array([-1.0, 4.0, 8.0])
    rate, force = corrected(intrinsics, gyro, accel)
    run = np.zeros(RUN_SIZE)
    fill_intrinsics(tuple(rate), tuple(force), correction(intrinsics), run)
    d_rate, d_force = run[AT_INTRINSICS : AT_INTRINSICS + 6 * J_STRIDE].reshape(2, 3, J_STRIDE)[:, :, :N_INTRINSICS]
    h = 1e-5
    for n in range(N_INTRINSICS):
        step = h * np.eye(N_INTRINSICS)[n]
        plus, minus = corrected(intrinsics + step, gyro, accel), corrected(intrinsics - step, gyro, accel)
        np.testing.assert_allclose(d_rate[:, n], (plus[0] - minus[0]) / (2 * h), atol=1e-7, err_msg=LABELS[n])
        np.testing.assert_allclose(d_force[:, n], (plus[1] - minus[1]) / (2 * h), atol=1e-7, err_msg=LABELS[n])


@each(
    ("label", "reading", "axis"),
    [("accel_yy", 1, 1), ("accel_zx", 1, 2), ("gyro_xx", 0, 0), ("gyro_zy", 0, 2), ("g_sensitivity_yz", 0, 1)],
)
def test_each_label_names_the_reading_that_it_moves(label, reading, axis):
    intrinsics = 1e-3 * np.eye(N_INTRINSICS)[LABELS.index(label)]
    moved = np.array(model(intrinsics, RATE, FORCE)) - np.array([RATE, FORCE])
    assert np.argwhere(moved).tolist() == [[reading, axis]]
    np.testing.assert_allclose(corrected(intrinsics, *model(intrinsics, RATE, FORCE)), [RATE, FORCE], atol=1e-13)


def test_there_is_a_label_for_each():
    assert len(LABELS) == len(set(LABELS)) == N_INTRINSICS
