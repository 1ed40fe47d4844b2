"""Units, motion and saturation of an IMU that is broken in one way at a time."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from tests.typed import not_none

from icalib.data.measurements import ImuStream
from icalib.sensors.imu.inspect import imu_facts
from icalib.sensors.imu.read.cleaning import gravity_spread
from icalib.tools.inspection import inspect_recording
from icalib.tools.simulation import handheld, simulate

DEGREE = np.pi / 180.0


def about(x: float, y: float, z: float) -> Callable[[ImuStream], ImuStream]:
    """Rates about each axis times a factor."""
    return lambda imu: replace(imu, gyro=imu.gyro * [x, y, z])


def askew(imu: ImuStream) -> ImuStream:
    """Turned about one direction between the axes only."""
    return replace(imu, gyro=imu.gyro[:, :1] * np.ones(3) / np.sqrt(3.0))


def in_g(imu: ImuStream) -> ImuStream:
    return replace(imu, accel=imu.accel / 9.80665)


def slow_degrees(imu: ImuStream) -> ImuStream:
    """In deg/s, but so slow that the numbers could be rad/s: time stretched fivefold."""
    origin = imu.stamps_ns[0]
    return replace(imu, stamps_ns=origin + 5 * (imu.stamps_ns - origin), gyro=imu.gyro / 5.0 / DEGREE)


def degrees(imu: ImuStream) -> ImuStream:
    return replace(imu, gyro=imu.gyro / DEGREE)


def saturated(imu: ImuStream) -> ImuStream:
    limit = 3.0
    return replace(imu, gyro=np.clip(imu.gyro * [8.0, 1.0, 1.0], -limit, limit))


BROKEN = [
    (about(0.01, 1, 1), "warning", r"Hardly any rotation about the x axis of imu0 \(0\.0\d rad/s RMS\); turn the rig"),
    (about(1, 1, 0.01), "warning", r"the z axis of imu0"),
    (
        about(0.001, 0.001, 1),
        "problem",
        r"imu0 turns about the z axis of imu0 only .*; turn the rig about the x and y axes of imu0 as well",
    ),
    (askew, "problem", r"about the direction \(0\.58, 0\.58, 0\.58\) in the axes of imu0 only"),
    (about(0.001, 0.001, 0.001), "problem", r"imu0 hardly moves .*; record again"),
    (in_g, "warning", r"units of g .*multiplied by 9\.80665"),
    (degrees, "problem", r"deg/s; set gyro_unit: deg/s"),
    (slow_degrees, "problem", r"deg/s, for gravity rotates accordingly"),
    (saturated, "warning", r"gyroscope x looks saturated, .* at 3 from"),
]


@pytest.mark.parametrize("damage, severity, words", BROKEN)
def test_what_is_wrong_is_said(damage, severity, words, waved, bags, tmp_path):
    imu = damage(waved)
    bag = bags.write(tmp_path / "run", bags.noise("/cam0/image_raw", count=450) + bags.imu("/imu0", imu))
    found = inspect_recording(bag)
    assert [f.severity for f in found.findings if re.search(words, f.sentence)] == [severity], found.findings
    assert found.verdict == {"problem": "no", "warning": "yes, but"}[severity]


def test_a_robot_that_only_turns_on_the_floor(waved, bags, tmp_path):
    imu = replace(waved, gyro=waved.gyro * [0, 0, 1], accel=[0, 0, 9.81] + 0.01 * (waved.accel - waved.accel[0]))
    bag = bags.write(tmp_path / "run", bags.noise("/cam0/image_raw", count=450) + bags.imu("/imu0", imu))
    sentences = [f.sentence for f in inspect_recording(bag).findings]
    assert "imu0 turns about the z axis of imu0 only" in sentences[0]
    assert any("Hardly any acceleration of imu0" in s for s in sentences)
    assert not any("gravity" in s for s in sentences)


def test_curves_of_a_level_robot_are_no_contradiction_of_gravity(waved, bags, tmp_path):
    """Centripetal acceleration keeps its direction in the axes of the robot, which turn."""
    yaw_rate = waved.gyro[:, 2]
    accel = np.stack([0.0 * yaw_rate, 2.0 * yaw_rate, 9.81 + 0.0 * yaw_rate], axis=1)  # at 2 m/s
    imu = replace(waved, gyro=waved.gyro * [0, 0, 1], accel=accel)
    bag = bags.write(tmp_path / "run", bags.imu("/imu0", imu) + [bags.pose("/mocap/pose", int(imu.stamps_ns[0]))])
    assert not any("gravity" in f.sentence for f in inspect_recording(bag).findings)


def test_figures(waved):
    facts = imu_facts(waved, "here", "imu_link")
    assert facts.problem == "" and facts.frame == "imu_link"
    np.testing.assert_allclose(facts.gyro_rms, np.sqrt((waved.gyro**2).mean(axis=0)))
    np.testing.assert_allclose(facts.accel_std, waved.accel.std(axis=0))
    assert facts.mean_accel == pytest.approx(np.linalg.norm(waved.accel, axis=1).mean())
    assert facts.gyro_max[2] == waved.gyro[:, 2].max() and facts.accel_min[0] == waved.accel[:, 0].min()
    rms = np.sqrt(((waved.gyro @ np.array(facts.principal).T) ** 2).mean(axis=0))
    np.testing.assert_allclose(facts.principal_rms, rms)
    assert rms[0] >= rms[1] >= rms[2]


def test_readings_that_are_not_finite(waved):
    gyro = waved.gyro.copy()
    gyro[7, 1] = np.nan
    facts = imu_facts(replace(waved, gyro=gyro), "here", "")
    assert "1 of 5001 readings are not finite" in facts.notes[0] and np.isfinite(facts.gyro_rms).all()


def test_gravity_stands_still_in_the_right_unit_only():
    """At rest but for its turning: rates in rad/s keep gravity where it is."""
    imu = simulate(handheld(6.0, noiseless=True), 3).measurements.imu
    t = not_none(imu).seconds
    angle = np.stack([0.5 * np.sin(3 * t), 0 * t, 0 * t], axis=1)
    rate = np.stack([1.5 * np.cos(3 * t), 0 * t, 0 * t], axis=1)
    force = 9.81 * np.stack([0 * t, np.sin(angle[:, 0]), np.cos(angle[:, 0])], axis=1)
    turned = replace(not_none(imu), gyro=rate, accel=force)
    assert not_none(gravity_spread(turned, 1.0)) < 0.02
    assert not_none(gravity_spread(turned, DEGREE)) > 2.0
    assert not_none(gravity_spread(replace(turned, gyro=rate / DEGREE), DEGREE)) < 0.02


def test_gravity_spread_of_a_short_recording(waved):
    assert gravity_spread(ImuStream("a", waved.stamps_ns[:50], waved.gyro[:50], waved.accel[:50]), 1.0) is None
