"""Which wheel stamps an interval goes between, where its motion is looked at, and what wheels have turned."""

from dataclasses import replace

import numpy as np
import pytest

from icalib.data.measurements import ImuStream
from icalib.motion.imu_data import MAX_INTERVAL_S, ImuData, StampIntervals, choose_intervals
from icalib.rig import ImuNoise
from icalib.sensors.wheels.residual import PANEL_S, integrated, quadrature


@pytest.fixture(scope="module")
def imu():
    t = np.arange(0.0, 3.0, 0.005)
    t = t[(t <= 2.0) | (t >= 2.1)]  # a gap
    stream = ImuStream("imu0", np.round(t * 1e9).astype(np.int64), np.zeros((len(t), 3)), np.zeros((len(t), 3)))
    return ImuData.build(stream, ImuNoise(1e-3, 1e-2, 1e-5, 1e-4))


def pairs(found):
    return list(zip(found.first.tolist(), found.last.tolist(), found.keyframe.tolist(), strict=True))


def test_the_stamps_nearest_to_the_keyframes_are_taken(imu):
    times = np.arange(0.1, 0.5, 0.02)  # 0.1, 0.12, ...
    found = choose_intervals(imu, np.array([0.161, 0.2, 0.269]), (0,), times)
    assert pairs(found) == [(3, 5, 0), (5, 8, 1)]


def test_keyframes_denser_than_stamps_share_them_and_the_two_about_the_middle_carry_the_interval(imu):
    keyframes = np.arange(0.1, 0.45, 0.025)
    times = np.array([0.11, 0.21, 0.31])
    found = choose_intervals(imu, keyframes, (0,), times)
    assert [(a, b) for a, b, _ in pairs(found)] == [(0, 1), (1, 2)]
    for a, b, k in pairs(found):
        assert keyframes[k] <= 0.5 * (times[a] + times[b]) <= keyframes[k + 1]


def test_outside_the_wheels_recording_there_are_no_intervals(imu):
    found = choose_intervals(imu, np.arange(0.0, 1.0, 0.05), (0,), np.arange(0.32, 0.58, 0.01))
    assert found.first[0] == 0 and found.last[-1] == 25
    assert np.all(found.first[1:] == found.last[:-1])


def test_intervals_stay_off_gaps_of_the_imu_and_within_its_recording(imu):
    times, keyframes = np.arange(-0.2, 3.2, 0.01), np.arange(0.02, 2.97, 0.05)
    keyframes[0] = -0.1
    found = choose_intervals(imu, keyframes, (0,), times)
    start, end = imu.gaps[0]
    assert np.all((times[found.last] <= start + 1e-9) | (times[found.first] >= end - 1e-9))
    assert times[found.first].min() >= 0.0
    assert len(found.keyframe) == len(keyframes) - 1 - 1 - 3  # one starts before the IMU, three touch the gap


def test_no_interval_goes_from_one_recording_to_another(imu):
    keyframes, times = np.arange(0.1, 0.5, 0.05), np.arange(0.0, 1.0, 0.01)
    assert 2 not in choose_intervals(imu, keyframes, (0, 3), times).keyframe
    assert 2 in choose_intervals(imu, keyframes, (0,), times).keyframe


def test_a_seam_within_the_readings_is_not_crossed(imu):
    keyframes, times = np.arange(0.1, 0.5, 0.05), np.arange(0.0, 1.0, 0.01)
    assert 2 not in choose_intervals(replace(imu, seams=((0.22, 0.23),)), keyframes, (0,), times).keyframe


def test_a_pause_of_the_wheels_is_no_interval(imu):
    times = np.concatenate([np.arange(0.0, 0.5, 0.01), np.arange(0.5 + MAX_INTERVAL_S + 0.02, 1.9, 0.01)])
    found = choose_intervals(imu, np.arange(0.0, 1.9, 0.05), (0,), times)
    assert (times[found.last] - times[found.first]).max() < 0.1


SECONDS = np.array([0.0, 0.03, 0.055, 0.3, 0.8])
INTERVALS = StampIntervals(np.array([0, 1, 2]), np.array([1, 3, 4]), np.array([4, 5, 8]))


def test_quadrature_is_exact_for_cubics():
    at = quadrature(SECONDS, INTERVALS)
    for i, (a, b, k) in enumerate(pairs(INTERVALS)):
        own = slice(at.start[i], at.start[i + 1])
        for power in range(4):
            exact = (SECONDS[b] ** (power + 1) - SECONDS[a] ** (power + 1)) / (power + 1)
            assert at.weight[own] @ at.times[own] ** power == pytest.approx(exact, rel=1e-13)
        middle = 0.5 * (SECONDS[a] + SECONDS[b])
        np.testing.assert_array_equal(at.keyframe[own], k + (at.times[own] > middle))


def test_instants_begin_and_end_with_the_stamps_and_are_dense_enough():
    at = quadrature(SECONDS, INTERVALS)
    np.testing.assert_array_equal(at.times[at.start[:-1]], SECONDS[INTERVALS.first])
    np.testing.assert_array_equal(at.times[at.start[1:] - 1], SECONDS[INTERVALS.last])
    for i in range(3):
        own = at.times[at.start[i] : at.start[i + 1]]
        assert np.all(np.diff(own) > 0.0) and np.diff(own).max() < PANEL_S
    assert np.diff(at.start).tolist() == [6, 26, 62]


T = np.cumsum(np.random.default_rng(0).uniform(0.01, 0.03, 200))


def turned(t):
    return np.stack([2.0 * t + np.sin(1.3 * t), 1.5 * t - 0.4 * np.cos(2.0 * t)], axis=-1)


def test_mean_rates_add_up_to_what_was_turned():
    rates = np.zeros((200, 2))
    rates[1:] = np.diff(turned(T), axis=0) / np.diff(T)[:, None]
    np.testing.assert_allclose(integrated(T, rates, "interval-mean"), turned(T) - turned(T[0]), rtol=0, atol=1e-12)


def test_instant_rates_are_integrated_by_trapezoids():
    rates = np.stack([2.0 + 1.3 * np.cos(1.3 * T), 1.5 + 0.8 * np.sin(2.0 * T)], axis=-1)
    got, want = integrated(T, rates, "instantaneous"), turned(T) - turned(T[0])
    np.testing.assert_allclose(got, want, rtol=0, atol=5e-4)
    # Read as means they are late: angle(t) of what was turned half a period earlier.
    late = integrated(T, rates, "interval-mean") - want
    assert np.abs(late).max() > 5e-3


def test_the_two_readings_of_a_driver_differ_by_half_a_period():
    t = np.arange(0.0, 4.0, 0.02)
    rates = np.stack([np.cos(t), np.sin(2.0 * t)], axis=-1)
    shift = integrated(t, rates, "interval-mean") - integrated(t, rates, "instantaneous")
    np.testing.assert_allclose(shift, 0.01 * (rates - rates[0]), rtol=0, atol=1e-12)
