"""What the simulated IMU reads: biases, noise, intrinsics, gaps, clocks, repeatability."""

import math
from dataclasses import replace

import numpy as np
from tests.typed import not_none

from icalib.rig import ImuNoise
from icalib.tools.simulation import handheld, simulate


def test_white_noise_has_the_density_and_the_walk_its_own():
    noise = ImuNoise(1e-3, 2e-3, 5e-3, 4e-3)
    scenario = replace(handheld(duration_s=60.0), imu_noise=noise)
    noisy, clean = simulate(scenario, seed=5), simulate(replace(scenario, imu_noise_enabled=False), seed=5)
    bias_g, bias_a = noisy.truth.gyro_bias, noisy.truth.accel_bias
    white_g = not_none(noisy.measurements.imu).gyro - not_none(clean.measurements.imu).gyro - bias_g + bias_g[0]
    white_a = not_none(noisy.measurements.imu).accel - not_none(clean.measurements.imu).accel - bias_a + bias_a[0]
    # 36 000 samples: the standard deviation is known to 0.37 %, four of which are allowed.
    for white, density in ((white_g, noise.gyro), (white_a, noise.accel)):
        assert abs(white.std() / (density * math.sqrt(200.0)) - 1.0) < 0.015
        assert abs((white[1:] * white[:-1]).mean()) < 0.03 * white.var()
    for bias, density in ((bias_g, noise.gyro_walk), (bias_a, noise.accel_walk)):
        assert abs(np.diff(bias, axis=0).std() / (density * math.sqrt(0.005)) - 1.0) < 0.015
        step = np.diff(bias[::200], axis=0)
        assert abs(step.std() / density - 1.0) < 0.25


def test_noiseless_readings_are_truth_plus_constant_bias():
    scenario = handheld(duration_s=2.0, noiseless=True)
    plain = simulate(replace(scenario, gyro_bias=(0.0,) * 3, accel_bias=(0.0,) * 3), seed=6)
    biased = simulate(scenario, seed=6)
    np.testing.assert_allclose(
        not_none(biased.measurements.imu).gyro - not_none(plain.measurements.imu).gyro,
        biased.truth.gyro_bias,
        atol=1e-14,
    )
    np.testing.assert_array_equal(biased.truth.accel_bias, np.tile(scenario.accel_bias, (4001, 1)))


def test_intrinsics_follow_the_scale_misalignment_model():
    rng = np.random.default_rng(0)
    x = rng.uniform(-0.03, 0.03, 24)
    scenario = replace(handheld(duration_s=1.0, noiseless=True), gyro_bias=(0.0,) * 3, accel_bias=(0.0,) * 3)
    ideal = simulate(scenario, seed=7).measurements.imu
    real = simulate(replace(scenario, imu_intrinsics=x), seed=7).measurements.imu
    M_a = np.array([[1.0 + x[0], 0.0, 0.0], [x[1], 1.0 + x[2], 0.0], [x[3], x[4], 1.0 + x[5]]])
    M_g = np.array([[1.0 + x[6], 0.0, 0.0], [x[7], 1.0 + x[8], 0.0], [x[9], x[10], 1.0 + x[11]]])
    r, A = x[12:15], x[15:].reshape(3, 3)
    K = np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
    C, term = np.eye(3), np.eye(3)
    for n in range(1, 12):
        term = term @ K / n
        C = C + term
    for w, f, gyro, accel in zip(
        not_none(ideal).gyro, not_none(ideal).accel, not_none(real).gyro, not_none(real).accel, strict=True
    ):
        np.testing.assert_allclose(gyro, M_g @ w + A @ f, atol=1e-13)
        np.testing.assert_allclose(accel, M_a @ C @ f, atol=1e-13)


def test_a_late_accelerometer_and_a_low_pass():
    scenario = replace(handheld(duration_s=2.0, noiseless=True), gyro_bias=(0.0,) * 3, accel_bias=(0.0,) * 3)
    prompt = not_none(simulate(scenario, seed=7).measurements.imu)
    late = not_none(simulate(replace(scenario, imu_accel_delay_s=0.01), seed=7).measurements.imu)
    np.testing.assert_array_equal(late.gyro, prompt.gyro)
    np.testing.assert_allclose(late.accel[20:], prompt.accel[:-20], atol=1e-12)  # 20 readings of 0.5 ms
    smooth = not_none(simulate(replace(scenario, imu_cutoff_hz=5.0), seed=7).measurements.imu)
    sigma = np.sqrt(np.log(2.0)) / (2.0 * np.pi * 5.0) / 0.0005  # of the Gaussian, in readings
    weights = np.exp(-0.5 * (np.arange(-400, 401) / sigma) ** 2)
    for axis in range(3):
        means = np.convolve(prompt.gyro[:, axis], weights / weights.sum(), "valid")
        np.testing.assert_allclose(smooth.gyro[400:-400, axis], means, atol=1e-4)


def test_gap_loses_readings_and_keeps_the_motion():
    scenario = handheld(duration_s=3.0)
    whole, gap = simulate(scenario, seed=8), simulate(replace(scenario, imu_gaps=((1.0, 1.5),)), seed=8)
    stamps = not_none(whole.measurements.imu).seconds
    kept = (stamps < 0.999) | (stamps > 1.501)
    np.testing.assert_array_equal(not_none(gap.measurements.imu).gyro, not_none(whole.measurements.imu).gyro[kept])
    np.testing.assert_array_equal(gap.truth.position, whole.truth.position[kept])
    np.testing.assert_array_equal(gap.measurements.cameras[0].uv, whole.measurements.cameras[0].uv)


def test_stamps_count_from_the_clock_origin_and_increase_under_jitter():
    scenario = replace(handheld(duration_s=1.0), imu_clock_origin_ns=5_000_000_123, imu_jitter_s=2e-3)
    imu = simulate(scenario, seed=9).measurements.imu
    assert not_none(imu).stamps_ns[0] == 5_000_000_123
    steps = np.diff(not_none(imu).stamps_ns)
    assert steps.min() > 0 and np.ptp(steps) > 1_000_000


def test_same_seed_same_numbers():
    scenario = replace(handheld(duration_s=1.0), outlier_fraction=0.1, shift_px=0.1)
    a, b, c = (simulate(scenario, seed=s) for s in (10, 10, 11))
    np.testing.assert_array_equal(not_none(a.measurements.imu).gyro, not_none(b.measurements.imu).gyro)
    np.testing.assert_array_equal(a.measurements.cameras[1].uv, b.measurements.cameras[1].uv)
    assert not np.array_equal(not_none(a.measurements.imu).gyro, not_none(c.measurements.imu).gyro)
