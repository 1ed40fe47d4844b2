"""Several recordings of one robot: a world and planes of its own for each, one calibration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from tests.consistency.recordings import steady

from icalib.errors import EstimationError
from icalib.pipeline import calibrate_measurements
from icalib.result import Calibration
from icalib.tools.montecarlo.record import compare
from icalib.tools.simulation import Scenario, Simulation, rig_for, simulate

MONTH_NS = 30 * 86_400 * 10**9 + 123_456_789


def another_day(scenario: Scenario) -> Scenario:
    """The board stands elsewhere, biases differ, all clocks were set back by a month."""
    T = scenario.T_world_board.copy()
    T[:3, :3] = T[:3, :3] @ Rotation.from_euler("z", 0.2).as_matrix()
    T[:3, 3] += [0.0, -1.0, 0.2]

    def earlier(sensors):
        return tuple(replace(s, clock_origin_ns=s.clock_origin_ns - MONTH_NS) for s in sensors)

    return replace(
        scenario,
        T_world_board=T,
        gyro_bias=(0.01, -0.03, 0.02),
        accel_bias=(0.1, -0.1, 0.05),
        imu_clock_origin_ns=scenario.imu_clock_origin_ns - MONTH_NS,
        cameras=earlier(scenario.cameras),
        sensors=earlier(scenario.sensors),
    )


def pair(robot, example: str, seconds: tuple[float, float], parts: str, azimuth_steps: int, **changes):
    first, second = (robot(example, s, parts, azimuth_steps, **changes) for s in seconds)
    return simulate(first, 1), simulate(another_day(second), 2)


def check(result: Calibration, simulation: Simulation) -> None:
    assert result.converged, result.status
    record = compare(0, result, simulation.truth, [], 0.0)
    e, P = record.error, record.covariance
    low, high = chi2.ppf([0.0005, 0.9995], len(e))
    assert low < e @ np.linalg.solve(P, e) < high, e / np.sqrt(np.diag(P))


def worlds(result: Calibration) -> set[str]:
    """The recordings that planes are named after."""
    return {p.name.removeprefix("plane ").split(".")[0] for p in result.planes}


def test_a_lidar_alone_finds_the_planes_of_each_recording(robot):
    simulations = pair(robot, "3d", (9.0, 7.0), "l", 300)
    rig = rig_for(simulations[0].scenario)
    result = calibrate_measurements(rig, [s.measurements.unassociated() for s in simulations])
    check(result, simulations[0])
    assert worlds(result) == {"1", "2"}
    single = calibrate_measurements(rig, simulations[0].measurements.unassociated())
    assert not any("." in p.name for p in single.planes)
    for name in ("rotation", "translation"):
        assert (result.group("lidar0", name).std_formal < single.group("lidar0", name).std_formal).all()


@pytest.mark.full
def test_all_sensors_with_planes_that_are_known(robot):
    simulations = pair(robot, "ramp", (18.0, 20.0), "clw", 300)
    rig = steady(rig_for(simulations[0].scenario))
    result = calibrate_measurements(rig, [s.measurements for s in simulations])
    check(result, simulations[0])
    assert worlds(result) == {"1", "2"}


def test_a_recording_without_planes_is_named(robot):
    simulations = pair(robot, "3d", (8.0, 8.0), "l", 150)
    rig = rig_for(simulations[0].scenario)
    good, bad = (replace(s.measurements.unassociated(), name=n) for s, n in zip(simulations, ("a", "b"), strict=True))
    rng = np.random.default_rng(0)
    scattered = (replace(x, xyz=rng.uniform(-20.0, 20.0, x.xyz.shape).astype(np.float32)) for x in bad.lidars)
    with pytest.raises(EstimationError, match="^b: lidar0"):
        calibrate_measurements(rig, [good, bad.with_streams(*scattered)])
