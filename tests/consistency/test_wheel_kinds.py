"""Speed and yaw rate, and steered front wheels, on whole robots: honest covariances, and what straight lines leave."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.consistency.test_robot import steady

from icalib.pipeline import calibrate_measurements
from icalib.result.verdict import UNUSABLE
from icalib.rig import WheelKind, drive_names
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.montecarlo.one_run import error, true_value
from icalib.tools.simulation import Scenario, rig_for, simulate

MOUNTS = ("rotation", "translation", "time_offset")
KINDS: dict[str, WheelKind] = {"twist": "twist", "steering": "steered"}


def reporting(scenario: Scenario, reports: str) -> Scenario:
    """Its wheels as good as the encoders of the other tests, with parameters that are not the defaults."""
    changed = replace(
        scenario.of(SimWheels)[0],
        reports=reports,
        scales=(1.03, 0.97),
        speed_noise=5e-4,
        yaw_noise=2e-3,
        wheelbase=0.25,
        steering_offset=0.02,
        steering_noise=5e-4,
    )
    return scenario.with_sensors(changed)


def check(consistency, robot, reports: str, seeds: range, probability: float) -> None:
    scenario = reporting(robot("ramp", 30.0, "cw"), reports)
    blocks = (*MOUNTS, *drive_names(KINDS[reports]))
    found = consistency(scenario, steady(rig_for(scenario)), seeds, probability, blocks)
    print({block: (round(c.mean, 3), round(c.low, 3), round(c.high, 3)) for block, c in found.items()})
    assert {block: c for block, c in found.items() if not c.consistent} == {}


@pytest.mark.parametrize("reports", KINDS)
def test_a_few_recordings(consistency, robot, reports):
    check(consistency, robot, reports, range(3), 0.9999)


@pytest.mark.full
@pytest.mark.parametrize("reports", KINDS)
def test_fifty_recordings(consistency, robot, reports):
    check(consistency, robot, reports, range(50), 0.99)


@pytest.mark.parametrize(
    ("reports", "open_", "known"), [("twist", "scales.yaw_rate", "scales.speed"), ("steering", "wheelbase", "radius")]
)
def test_a_straight_line_leaves_what_only_turning_shows(robot, reports, open_, known):
    scenario = reporting(robot("planar", 20.0, "lw"), reports)
    scenario = replace(scenario, motion=replace(scenario.motion, kind="straight-line"))
    simulation = simulate(scenario, 0)
    rig = rig_for(scenario, rotation="start", translation="start", time_offset="start", others="start")
    result = calibrate_measurements(rig, simulation.measurements)
    assert result.converged, result.status
    verdicts = {
        f"{g.name}.{label}".removesuffix(f".{g.name}").rstrip("."): v
        for g in result.groups
        if g.sensor == "wheel0"
        for label, v in zip(g.labels, g.verdict, strict=True)
    }
    assert verdicts[open_] == "unobservable" and verdicts[known] not in UNUSABLE, verdicts
    words = "wheel0 " + open_.replace(".", " ").replace("_", " ")
    assert any(words in sentence for sentence in result.unobservable), result.unobservable
    for g in result.groups:
        true = true_value(simulation.truth, g.sensor, g.name)
        if g.sensor == "wheel0" and true is not None:
            z = np.abs(error(g.name, g.value, true) / g.std_formal)[[v not in UNUSABLE for v in g.verdict]]
            assert z.max(initial=0.0) < 4.0, f"{g.name} {g.value} {true} {g.std_formal} {g.verdict}"
