"""A result has each parameter with the unit and labels of its definition, and a verdict by its tolerance."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from icalib.pipeline import calibrate_measurements
from icalib.result.saving import calibration_yaml, parameter_keys
from icalib.result.verdict import component_verdict, worst
from icalib.rig.rig import ALL_SPECS, SENSOR_TYPES
from icalib.sensors.pose.simulate import SimPoses
from icalib.sensors.position.simulate import SimPositions
from icalib.sensors.sensor import MOUNTED
from icalib.tools.comparison.compare import compare_sides, side_of_result
from icalib.tools.montecarlo.record import true_value
from icalib.tools.simulation import rig_for, simulate

pytestmark = pytest.mark.slow


def test_every_parameter_of_a_robot_is_in_its_result(robot):
    scenario = robot("ramp", 20.0, "clw")
    T = scenario.cameras[0].T_imu_sensor
    scenario = scenario.with_sensors(SimPoses("mocap0", T), SimPositions("gnss0", T))
    rig, simulation = rig_for(scenario, intrinsics="free", distortion="free"), simulate(scenario, 0)
    assert rig.imu is not None
    result = calibrate_measurements(rig, simulation.measurements)
    plain = yaml.safe_load(calibration_yaml(result))["sensors"]
    found = {(g.sensor, g.name): g for g in result.groups}
    sensors = tuple(rig.sensors.values())
    assert {s.sensor_type for s in sensors} == set(SENSOR_TYPES)
    for sensor in sensors:
        for spec in sensor.specs():
            if not sensor.is_estimated(spec) or (spec.is_auxiliary and not rig.blooms):
                continue
            g = found[sensor.name, spec.name]
            assert (g.unit, g.labels) == (spec.unit, spec.labels)
            tolerance = rig.settings.tolerance(spec.tolerance) if isinstance(spec.tolerance, str) else spec.tolerance
            for verdict, size in zip(g.verdict, g.std / np.array(tolerance), strict=True):
                assert worst((verdict, component_verdict(float(size)))) == verdict
            assert true_value(simulation.truth, sensor.name, spec.name) is not None
            if {*g.verdict} == {"fixed"}:
                continue
            std = plain[sensor.name]["std"]
            keys = parameter_keys(tuple(x for x in result.groups if x.sensor == sensor.name and x.name not in std))
            own = [std[spec.name]] if spec in MOUNTED else [std["parameters"][keys[spec.name, n]] for n in spec.labels]
            np.testing.assert_allclose(np.ravel(own), g.std)
    side = side_of_result(result, "")
    compared = {(d.sensor, d.what) for d in compare_sides(side, side).differences}
    own = {(w.name, spec.one or spec.name.replace("_", " ")) for w in rig.wheels for spec in w.drive_specs}
    assert own | {(s.name, "time offset") for s in sensors[1:]} <= compared
    assert {spec.name for spec in ALL_SPECS} >= {name for _, name in found}
