"""Cameras whose rows are exposed one after the other."""

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.consistency.recordings import by_hand

from icalib.data.measurements import Measurements
from icalib.pipeline import calibrate_measurements
from icalib.sensors.camera.assess import image_velocity
from icalib.sensors.camera.stream import CornerStream
from icalib.tools.simulation import Simulation, rig_for

ROWS = 480


def _rolled(simulation: Simulation, camera: str, readout_s: float) -> Measurements:
    """The corners of `camera` where they would be if its rows were exposed over `readout_s`, the middle one at the
    stamp: each moves by its image velocity, which the images before and after show."""
    stream = simulation.measurements.streams[camera]
    assert isinstance(stream, CornerStream)
    velocity, known = image_velocity(stream.image, stream.point, stream.uv, stream.seconds)
    uv, delay = stream.uv.copy(), readout_s * (stream.uv[:, 1] / ROWS - 0.5)
    uv[known] += delay[known, None] * velocity[known]
    return simulation.measurements.with_streams(replace(stream, uv=uv))


@pytest.mark.slow
@pytest.mark.parametrize(("readout_s", "named"), [(0.0, False), (0.004, True)])
def test_it_is_named_where_it_is(readout_s, named):
    simulation = by_hand(6.0, 3)
    rig = rig_for(simulation.scenario, intrinsics="free", distortion="free")
    result = calibrate_measurements(rig, _rolled(simulation, "cam0", readout_s))
    said = [reason for reason in result.reasons if reason.name == "rolling_shutter"]
    assert [reason.split()[0] for reason in said] == (["cam0"] if named else [])
    assert not named or result.reasons[0] == said[0]
