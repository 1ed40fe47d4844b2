"""Tracks whose points the first poses do not find are left out of a pass, but not out of the result."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icalib.estimate.estimate import Callbacks, EstimateOptions, estimate
from icalib.geometry import so3
from icalib.initialize.rig_guess import guess_of_rig
from icalib.motion.factor import of_type
from icalib.sensors.camera.model import ENOUGH_USED
from icalib.sensors.camera.track_factor import FeatureFactor
from icalib.sensors.lidar.simulate import SimLidar
from icalib.tools.simulation import load_scenario, rig_for, simulate, with_drawn_guess

EXAMPLE = Path(__file__).parents[2] / "examples" / "paper" / "table2-3d.yaml"


@pytest.fixture(scope="module")
def settled():
    """Cameras that follow points and a LiDAR, and where they are estimated to be."""
    scenario = load_scenario(EXAMPLE)
    scenario = replace(scenario, duration_s=8.0, sensors=scenario.of(SimLidar))
    rig = with_drawn_guess(rig_for(scenario), scenario, 0)
    inputs, state, _ = guess_of_rig(rig, [simulate(scenario, 0).measurements])
    return inputs, estimate(inputs, state)


def features_of(problem):
    return of_type(problem.factors, FeatureFactor)[0]


def passes(inputs, found, turned_deg: float):
    """The last pass from where the estimate ended, but for cam0, turned by that much; and how many passes it took."""
    end, key = found.outcome.state, ("cam0", "rotation")
    turned = end.values[key] @ so3.exp(np.radians(turned_deg) * np.array([0.0, 1.0, 0.0]))
    begun = []

    def note(stage, problem, visit):
        features = features_of(problem)
        if not any(features is p for p in begun):
            begun.append(features)

    options = EstimateOptions(measurement_model=found.measurement_model)
    again = estimate(inputs, replace(end, values=end.values | {key: turned}), options, Callbacks(on_visit=note))
    return again, begun


def test_tracks_that_a_wrong_pose_left_out_come_back(settled):
    inputs, found = settled
    again, begun = passes(inputs, found, 15.0)
    assert begun[0].n_used < 0.5 * features_of(found.problem).n_used
    assert len(begun) == 2
    assert features_of(again.problem).n_used >= 0.99 * features_of(found.problem).n_used
    way = so3.log(
        np.ascontiguousarray(
            found.outcome.state.values["cam0", "rotation"].T @ again.outcome.state.values["cam0", "rotation"]
        )
    )
    assert np.linalg.norm(way) < 1e-4


def test_where_enough_take_part_there_is_one_pass(settled):
    inputs, found = settled
    again, begun = passes(inputs, found, 0.5)
    assert len(begun) == 1
    assert features_of(again.problem).n_used > ENOUGH_USED * sum(int(k.sum()) for k in features_of(again.problem).keep)
