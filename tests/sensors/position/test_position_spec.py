"""A position sensor in the rig file: each field read, written back, and refused where it is wrong."""

from __future__ import annotations

import pytest

from icalib.errors import RigError
from icalib.rig.file import load_rig, rig_from_dict, rig_to_dict
from icalib.sensors.position.model import MODEL
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
    assert [spec.name for spec in sensor.specs()] == ["translation", "time_offset", "clock_rate"]


@pytest.mark.parametrize(
    "fields",
    [
        "topic: /fix; frame: tilted; position_noise: 0.02; clock_restarts: true",
        "coordinates: geodetic; columns: [t, lat, lon, h]; time_unit: s; position_noise: messages",
        "least_status: fixed; translation: {prior: [0.1, 0, 1.2], sigma: 0.01}; time_offset: {fixed: 0.1}",
        "position_random_walk: 0.02",
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
        ("position_random_walk: 0", "position_random_walk: must be above 0"),
        ("position_noise: mesages", "position_noise: must be a number"),
        ("least_status: rtk", "available are single, differential, float, fixed"),
        ("frame: known", "there is no frame known; available are levelled, tilted."),
        ("frame: leveled", "did you mean 'levelled'"),
        ("frame: gnss0", "there is no frame gnss0"),
        ("frame: target", "there is no frame target"),
        ("rotation: free", "there is no such field"),
    ],
)
def test_wrong_fields(tmp_path, fields, sentence):
    with pytest.raises(RigError, match=sentence):
        loaded(tmp_path, fields)


OTHERS = {
    "target": "cam0: {type: camera, model: pinhole-radtan, resolution: [9, 9]}",
    "prism0": "prism0: {type: position, frame: tilted}",
    "mocap0": "mocap0: {type: pose, kind: KIND}",
}


def shared(tmp_path, other, kind="absolute", more=""):
    path = tmp_path / "rig.yaml"
    board = "\ntarget: {type: checkerboard, rows: 6, cols: 7, square_size: 0.1}" if other == "target" else ""
    path.write_text(RIG.format(f"frame: {other}") + f"  {OTHERS[other].replace('KIND', kind)}\n{more}{board}")
    return load_rig(path)


@pytest.mark.parametrize("other", OTHERS)
def test_a_frame_that_is_shared(tmp_path, other):
    """With the target, another position sensor, or absolute poses. It has no parameters of its own."""
    rig = shared(tmp_path, other)
    assert rig.of(PositionSensor)[0].shared_frame == other
    assert rig_from_dict(rig_to_dict(rig), "there").of(PositionSensor) == rig.of(PositionSensor)
    assert not any("gnss0" in sensor for sensor, *_ in MODEL.scene_entries(rig.of(PositionSensor)[0], rig, 1))


@pytest.mark.parametrize(
    ("other", "kind", "more", "sentence"),
    [
        ("mocap0", "relative", "", "there is no frame mocap0; available are levelled, tilted."),
        ("prism0", "", "  prism1: {type: position, frame: gnss0}\n", "available are levelled, tilted, prism0."),
    ],
)
def test_a_frame_that_cannot_be_shared(tmp_path, other, kind, more, sentence):
    """Relative poses have none, and a frame that is shared has another owner."""
    with pytest.raises(RigError, match=sentence):
        shared(tmp_path, other, kind, more)


def test_a_target_of_two_bodies_has_no_frame(tmp_path):
    path = tmp_path / "rig.yaml"
    path.write_text(
        RIG.format("frame: target")
        + f"  {OTHERS['target']}\ntargets:\n"
        + "  a: {type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3}\n"
        + "  b: {type: aprilgrid, rows: 6, cols: 6, tag_size: 0.088, tag_spacing: 0.3, first_id: 36}\n"
    )
    with pytest.raises(RigError, match="a target of 2 bodies has no frame"):
        load_rig(path)
