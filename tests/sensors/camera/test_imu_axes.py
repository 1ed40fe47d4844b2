"""IMUs whose readings are inverted, permuted or of left-handed axes: what the sentence asks for undoes it."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each

from icalib.data.measurements import ImuStream
from icalib.errors import EstimationError
from icalib.rig import Axes, ImuSensor, Rig
from icalib.sensors.camera.initialize.target_with_imu import initial_guess
from icalib.sensors.imu.read import in_si
from icalib.tools.simulation import handheld, rig_for, simulate

pytestmark = pytest.mark.slow

XYZ: Axes = ("x", "y", "z")


@pytest.fixture(scope="module")
def run():
    simulation = simulate(handheld(8.0), 4)
    return rig_for(simulation.scenario), simulation.measurements


@pytest.fixture(scope="module")
def good(run):
    """What is found of the readings as they are."""
    return initial_guess(*run)


def recorded(imu: ImuStream, rig: Rig, gyro: Axes, accel: Axes) -> ImuStream:
    """The readings as an IMU records them whose columns are these axes."""
    assert rig.imu is not None
    return in_si(imu, replace(rig.imu, gyro_axes=gyro, accel_axes=accel))


def asked_for(sentence: str, sensor: ImuSensor) -> ImuSensor:
    """The sensor with the first field that the sentence names."""
    field, entries = re.findall(r"((?:gyro|accel)_axes): \[(.*?)\]", sentence)[0]
    return replace(sensor, **{field: tuple(entries.split(", "))})


@each(
    ("gyro", "accel", "words"),
    [
        (XYZ, ("-x", "-y", "-z"), "has an inverted accelerometer, which reads -g at rest"),
        (("x", "-y", "z"), XYZ, "left-handed gyroscope, axis y reversed"),
        (("x", "y", "-z"), XYZ, "left-handed gyroscope, axis z reversed"),
        (("-x", "-y", "-z"), XYZ, "gyroscope with all axes reversed"),
        (("y", "x", "z"), XYZ, "gyroscope whose axes x and y are swapped"),
        (("x", "z", "y"), XYZ, "gyroscope whose axes y and z are swapped"),
        (("y", "z", "x"), XYZ, "gyroscope whose axes differ from those of its accelerometer"),
        (("-x", "-y", "z"), XYZ, "gyroscope whose axes x and y are reversed"),
        (XYZ, ("x", "y", "-z"), "left-handed accelerometer, axis z reversed"),
        (XYZ, ("z", "y", "x"), "accelerometer whose axes x and z are swapped"),
    ],
)
def test_each_way_is_named_and_undone(run, good, gyro, accel, words):
    rig, measurements = run
    wrong = measurements.with_streams(recorded(measurements.imu, rig, gyro, accel))
    with pytest.raises(EstimationError) as error:
        initial_guess(rig, wrong)
    assert words in str(error.value) and str(error.value).endswith(f"of {rig.imu.name} in the rig file.")
    right = wrong.with_streams(in_si(wrong.imu, asked_for(str(error.value), rig.imu)))
    found = initial_guess(rig, right)
    assert abs(found.cameras["cam0"].offset - good.cameras["cam0"].offset) < 2e-3
    np.testing.assert_allclose(np.abs(found.cameras["cam0"].position), np.abs(good.cameras["cam0"].position), atol=0.03)


def test_the_field_is_said_on_top_of_what_the_rig_file_says(run):
    """Of a rig file that swaps two axes already."""
    rig, measurements = run
    wrong = measurements.with_streams(recorded(measurements.imu, rig, ("x", "-y", "z"), XYZ))
    rig = rig.with_(imu=replace(rig.imu, gyro_axes=("z", "-y", "x")))
    with pytest.raises(EstimationError, match=r"set gyro_axes: \[z, y, x\] of imu0"):
        initial_guess(rig, wrong)


def test_another_motion_is_no_way(run):
    rig, measurements = run
    imu = measurements.imu
    other = measurements.with_streams(replace(imu, gyro=imu.gyro[::-1].copy(), accel=imu.accel[::-1].copy()))
    with pytest.raises(EstimationError, match="does not match"):
        initial_guess(rig, other)
