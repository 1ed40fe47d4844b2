"""The first guess of a differential drive, from the obvious planar path: a point that moves along its own heading."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.data.measurements import ImuStream
from icalib.errors import EstimationError
from icalib.motion.imu_data import ImuData
from icalib.rig import ImuNoise
from icalib.sensors.wheels.initialize.drive_guess import drive_guess, wheel_offset, wheel_rates

RADII, BASELINE, LEVER = np.array([0.1, 0.12]), 0.5, np.array([-0.3, 0.12, -0.1])  # p_imu_wheel in the wheels' axes
R_IMU_WHEEL = Rotation.from_euler("zyx", [2.2, 0.3, -0.4]).as_matrix()
UP = R_IMU_WHEEL[:, 2]
HZ = 200.0


@dataclass(frozen=True)
class Path:
    """Rate about z and speed of the wheels' origin at t (n,), and the wheels' angles, by small trapezoids."""

    t: np.ndarray
    turn: np.ndarray
    speed: np.ndarray

    @property
    def angles(self):
        rates = (self.speed[:, None] + 0.5 * BASELINE * self.turn[:, None] * [-1.0, 1.0]) / RADII
        steps = 0.5 * (rates[1:] + rates[:-1]) * np.diff(self.t)[:, None]
        return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])

    @property
    def rate(self):
        return self.turn[:, None] * UP

    @property
    def velocity(self):
        """Of the IMU, in its axes: it sits at -LEVER seen from the wheels."""
        x, y = self.speed + self.turn * LEVER[1], -self.turn * LEVER[0]
        return np.stack([x, y, np.zeros_like(x)], axis=1) @ R_IMU_WHEEL.T


def path(duration=40.0, turn=0.6, speed=0.8):
    t = np.arange(0.0, duration, 1.0 / HZ)
    return Path(
        t,
        turn * (np.sin(0.9 * t) + 0.6 * np.sin(2.3 * t + 1.0)),
        speed * (1.0 + 0.7 * np.sin(0.5 * t + 0.4) + 0.3 * np.sin(1.7 * t)),
    )


def guess(p, velocity_noise=0.0, wheel_noise=0.0, seed=0):
    """From means over 0.1 s."""
    rng, step = np.random.default_rng(seed), round(0.1 * HZ)
    wheel = np.diff(p.angles[::step], axis=0) / 0.1
    n = len(wheel)
    rate, velocity = (
        (0.5 * (x[1:] + x[:-1]))[: n * step].reshape(n, step, 3).mean(axis=1) for x in (p.rate, p.velocity)
    )
    velocity = velocity + velocity_noise * rng.normal(size=(n, 3))
    return drive_guess("wheel0", wheel + wheel_noise * rng.normal(size=(n, 2)), rate, velocity, 9.81 * UP)


def differences(found):
    """Yaw, x, y in the wheels' axes, relative radii and baseline."""
    turn = Rotation.from_matrix(R_IMU_WHEEL.T @ found.extrinsics.R).as_rotvec()
    p = R_IMU_WHEEL.T @ found.extrinsics.p - LEVER
    return turn, p, found.values["radii"] / RADII - 1.0, found.values["baseline"][0] / BASELINE - 1.0


def test_without_noise_the_drive_is_exact():
    found = guess(path())
    turn, p, radii, baseline = differences(found)
    assert np.abs(turn).max() < 1e-6 and np.abs(p[:2]).max() < 1e-6
    assert np.abs(radii).max() < 1e-6 and abs(baseline) < 1e-6
    assert UP @ found.extrinsics.p == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(found.extrinsics.R @ found.extrinsics.R.T, np.eye(3), rtol=0, atol=1e-12)
    assert np.linalg.det(found.extrinsics.R) > 0.0


@each("seed", range(3))
def test_with_noise_it_is_good_enough_to_start_from(seed):
    """Velocities to 2 cm/s, wheels to 0.1 rad/s over 0.1 s."""
    turn, p, radii, baseline = differences(guess(path(), 0.02, 0.1, seed))
    assert abs(turn[2]) < np.deg2rad(1.0) and np.abs(p[:2]).max() < 0.02
    assert np.abs(radii).max() < 0.01 and abs(baseline) < 0.03


def test_driving_backwards_most_of_the_time_does_not_turn_the_frame_around():
    turn, *_ = differences(guess(path(speed=-0.8)))
    assert np.abs(turn).max() < 1e-6


def test_wheels_that_slipped_for_a_while_are_left_out():
    p = path()
    step = round(0.1 * HZ)
    wheel = np.diff(p.angles[::step], axis=0) / 0.1
    wheel[100:115] *= [1.5, 1.2]
    n = len(wheel)
    rate, velocity = (
        (0.5 * (x[1:] + x[:-1]))[: n * step].reshape(n, step, 3).mean(axis=1) for x in (p.rate, p.velocity)
    )
    turn, lever, radii, baseline = differences(drive_guess("wheel0", wheel, rate, velocity, UP))
    assert np.abs(turn).max() < 1e-6 and np.abs(lever[:2]).max() < 1e-6
    assert np.abs(radii).max() < 1e-6 and abs(baseline) < 1e-6


def rates_of(p):
    step = round(0.1 * HZ)
    return np.diff(p.angles[::step], axis=0) / 0.1, p.rate[:-step:step], p.velocity[:-step:step]


@each(
    ("change", "sentence"),
    [
        (lambda wheel: wheel[:, ::-1], "swapped"),
        (lambda wheel: -wheel, "both count backwards"),
        (lambda wheel: wheel * [1.0, -1.0], "opposite directions"),
        (lambda wheel: wheel * [-1.0, 1.0], "opposite directions"),
    ],
)
def test_wheels_mixed_up_are_named(change, sentence):
    wheel, rate, velocity = rates_of(path())
    with pytest.raises(EstimationError, match=sentence) as raised:
        drive_guess("wheel0", change(wheel), rate, velocity, UP)
    assert str(raised.value).startswith("wheel0: ")


@each(
    ("changes", "sentence"),
    [
        ({"turn": 0.0}, "too little"),
        ({"turn": 0.01}, "too little"),
        ({"speed": 0.0}, "drove a single arc|too little"),
    ],
)
def test_motion_that_shows_too_little_is_named(changes, sentence):
    with pytest.raises(EstimationError, match=sentence):
        drive_guess("wheel0", *rates_of(path(**changes)), UP)


def test_a_single_arc_is_named():
    t = path().t
    arc = Path(t, 0.5 * np.ones_like(t), 0.8 * np.ones_like(t))
    with pytest.raises(EstimationError, match="drove a single arc"):
        drive_guess("wheel0", *rates_of(arc), UP)


def imu_of(p, bias=0.02, noise=0.0):
    rng = np.random.default_rng(0)
    gyro = p.rate + bias + noise * rng.normal(size=(len(p.t), 3))
    stream = ImuStream("imu0", np.round(p.t * 1e9).astype(np.int64), gyro, np.zeros((len(p.t), 3)))
    return ImuData.build(stream, ImuNoise(1e-3, 1e-2, 1e-5, 1e-4))


def stamped(p, offset, hz=50.0, first=3.0, last=37.0):
    """Wheel stamps from `first` to `last` on the IMU's clock, on a clock that lags by `offset` behind it."""
    at = np.arange(first, last, 1.0 / hz)
    angles = np.stack([np.interp(at, p.t, x) for x in p.angles.T], axis=1)
    return at - offset, angles


@each("offset", [3.0, 2.9123, -11.37, 0.0041])
def test_the_offset_is_found_whatever_the_clocks_origins(offset):
    p = path()
    seconds, angles = stamped(p, offset)
    rates = wheel_rates("wheel0", seconds, angles)
    assert wheel_offset(imu_of(p), UP, "wheel0", rates) == pytest.approx(offset, abs=1e-4)


def test_the_offset_with_noise_and_an_axis_that_is_five_degrees_off():
    p = path()
    seconds, angles = stamped(p, 1.234)
    angles += np.cumsum(0.03 * np.sqrt(1 / 50) * np.random.default_rng(1).normal(size=angles.shape), axis=0)
    up = Rotation.from_euler("x", 5.0, degrees=True).apply(UP)
    found = wheel_offset(imu_of(p, noise=0.01), up, "wheel0", wheel_rates("wheel0", seconds, angles))
    assert found == pytest.approx(1.234, abs=3e-3)


def test_swapped_wheels_turn_the_other_way_round():
    p = path()
    seconds, angles = stamped(p, 1.0)
    with pytest.raises(EstimationError, match="wheel0 turns in the opposite direction to imu0"):
        wheel_offset(imu_of(p), UP, "wheel0", wheel_rates("wheel0", seconds, angles[:, ::-1]))


@pytest.mark.parametrize("turn", [0.6, 1.2])
def test_a_wheel_that_sticks_is_not_swapped(turn):
    """For 2.5 of 20 s. Yaw rates of the opposite sign then correlate more, at a shift with a shorter overlap."""
    p = path(20.0, turn=turn)
    seconds, angles = stamped(p, 1.0, first=1.0, last=19.0)
    steps = np.diff(angles[:, 0])
    held = np.abs(seconds[:-1] - 5.25) < 1.25
    steps[held] = steps[held][0]
    angles[1:, 0] = angles[0, 0] + np.cumsum(steps)
    found = wheel_offset(imu_of(p), UP, "wheel0", wheel_rates("wheel0", seconds, angles))
    assert found == pytest.approx(1.0, abs=0.1)


def test_wheels_of_another_drive_match_at_no_shift():
    p = path()
    other = np.cumsum(np.random.default_rng(2).normal(size=(1700, 2)), axis=0) * 0.05
    with pytest.raises(EstimationError, match="the yaw rate of wheel0 does not match that of imu0"):
        wheel_offset(imu_of(p), UP, "wheel0", wheel_rates("wheel0", 0.02 * np.arange(1700), other))


def test_too_few_readings_are_named():
    with pytest.raises(EstimationError, match="pairs of its 12 readings"):
        wheel_rates("wheel0", 0.3 * np.arange(12), np.zeros((12, 2)))


def test_rates_are_means_over_windows():
    p = path()
    seconds, angles = stamped(p, 0.0)
    rates = wheel_rates("wheel0", seconds, angles)
    assert rates.end - rates.start == pytest.approx(0.1)
    want = [(np.interp(rates.end, seconds, x) - np.interp(rates.start, seconds, x)) / 0.1 for x in angles.T]
    np.testing.assert_allclose(rates.rate.T, want, rtol=0, atol=1e-9)
