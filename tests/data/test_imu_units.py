"""Units and axes of IMU readings: those of the rig file, and those that gravity shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.cases import each
from tests.remarks import names

from icalib.data.measurements import ImuStream
from icalib.errors import RecordingError
from icalib.rig import ImuSensor
from icalib.sensors.imu.read import checked_imu
from icalib.sensors.imu.spec import class_noise
from icalib.tools.simulation import handheld, simulate

IMU = ImuSensor("imu0", "imu0/data.csv", class_noise("consumer"))
G = 9.80665


@pytest.fixture(scope="module")
def waved() -> ImuStream:
    imu = simulate(handheld(8.0), 5).measurements.imu
    assert imu is not None
    return imu


def gravity_of(imu: ImuStream) -> np.ndarray:
    """(N, 3) in IMU axes, by the gyroscope from the mean of the first 2 s: enough to take gravity off."""
    from icalib.geometry import so3

    steps = so3.exp_many(np.ascontiguousarray(imu.gyro[:-1] * np.diff(imu.seconds)[:, None]))
    R = np.empty((len(imu.seconds), 3, 3))
    R[0] = np.eye(3)
    so3.chain(steps, R)
    mean = np.einsum("nij,nj->ni", R, imu.accel).mean(axis=0)
    return np.einsum("nji,j->ni", R, mean)


def test_readings_in_si_units_stay_as_they_are(waved):
    found, notes = checked_imu(waved, "file", IMU)
    assert notes == ()
    np.testing.assert_array_equal(found.accel, waved.accel)
    np.testing.assert_array_equal(found.gyro, waved.gyro)


def test_fields_of_the_rig_file_undo_units_and_axes(waved):
    written = replace(waved, gyro=np.rad2deg(waved.gyro[:, [1, 0, 2]] * [1, -1, 1]), accel=waved.accel / -G)
    sensor = replace(IMU, gyro_unit="deg/s", accel_unit="g", gyro_axes=("-y", "x", "z"), accel_axes=("-x", "-y", "-z"))
    found, notes = checked_imu(written, "file", sensor)
    assert notes == ()
    np.testing.assert_allclose(found.gyro, waved.gyro, rtol=1e-12)
    np.testing.assert_allclose(found.accel, waved.accel, rtol=1e-12)


def at_rest(waved: ImuStream) -> ImuStream:
    rng = np.random.default_rng(3)
    n = len(waved.gyro)
    return replace(waved, gyro=rng.normal(0, 2e-3, (n, 3)), accel=[0.3, 0.2, 9.8] + rng.normal(0, 0.02, (n, 3)))


@each("rest", [False, True])
@each("degrees", [False, True])
def test_units_of_g_are_recognised(waved, rest, degrees):
    imu = at_rest(waved) if rest else waved
    unit = 180.0 / np.pi if degrees else 1.0
    written = replace(imu, accel=1.04 * imu.accel / G, gyro=unit * imu.gyro)
    found, notes = checked_imu(written, "file", replace(IMU, gyro_unit="deg/s") if degrees else IMU)
    assert "accelerometer_in_g" in names(notes)
    np.testing.assert_allclose(found.accel, 1.04 * imu.accel, rtol=1e-12)


def test_units_of_g_against_the_rig_file(waved):
    with pytest.raises(RecordingError, match=r"imu0.*correct accel_unit"):
        checked_imu(replace(waved, accel=waved.accel / G), "file", replace(IMU, accel_unit="m/s^2"))


@each("size", [0.02, 0.3, 1.0])
def test_gravity_taken_off_is_named(waved, size):
    """At any size, that of units of g too."""
    linear = waved.accel - gravity_of(waved)
    linear *= size / np.median(np.linalg.norm(linear, axis=1))
    with pytest.raises(RecordingError, match="the accelerometer readings contain no gravity"):
        checked_imu(replace(waved, accel=linear), "file", IMU)


@each("factor", [1000.0, 1000.0 / G, 3.28084, 1 / 3.0])
def test_other_units_are_refused(waved, factor):
    with pytest.raises(RecordingError, match="far from gravity.*accel_unit"):
        checked_imu(replace(waved, accel=factor * waved.accel), "file", IMU)


def test_degrees_name_the_field(waved):
    with pytest.raises(RecordingError, match="set gyro_unit: deg/s"):
        checked_imu(replace(waved, gyro=np.rad2deg(waved.gyro)), "file", IMU)
