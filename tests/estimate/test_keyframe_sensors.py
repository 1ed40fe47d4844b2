"""What keyframes are placed at: images, though wheels report relative poses whose ends then lie beside them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icalib.estimate.inputs import inputs_for
from icalib.estimate.problem import keyframe_times, keyframes_for
from icalib.motion.poses import instants
from icalib.sensors.wheels.simulate import SimWheels
from icalib.tools.simulation import load_scenario, rig_for, simulate

SCENARIO = Path(__file__).parents[2] / "examples" / "paper" / "table2-3d.yaml"


@pytest.fixture(scope="module")
def inputs():
    scenario = load_scenario(SCENARIO)
    scenario = replace(scenario, duration_s=4.0, sensors=scenario.of(SimWheels))
    return inputs_for(rig_for(scenario), [simulate(scenario, 0).measurements])


@pytest.mark.parametrize("offset", [0.0, -0.013])
def test_every_image_has_a_keyframe_of_its_own(inputs, offset):
    values = {(c.name, "time_offset"): np.zeros(1) for c in inputs.rig.cameras}
    values |= {("wheel0", "time_offset"): np.array([offset])}
    images = np.concatenate([instants(c, values) for c in inputs.measurements.cameras])
    keyframes = keyframes_for(inputs, keyframe_times(inputs, values))
    recorded = images[(images >= keyframes[0]) & (images <= keyframes[-1])]
    assert len(recorded) > 100
    assert np.abs(keyframes[:, None] - recorded).min(axis=0).max() < 2e-3 + 1e-9
