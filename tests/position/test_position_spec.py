"""A position sensor in the rig file: each field read, written back, and refused where it is wrong."""

from __future__ import annotations

import pytest

from icalib.errors import RigError
from icalib.rig.file import load_rig, rig_from_dict, rig_to_dict
from icalib.sensors.position.spec import PositionSensor

RIG = """
sensors:
  imu0: {{type: imu, noise: consumer}}
  gnss0:
    type: position
    {0}
"""


def loaded(tmp_path, fields="path: gnss.pos"):
    path = tmp_path / "rig.yaml"
    path.write_text(RIG.format("\n    ".join(fields.split("; "))))
    return load_rig(path)


def test_defaults(tmp_path):
    rig = loaded(tmp_path)
    (sensor,) = rig.of(PositionSensor)
    assert sensor == PositionSensor("gnss0", "gnss.pos")
    assert [spec.name for spec in sensor.specs()] == ["translation", "time_offset"]


@pytest.mark.parametrize(
    "fields",
    [
        "topic: /fix; frame: tilted; position_noise: 0.02; clock_restarts: true",
        "coordinates: geodetic; columns: [t, lat, lon, h]; time_unit: s; position_noise: messages",
        "least_status: fixed; translation: {prior: [0.1, 0, 1.2], sigma: 0.01}; time_offset: {fixed: 0.1}",
    ],
)
def test_fields_are_read_and_written_back(tmp_path, fields):
    rig = loaded(tmp_path, fields)
    (sensor,) = rig.of(PositionSensor)
    (again,) = rig_from_dict(rig_to_dict(rig), "there").of(PositionSensor)
    assert sensor != PositionSensor("gnss0", "gnss0/positions.csv")
    assert rig_to_dict(rig) == rig_to_dict(rig.with_sensors(again))


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ("position_noise: -1", "position_noise: must be above 0"),
        ("position_noise: mesages", "position_noise: must be a number"),
        ("least_status: rtk", "available are single, differential, float, fixed"),
        ("frame: known", "available are levelled, tilted"),
        ("rotation: free", "there is no such field"),
    ],
)
def test_wrong_fields(tmp_path, fields, sentence):
    with pytest.raises(RigError, match=sentence):
        loaded(tmp_path, fields)


def test_it_needs_an_imu(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text("sensors:\n  gnss0: {type: position}\n")
    with pytest.raises(RigError, match="gnss0"):
        load_rig(path)
