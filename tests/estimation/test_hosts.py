"""What nodes are placed at: images, but for relative poses of wheels, which need nodes at their ends."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from icalib.estimation.assembly import host_times, image_times, nodes_for
from icalib.estimation.inputs import inputs_for
from icalib.simulation import load_scenario, rig_for, simulate

SCENARIO = Path(__file__).parents[2] / "examples" / "paper" / "table2-3d.yaml"


@pytest.fixture(scope="module")
def inputs():
    scenario = replace(load_scenario(SCENARIO), duration_s=4.0, lidars=())
    return inputs_for(rig_for(scenario), [simulate(scenario, 0).measurements])


def values_of(inputs, offset):
    cameras = {(c.name, "time_offset"): np.zeros(1) for c in inputs.rig.cameras}
    return cameras | {("wheel0", "time_offset"): np.array([offset])}


def with_settings(inputs, **settings):
    return replace(inputs, rig=replace(inputs.rig, settings=replace(inputs.rig.settings, **settings)))


@pytest.mark.parametrize("offset", [0.0, -0.013])
def test_relative_poses_have_nodes_at_their_ends_and_none_between(inputs, offset):
    values = values_of(inputs, offset)
    stamps = inputs.measurements.wheels[0].seconds + offset
    nodes = nodes_for(inputs, host_times(inputs, values))
    inside = (stamps >= nodes[0]) & (stamps <= nodes[-1])
    np.testing.assert_allclose(nodes[(nodes >= stamps[0]) & (nodes <= stamps[-1])], stamps[inside], atol=1e-12)


def test_images_before_and_after_them_have_their_own(inputs):
    stream = inputs.measurements.wheels[0]
    middle = slice(20, 60)
    cut = replace(
        stream, stamps_ns=stream.stamps_ns[20:61], pose=stream.pose[middle], covariance=stream.covariance[middle]
    )
    late = (stream.stamps_ns[20] - stream.stamps_ns[0]) * 1e-9  # seconds count from the first stamp
    inputs = replace(inputs, measurements=replace(inputs.measurements, wheels=(cut,)))
    values = values_of(inputs, late)
    found, times = host_times(inputs, values)[0], cut.seconds + late
    images = np.concatenate(image_times(inputs, values))
    outside = images[(images < times[0]) | (images > times[-1])]
    assert len(outside) > 40
    np.testing.assert_allclose(np.sort(found), np.sort(np.concatenate([times, outside])))


@pytest.mark.parametrize("settings", [{"scheme": "pose"}, {"nodes": "first-camera"}, {"node_spacing_s": 0.03}])
def test_otherwise_images_have_them(inputs, settings):
    """Where the scheme needs it, where it is asked for, and where poses are further apart than nodes may be."""
    inputs = with_settings(inputs, **settings)
    values = values_of(inputs, 0.0)
    for found, images in zip(host_times(inputs, values), image_times(inputs, values), strict=True):
        np.testing.assert_array_equal(found, images)
