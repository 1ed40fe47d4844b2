"""The first guess of speed and yaw rate, and of front wheels that steer, from a planar path by hand."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tests.cases import each

from icalib.data.measurements import ImuStream
from icalib.errors import EstimationError
from icalib.motion.imu_data import ImuData
from icalib.rig import ImuNoise
from icalib.sensors.wheels.initialize.drive_guess import drive_guess, wheel_offset, wheel_rates

R_IMU_WHEEL = Rotation.from_euler("zyx", [2.2, 0.3, -0.4]).as_matrix()
UP, LEVER = R_IMU_WHEEL[:, 2], np.array([-0.3, 0.12, -0.1])  # p_imu_wheel in the wheels' axes
T = np.arange(0.0, 40.0, 0.01)
TURN = 0.5 * (np.sin(0.9 * T) + 0.6 * np.sin(2.3 * T + 1.0))
SPEED = 0.8 * (1.0 + 0.5 * np.sin(0.5 * T + 0.4) + 0.2 * np.sin(1.7 * T))
RATE = TURN[:, None] * UP
VELOCITY = np.stack([SPEED + TURN * LEVER[1], -TURN * LEVER[0], np.zeros_like(T)], axis=1) @ R_IMU_WHEEL.T
SCALES, RADIUS, BASE, OFFSET = np.array([1.1, 0.9]), 0.12, 0.6, 0.08
TWIST = np.stack([SPEED, TURN], axis=1) / SCALES
ANGLE = np.arctan(BASE * TURN / SPEED) - OFFSET
STEERED = np.stack([SPEED / RADIUS, np.cos(ANGLE), np.sin(ANGLE), np.ones_like(T)], axis=1)


def check_mount(found):
    assert np.abs(Rotation.from_matrix(R_IMU_WHEEL.T @ found.extrinsics.R).as_rotvec()).max() < 1e-9
    assert np.abs((R_IMU_WHEEL.T @ found.extrinsics.p - LEVER)[:2]).max() < 1e-9


def test_scales_are_exact_without_noise():
    found = drive_guess("wheel0", TWIST, RATE, VELOCITY, UP, "twist")
    check_mount(found)
    np.testing.assert_allclose(found.values["scales"], SCALES, rtol=1e-9)


def test_a_bias_of_the_gyroscope_is_not_a_scale():
    found = drive_guess("wheel0", TWIST, RATE + 0.002 * UP, VELOCITY, UP, "twist")
    assert found.values["scales"][1] == pytest.approx(SCALES[1], rel=1e-9)


def test_steered_wheels_are_exact_without_noise():
    found = drive_guess("wheel0", STEERED, RATE, VELOCITY, UP, "steered")
    check_mount(found)
    got = [found.values[name][0] for name in ("radius", "wheelbase", "steering_offset")]
    np.testing.assert_allclose(got, [RADIUS, BASE, OFFSET], rtol=1e-6)


@each(
    ("kind", "values", "words"),
    [
        ("twist", TWIST * [3.6, 1.0] * SCALES, "its forward speed must be in m/s, not km/h"),
        ("twist", TWIST * [1.0, 180.0 / np.pi] * SCALES, "its yaw rate must be in rad/s, not deg/s"),
        ("twist", TWIST * [30.0, 1.0], "its forward speed would have to be multiplied by 0.0367; check its unit"),
        ("twist", TWIST * [1.0, -1.0], "its yaw rate would have to be multiplied by -0.9"),
        ("steered", STEERED * [1.0, 1.0, -1.0, 1.0], "its steering angle is positive to the right; set signs to"),
        ("steered", STEERED * [0.001, 1.0, 1.0, 1.0], "its wheels would have radii of 120 m"),
    ],
)
def test_what_is_wrong_is_named(kind, values, words):
    with pytest.raises(EstimationError, match=words) as raised:
        drive_guess("wheel0", values, RATE, VELOCITY, UP, kind)
    assert str(raised.value).startswith("wheel0: ")


def imu():
    t = np.arange(0.0, T[-1], 0.005)
    gyro = np.interp(t, T, TURN)[:, None] * UP + 0.02
    stream = ImuStream("imu0", np.round(t * 1e9).astype(np.int64), gyro, np.zeros((len(t), 3)))
    return ImuData.build(stream, ImuNoise(1e-3, 1e-2, 1e-5, 1e-4))


def rates_at(kind, values, offset):
    """Integrals of the values at 50 Hz, from 3 to 37 s on the IMU's clock."""
    at = np.arange(3.0, 37.0, 0.02)
    fine = np.arange(3.0, 37.0, 0.001)
    rate = np.stack([np.interp(fine, T, x) for x in values.T], axis=1)
    integral = np.concatenate([np.zeros((1, rate.shape[1])), np.cumsum(0.5e-3 * (rate[1:] + rate[:-1]), axis=0)])
    return wheel_rates("wheel0", at - offset, integral[np.round((at - 3.0) * 1000).astype(int)], kind)


@each(("kind", "values"), [("twist", TWIST), ("steered", STEERED)])
@each("offset", [2.9123, -11.37])
def test_the_offset_is_found(kind, values, offset):
    """Of steered wheels tan is what counts, and it is not straight between the readings here."""
    found = wheel_offset(imu(), UP, "wheel0", rates_at(kind, values, offset))
    assert found == pytest.approx(offset, abs=1e-3 if kind == "steered" else 1e-4)


@pytest.mark.parametrize(
    ("kind", "values", "words"),
    [("twist", TWIST * [1.0, -1.0], "its yaw rate must be"), ("steered", STEERED * [1, 1, -1, 1], "its steering ang")],
)
def test_what_turns_the_other_way_round_is_named(kind, values, words):
    with pytest.raises(EstimationError, match=f"wheel0 turns in the opposite direction to imu0: {words}"):
        wheel_offset(imu(), UP, "wheel0", rates_at(kind, values, 1.0))


@pytest.mark.parametrize(("kind", "values"), [("twist", TWIST), ("steered", STEERED)])
def test_a_vehicle_that_stood_still_is_named(kind, values):
    with pytest.raises(EstimationError, match="wheel0: the vehicle stood still according to its readings"):
        rates_at(kind, values * ([0.0, 0.0] if kind == "twist" else [0.0, 1.0, 1.0, 0.0]), 0.0)


def test_mecanum_wheels_move_sideways():
    """The speed ahead is that of the motion; of another vehicle it is not."""
    sideways = np.outer(0.9 * np.sin(1.3 * T), R_IMU_WHEEL[:, 1])
    with pytest.raises(EstimationError, match="moves sideways as well, by .*mecanum or omni.*kind: relative"):
        drive_guess("wheel0", TWIST, RATE, VELOCITY + sideways, UP, "twist")
    with pytest.raises(EstimationError, match="drives along none of its axes"):
        drive_guess("wheel0", TWIST[::-1], RATE, VELOCITY + sideways, UP, "twist")
