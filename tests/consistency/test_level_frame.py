"""Wheels without an IMU: a level frame says which way is up, or nothing does. Swapped wheels are named, or both
readings."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.consistency.cases import Run, known
from tests.consistency.recordings import mocap, without_imu
from tests.remarks import names

from icalib.base.remark import Remark
from icalib.data.measurements import Measurements, WheelStream
from icalib.errors import EstimationError
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.sensors.pose.simulate import SimPoses

LEVEL = np.array([[0.0, 1.0, 0.0, 2.0], [-1.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 1.0]])


def swapped(measurements: Measurements) -> Measurements:
    (wheels,) = measurements.wheels
    assert isinstance(wheels, WheelStream)
    return measurements.with_streams(replace(wheels, rate=np.ascontiguousarray(wheels.rate[:, ::-1])))


def level(**others) -> SimPoses:
    return replace(mocap(**others), T_world_frame=LEVEL)


def said(result: Calibration) -> tuple[list[Remark], list[Remark]]:
    notes, warnings = ([w for w in some if w.name.startswith("vertical_")] for some in (result.notes, result.warnings))
    return notes, warnings


def test_a_level_frame_tells_swapped_wheels(robot):
    rig, measurements, simulation = without_imu(robot("ramp", 15.0, "w").with_sensors(level()))
    result = calibrate_measurements(rig, measurements)
    known(10)(Run(simulation, rig, result))
    assert said(result) == ([], [])
    with pytest.raises(
        EstimationError, match="left and right wheels are swapped.* signs to .-1, -1. .*level: false for m"
    ):
        calibrate_measurements(rig, swapped(measurements))
    tilting = rig.with_(poses=(replace(rig.poses[0], level=False),))
    notes, warnings = said(calibrate_measurements(tilting, swapped(measurements)))
    assert notes == [] and names(warnings) == ["vertical_unknown_for_poses"]
    assert "-1.00) in the axes of mocap0" in warnings[0] and "left and right wheels" in warnings[0]


@pytest.mark.full
def test_signs_put_swapped_wheels_right(robot):
    """The frame then looks backwards, and each radius is that of the wheel on the other side."""
    rig, measurements, simulation = without_imu(robot("ramp", 15.0, "w").with_sensors(level()))
    (wheels,) = swapped(measurements).wheels
    assert isinstance(wheels, WheelStream)
    result = calibrate_measurements(rig, measurements.with_streams(replace(wheels, rate=-wheels.rate)))
    radii, true = result.group("wheel0", "radii"), simulation.truth.values["wheel0"]["radii"]
    assert (np.abs(radii.value - true[::-1]) < 4.0 * radii.std).all()


def test_with_a_camera_both_readings_are_said(robot):
    """Of a camera that stands upright in a note."""
    rig, measurements, _ = without_imu(robot("ramp", 20.0, "cw"))
    notes, warnings = said(calibrate_measurements(rig, measurements))
    assert warnings == [] and names(notes) == ["vertical_from_camera"] and "cam0" in notes[0]
    notes, warnings = said(calibrate_measurements(rig, swapped(measurements)))
    assert notes == [] and names(warnings) == ["vertical_ambiguous"]
    assert "cam0 stands upside down, or its left and right wheels are swapped" in warnings[0]
