"""A sensor's measurements come from another recording: no result may rest on them."""

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.consistency.recordings import make_robot, mocap

from icalib.errors import EstimationError
from icalib.pipeline import calibrate_measurements
from icalib.sensors.position.simulate import SimPositions
from icalib.tools.simulation import Scenario, handheld, rig_for, simulate


def _antenna() -> SimPositions:
    return SimPositions("gnss0", mocap().T_imu_sensor, position_noise=0.01)


SCENARIOS: dict[str, Scenario] = {
    "cam1": handheld(8.0),
    "mocap0": replace(handheld(8.0), sensors=(mocap(),)),
    "gnss0": replace(handheld(8.0), sensors=(_antenna(),)),
    "lidar0": make_robot("3d", 6.0, "cl"),
    "wheel0": make_robot("ramp", 20.0, "cw"),
}


@pytest.mark.slow
@pytest.mark.parametrize("sensor", SCENARIOS)
def test_a_result_that_rests_on_nothing_is_no_result(sensor):
    scenario = SCENARIOS[sensor]
    other = simulate(replace(scenario, motion=replace(scenario.motion, seed=77)), 5).measurements.unassociated()
    measured = simulate(scenario, 0).measurements.unassociated().with_streams(other.streams[sensor])
    try:
        result = calibrate_measurements(rig_for(scenario), measured)
    except EstimationError as error:
        assert sensor in str(error)
    else:
        assert result.verdict == "not usable" and sensor in result.reasons[0]
